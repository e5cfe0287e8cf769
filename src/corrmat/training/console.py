"""Progress of a run: a live table on a terminal, plain lines elsewhere."""

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

from corrmat.training.callbacks import ValidationHistory
from corrmat.types import PairBatch

log = logging.getLogger("corrmat")
COLUMNS = ("step", "epoch", "pairs/s", "loss", "matches", "rotation error", "time left")
REFRESH = 0.25  # seconds between two drawings


def print_messages(verbosity: int) -> None:
    """Print the package's messages: only warnings (-1), progress too (0), Lightning's too (1)."""
    for handler in [h for h in log.handlers if isinstance(h, _PrintHandler)]:
        log.removeHandler(handler)
    log.addHandler(_PrintHandler())
    log.setLevel({-1: logging.WARNING, 0: logging.INFO}.get(verbosity, logging.DEBUG))
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.INFO if verbosity > 0 else logging.WARNING)


class _PrintHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), flush=True)


class Board:
    """A live table with a row an arm: progress, speed, errors and time left.

    It is drawn on a terminal; lines printed meanwhile appear above it. Elsewhere nothing is drawn.

    Args:
        console: to draw on; standard output by default.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console()
        self.rows: dict[str, dict[str, str]] = {}
        visible = self.console.is_terminal and log.isEnabledFor(logging.INFO)
        self._live = Live(console=self.console, auto_refresh=False) if visible else None
        self._last_drawn = 0.0

    @property
    def is_visible(self) -> bool:
        """Whether anything is drawn."""
        return self._live is not None

    @property
    def is_due(self) -> bool:
        """Whether it is time to draw again."""
        return self.is_visible and time.monotonic() - self._last_drawn > REFRESH

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
        """Change cells of an arm's row; the board is drawn a few times a second at most."""
        self.rows.setdefault(arm, {}).update({k.replace("_", " "): v for k, v in cells.items()})
        if self._live is not None and self.is_due:
            self._last_drawn = time.monotonic()
            self._live.update(self.table(), refresh=True)

    def table(self) -> Table:
        """Build the table of the current rows."""
        table = Table("arm", box=None, pad_edge=False, header_style="bold")
        for name in COLUMNS:
            table.add_column(name, justify="right", no_wrap=True)
        for arm, cells in self.rows.items():
            table.add_row(arm, *(cells.get(name, "") for name in COLUMNS))
        return table


class BoardProgress(Callback):
    """Keeps an arm's row of a board up to date.

    Args:
        board: the board.
        arm: name of the row.
        history: counts pairs and seconds.
    """

    def __init__(self, board: Board, arm: str, history: ValidationHistory) -> None:
        self.board, self.arm, self.history = board, arm, history
        self._start: tuple[float, int, int] | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start measuring speed: a resumed run has pairs and steps before this."""
        self._start = time.monotonic(), self.history.pairs_seen, trainer.global_step

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: object,
        batch: PairBatch,
        batch_idx: int,
    ) -> None:
        """Update speed, loss and time left."""
        step, total = trainer.global_step, trainer.estimated_stepping_batches
        is_shown = self.board.is_due or (self.board.is_visible and step == total)
        if not is_shown or self._start is None:
            return  # before the loss is read: a GPU would have to be waited for
        start, pairs, steps = self._start
        seconds = max(time.monotonic() - start, 1e-9)
        finite = math.isfinite(total)  # a run may end by the clock alone
        left = seconds / max(step - steps, 1) * (total - step)
        values = trainer.callback_metrics
        self.board.update(
            self.arm,
            step=f"{step}/{total:.0f}" if finite else str(step),
            epoch=str(trainer.current_epoch),
            **{"pairs/s": f"{(self.history.pairs_seen - pairs) / seconds:.0f}"},
            loss=f"{float(values['train/loss']):.4f}",
            time_left=clock(left) if finite else "",
            matches=f"{float(values['train/matches']):.1%}" if "train/matches" in values else "",
        )

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show the validation error."""
        if self.history.points:
            error = self.history.points[-1]["rotation_error_deg_mean"]
            self.board.update(self.arm, rotation_error=f"{error:.2f}°")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show the training time."""
        self.board.update(self.arm, time_left=f"done in {clock(self.history.seconds)}")


def clock(seconds: float) -> str:
    """Format seconds as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
