"""What a run shows while it works: a live table on a terminal, plain lines elsewhere."""

import logging
import math
import time
from types import TracebackType
from typing import Self

import lightning as L
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.live import Live
from rich.table import Table

from corrmat.callbacks import Curve
from corrmat.types import PairBatch

log = logging.getLogger("corrmat")
COLUMNS = ("step", "epoch", "pairs/s", "loss", "matches", "rotation error", "time left")
EVERY = 0.25  # seconds between two drawings


def listen(verbosity: int) -> None:
    """Print what the package has to say: nothing but results (-1), progress (0), all (1)."""
    for handler in [h for h in log.handlers if isinstance(h, _Print)]:
        log.removeHandler(handler)
    log.addHandler(_Print())
    log.setLevel({-1: logging.WARNING, 0: logging.INFO}.get(verbosity, logging.DEBUG))
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.INFO if verbosity > 0 else logging.WARNING)


class _Print(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), flush=True)


class Board:
    """A table with a row an arm: how far it is, how fast, how good, how long still.

    Drawn where somebody watches; what is printed meanwhile appears above it. A board that nobody
    watches draws nothing.

    Args:
        console: to draw on; by default the terminal, if standard output is one.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console()
        self.rows: dict[str, dict[str, str]] = {}
        watched = self.console.is_terminal and log.isEnabledFor(logging.INFO)
        self._live = Live(console=self.console, auto_refresh=False) if watched else None
        self._drawn = 0.0

    @property
    def watched(self) -> bool:
        """Whether anything is drawn."""
        return self._live is not None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.update(self.table(), refresh=True)
            self._live.__exit__(kind, error, trace)

    def update(self, arm: str, **cells: str) -> None:
        """Change cells of an arm's row; drawn a few times a second at most."""
        self.rows.setdefault(arm, {}).update({k.replace("_", " "): v for k, v in cells.items()})
        if self._live is not None and time.monotonic() - self._drawn > EVERY:
            self._drawn = time.monotonic()
            self._live.update(self.table(), refresh=True)

    def table(self) -> Table:
        """The rows as they are now."""
        table = Table("arm", box=None, pad_edge=False, header_style="bold")
        for name in COLUMNS:
            table.add_column(name, justify="right", no_wrap=True)
        for arm, cells in self.rows.items():
            table.add_row(arm, *(cells.get(name, "") for name in COLUMNS))
        return table


class Progress(Callback):
    """Keeps an arm's row of a board up to date.

    Args:
        board: the board.
        arm: name of the row.
        curve: what counts pairs and seconds.
    """

    def __init__(self, board: Board, arm: str, curve: Curve) -> None:
        self.board, self.arm, self.curve = board, arm, curve
        self._began: tuple[float, int, int] | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """From here on the speed counts: a resumed run has pairs and steps before it."""
        self._began = time.monotonic(), self.curve.pairs, trainer.global_step

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: object,
        batch: PairBatch,
        batch_idx: int,
    ) -> None:
        """Speed, loss and time left."""
        if not self.board.watched or self._began is None:
            return
        began, pairs, steps = self._began
        seconds = max(time.monotonic() - began, 1e-9)
        step, total = trainer.global_step, trainer.estimated_stepping_batches
        known = math.isfinite(total)  # a run may end by the clock alone
        left = seconds / max(step - steps, 1) * (total - step)
        values = trainer.callback_metrics
        self.board.update(
            self.arm,
            step=f"{step}/{total:.0f}" if known else str(step),
            epoch=str(trainer.current_epoch),
            **{"pairs/s": f"{(self.curve.pairs - pairs) / seconds:.0f}"},
            loss=f"{float(values['train/loss']):.4f}",
            time_left=clock(left) if known else "",
            matches=f"{float(values['train/matches']):.1%}" if "train/matches" in values else "",
        )

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """What validation says."""
        if self.curve.points:
            error = self.curve.points[-1]["rotation_error_deg_mean"]
            self.board.update(self.arm, rotation_error=f"{error:.2f}°")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Done."""
        self.board.update(self.arm, time_left=f"done in {clock(self.curve.seconds)}")


def clock(seconds: float) -> str:
    """Seconds as 1:02:03 or 2:03."""
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{left:02d}" if hours else f"{minutes}:{left:02d}"
