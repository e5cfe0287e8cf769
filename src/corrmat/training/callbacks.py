"""Lightning callbacks: validation history, atomic checkpoints, and what Ctrl-C does."""

import contextlib
import io
import logging
import math
import os
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from corrmat.files import replace_bytes
from corrmat.module import RegistrationModule
from corrmat.types import PairBatch

log = logging.getLogger("corrmat")
CURVE_METRICS = (
    "match_accuracy",
    "rotation_error_deg_mean",
    "rotation_error_deg_median",
    "relative_euler_rmse_deg",
    "naive_euler_rmse_deg",
    "translation_rmse",
    "chamfer",
)


class MovableCheckpoint(ModelCheckpoint):
    """A ModelCheckpoint that still knows the best weights after its folder was moved.

    Lightning's forgets their score then, and the next weights replace them, however bad.
    """

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take up the state of an interrupted run, its paths changed to today's folder."""

        def here(path: str) -> str:
            return str(Path(str(self.dirpath)) / Path(path).name) if path else path

        paths = ("best_model_path", "kth_best_model_path", "last_model_path")
        moved = {name: here(state_dict[name]) for name in paths}
        best = {here(path): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict(
            state_dict | moved | {"best_k_models": best, "dirpath": self.dirpath}
        )


class ValidationHistory(Callback):
    """Collects validation metrics against training pairs seen, as the paper's figures show them."""

    def __init__(self) -> None:
        self.pairs_seen, self.seconds = 0, 0.0
        self.points: list[dict[str, float]] = []
        self._losses: list[Tensor] = []
        self._last_tick: float | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._last_tick = time.monotonic()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Tensor | Mapping[str, Any] | None,
        batch: PairBatch,
        batch_idx: int,
    ) -> None:
        """Count pairs and collect the loss."""
        assert isinstance(outputs, Mapping)
        self.pairs_seen += len(batch) * trainer.world_size
        # Lightning has divided it by the batches of a step.
        self._losses.append(outputs["loss"].detach() * trainer.accumulate_grad_batches)
        if trainer.global_step >= trainer.estimated_stepping_batches:
            trainer.should_stop = True  # so that the last weights are validated too

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Add a point to the history, and print it."""
        if trainer.sanity_checking or not self._losses:
            return
        self._tick()
        values = {
            name.removeprefix("val/"): float(value)
            for name, value in trainer.callback_metrics.items()
            if name.startswith("val/")
        }
        # Losses restored from a checkpoint are on the CPU, whatever device trains.
        losses = torch.stack([loss.to(pl_module.device) for loss in self._losses])
        loss = float(trainer.strategy.reduce(losses.mean()))
        self._losses.clear()
        point = {"pairs_seen": self.pairs_seen, "loss": loss}
        self.points.append(point | {name: values[name] for name in CURVE_METRICS})
        accuracy = values["match_accuracy"]
        matches = "" if math.isnan(accuracy) else f"matches {100 * accuracy:5.1f} %  "
        log.info(
            f"step {trainer.global_step:6d}  {self.pairs_seen:7,d} pairs  {self.seconds:5.0f} s  "
            f"loss {loss:7.4f}  {matches}"
            f"rotation {values['rotation_error_deg_mean']:7.2f} deg mean, "
            f"{values['rotation_error_deg_median']:6.2f} median"
        )

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop the clock."""
        self._tick()
        self._last_tick = None

    def state_dict(self) -> dict[str, Any]:
        """Return the history for a checkpoint, so that a resumed run has all of it."""
        self._tick()
        losses = [float(loss) for loss in self._losses]
        return {
            "pairs_seen": self.pairs_seen, "seconds": self.seconds, "points": self.points,
            "losses": losses,
        }  # fmt: skip

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the history from a checkpoint."""
        self.pairs_seen, self.seconds = state_dict["pairs_seen"], state_dict["seconds"]
        self.points = state_dict["points"]
        self._losses = [torch.tensor(loss) for loss in state_dict["losses"]]

    def _tick(self) -> None:
        """Add the time since the last call to `seconds`."""
        if self._last_tick is not None:
            now = time.monotonic()
            self.seconds += now - self._last_tick
            self._last_tick = now


class PerPairCollector(Callback):
    """Keeps the per-pair values of a test, before the module logs their summary."""

    def __init__(self) -> None:
        self.per_pair: dict[str, Tensor] = {}

    def on_test_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Score the predictions."""
        assert isinstance(pl_module, RegistrationModule)
        self.per_pair = pl_module.metrics.per_pair()


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints beside their place and renames them.

    Lightning writes through the folder of temporary files, which may lie on another disk: a full
    disk or `kill -9` would then destroy the previous checkpoint.
    """

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: str | os.PathLike[str],
        storage_options: object = None,
    ) -> None:
        """Write a checkpoint atomically."""
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        replace_bytes(Path(path), content.getbuffer())


class SaveOnInterrupt(Callback):
    """Makes Ctrl-C and SIGTERM stop between two steps, with a checkpoint to continue from.

    The signal only sets `stop_requested`. Training then stops after a step that no validation
    follows, with a checkpoint of its own; or before the step after a validation, which has just
    written one. A second Ctrl-C stops at once. If no step is left, training ends as usual.

    Args:
        path: of the checkpoint.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stop_requested = False
        self._just_validated = False
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Install the signal handlers, where that is possible, instead of Lightning's.

        Lightning's own handler of SIGTERM stops without a checkpoint, as if all had gone well.
        """
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._request_stop)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: PairBatch, batch_idx: int
    ) -> None:
        """Stop before the step after a validation."""
        if self.stop_requested and self._just_validated:
            raise KeyboardInterrupt
        self._just_validated = False

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: object,
        batch: PairBatch,
        batch_idx: int,
    ) -> None:
        """Stop after a whole step that no validation follows."""
        whole_step = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        if self.stop_requested and whole_step and not _validation_follows(trainer, batch_idx):
            if trainer.world_size == 1:
                assert isinstance(pl_module, RegistrationModule)
                pl_module.require_finite_loss("in the last step")
                trainer.save_checkpoint(self.path)
            for logger in trainer.loggers:
                logger.save()
            raise KeyboardInterrupt

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Note that a checkpoint of these weights is about to be written."""
        self._just_validated = not trainer.sanity_checking

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Say how to continue."""
        self._restore_handlers()
        if isinstance(exception, KeyboardInterrupt):
            if self.path.is_file():
                log.info(f"interrupted at step {trainer.global_step}; checkpoint: {self.path}")
                log.info("the same command, without --fresh, continues from there")
            else:
                log.info(f"interrupted at step {trainer.global_step}, before the first checkpoint")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Restore the previous signal handlers."""
        self._restore_handlers()

    def _request_stop(self, number: int, frame: object) -> None:
        """Handle a signal: the second one stops at once."""
        if self.stop_requested:
            raise KeyboardInterrupt
        self.stop_requested = True
        # A signal that comes while a line is printed cannot print another: RuntimeError.
        with contextlib.suppress(RuntimeError):
            log.info("stopping after this step (Ctrl-C again stops at once)")

    def _restore_handlers(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()


def _validation_follows(trainer: L.Trainer, batch_idx: int) -> bool:
    """Tell whether Lightning validates after this batch, or the epoch ends."""
    if trainer.should_stop or trainer.is_last_batch:
        return True
    over_epochs = trainer.check_val_every_n_epoch is None
    batches = 1 + (trainer.fit_loop.total_batch_idx if over_epochs else batch_idx)
    return batches % int(trainer.val_check_batch or 1) == 0
