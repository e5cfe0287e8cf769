"""What happens beside the training step: the curve that figures show, checkpoints, Ctrl-C."""

import io
import logging
import math
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.plugins.precision import MixedPrecision, Precision
from lightning.pytorch.utilities import GradClipAlgorithmType
from torch import Tensor
from torch.optim import Optimizer

from corrmat.files import replace_bytes
from corrmat.types import PairBatch

SHOWN = (
    "match_accuracy",
    "rotation_error_deg_mean",
    "rotation_error_deg_median",
    "relative_euler_rmse_deg",
    "naive_euler_rmse_deg",
    "translation_rmse",
    "chamfer",
)


class Curve(Callback):
    """Collects what the paper's figures show: validation metrics against pairs seen."""

    def __init__(self) -> None:
        self.pairs, self.seconds = 0, 0.0
        self.points: list[dict[str, float]] = []
        self._losses: list[Tensor] = []
        self._since: float | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._since = time.monotonic()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,  # noqa: ANN401 (Lightning's signature)
        batch: PairBatch,
        batch_idx: int,
    ) -> None:
        """Count."""
        self.pairs += len(batch) * trainer.world_size
        self._losses.append(outputs["loss"].detach())
        if trainer.global_step >= trainer.estimated_stepping_batches:
            trainer.should_stop = True  # so that the last weights are validated too

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Add a point, and say it."""
        if trainer.sanity_checking or not self._losses:
            return
        self._tick()
        values = {
            k.removeprefix("val/"): float(v)
            for k, v in trainer.callback_metrics.items()
            if k.startswith("val/")
        }
        # Those of a checkpoint lie on the CPU, wherever training goes on.
        losses = torch.stack([loss.to(pl_module.device) for loss in self._losses])
        loss = float(trainer.strategy.reduce(losses.mean()))
        self._losses.clear()
        self.points.append({"pairs_seen": self.pairs, "loss": loss} | {k: values[k] for k in SHOWN})
        line = (
            f"step {trainer.global_step:6d}  {self.pairs:7,d} pairs  {self.seconds:5.0f} s  "
            f"loss {loss:7.4f}  {_matches(values['match_accuracy'])}"
            f"rotation {values['rotation_error_deg_mean']:7.2f} deg mean, "
            f"{values['rotation_error_deg_median']:6.2f} median"
        )
        say(line)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop the clock."""
        self._tick()
        self._since = None

    def state_dict(self) -> dict[str, Any]:
        """Goes into checkpoints, so that a resumed run has its whole curve."""
        self._tick()
        losses = [float(loss) for loss in self._losses]
        return {
            "pairs": self.pairs, "seconds": self.seconds, "points": self.points, "losses": losses,
        }  # fmt: skip

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.pairs, self.seconds = state_dict["pairs"], state_dict["seconds"]
        self.points = state_dict["points"]
        self._losses = [torch.tensor(loss) for loss in state_dict["losses"]]

    def _tick(self) -> None:
        if self._since is not None:
            now = time.monotonic()
            self.seconds += now - self._since
            self._since = now


def _matches(share: float) -> str:
    """Nothing for networks that match no points."""
    return "" if math.isnan(share) else f"matches {100 * share:5.1f} %  "


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoints are written beside their place and moved in.

    Lightning's own way goes through the folder of temporary files, which may lie on another
    disk: a full disk or `kill -9` would then cost the checkpoint that was there.
    """

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: str | os.PathLike[str],
        storage_options: Any = None,  # noqa: ANN401 (Lightning's signature)
    ) -> None:
        """Write, then move in."""
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        replace_bytes(Path(path), content.getbuffer())


class Bfloat16(MixedPrecision):
    """Autocast to bfloat16 whose gradients can be clipped though the optimizer is fused.

    Lightning refuses this for every mixed precision, because a fused step may have to undo a
    scale first; bfloat16 gradients have none.
    """

    def __init__(self, device: str) -> None:
        super().__init__("bf16-mixed", device)

    def clip_gradients(
        self,
        optimizer: Optimizer,
        clip_val: float = 0.0,
        gradient_clip_algorithm: GradClipAlgorithmType = GradClipAlgorithmType.NORM,
    ) -> None:
        """As in full precision."""
        Precision.clip_gradients(self, optimizer, clip_val, gradient_clip_algorithm)


class SaveOnInterrupt(Callback):
    """Ctrl-C or SIGTERM leaves a checkpoint between two steps and says how to go on.

    The signal is only noted; the step or validation under way is finished first, so that the
    checkpoint holds a whole number of steps. A second Ctrl-C does not wait. Where no step is left,
    training ends as usual, and `noted` says that somebody wants to stop.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.noted, self._hurried = False, False
        self._before: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take over the signals, where that is possible, from Lightning, too.

        Its own way with SIGTERM stops without a checkpoint, as if all had gone well.
        """
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: PairBatch, batch_idx: int
    ) -> None:
        """Stop here, before the step has touched anything."""
        if self.noted and batch_idx % trainer.accumulate_grad_batches == 0:
            raise KeyboardInterrupt

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Lightning calls this before it gives up."""
        self._give_back()
        if isinstance(exception, KeyboardInterrupt):
            if self.noted and not self._hurried and trainer.world_size == 1:
                # The batch under way does not count, or later validations come one too early.
                total = trainer.fit_loop.epoch_loop.batch_progress.total
                total.ready = total.completed
                trainer.save_checkpoint(self.path)
            if self.path.is_file():
                say(f"interrupted at step {trainer.global_step}; checkpoint: {self.path}")
                say("the same command goes on from there")
            else:
                say(f"interrupted at step {trainer.global_step}, before the first checkpoint")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Give the signals back."""
        self._give_back()

    def _note(self, number: int, frame: object) -> None:
        self._hurried = self.noted
        if self._hurried:
            raise KeyboardInterrupt
        self.noted = True
        say("stopping after this step (once more to stop at once)")

    def _give_back(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()


def say(text: str) -> None:
    """A line for whoever watches: see `console.listen`."""
    logging.getLogger("corrmat").info(text)
