"""The one training, validation and test step of every method."""

from dataclasses import dataclass
from typing import Any, Literal

import lightning as L
import torch
from torch import Tensor, nn

from corrmat.errors import CorrmatError
from corrmat.metrics import RegistrationMetrics, match_accuracy
from corrmat.types import PairBatch, Prediction


@dataclass(frozen=True)
class OptimizerSettings:
    """Adam and its schedule; the defaults are DCP's, as released.

    Args:
        lr: learning rate; the peak of a one-cycle schedule.
        weight_decay: L2 penalty, as in torch's Adam.
        schedule: "step" multiplies the rate by `gamma` at each of `milestones`;
            "onecycle" warms up and anneals over the whole run, step by step.
        milestones: epochs.
        gamma: factor.
        warmup: share of a one-cycle run that the rate rises in.
    """

    lr: float = 1e-3
    weight_decay: float = 1e-4
    schedule: Literal["step", "onecycle"] = "step"
    milestones: tuple[int, ...] = (25, 50, 100, 150, 200)
    gamma: float = 0.25
    warmup: float = 0.1

    def __post_init__(self) -> None:
        checks = {
            "lr": self.lr > 0,
            "weight_decay": self.weight_decay >= 0,
            "gamma": self.gamma > 0,
            "warmup": 0 < self.warmup < 1,
        }
        for name, fine in checks.items():
            if not fine:
                raise CorrmatError(f"{name} = {getattr(self, name)} is out of range")


class RegistrationModule(L.LightningModule):
    """A network and its optimizer; a loss mixin in front of it makes a method.

    Args:
        network: (source, target) -> Prediction.
        optimizer: settings.
    """

    def __init__(self, network: nn.Module, optimizer: OptimizerSettings) -> None:
        super().__init__()
        self.network = network
        self.optimizer = optimizer
        self.metrics = RegistrationMetrics()

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """What is minimised: a mixin of `losses` says it."""
        raise NotImplementedError(f"{type(self).__name__} has no loss mixin")

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """The network's prediction."""
        return self.network(source, target)

    def training_step(self, batch: PairBatch, batch_index: int) -> Tensor:
        """One step; stops where the loss is no longer a number."""
        prediction = self(batch.source, batch.target)
        loss = self.loss(prediction, batch)
        if not torch.isfinite(loss):
            raise CorrmatError(
                f"the loss is {loss.item()} at step {self.global_step} (epoch "
                f"{self.current_epoch}, batch {batch_index}, shapes {batch.shape.tolist()}); "
                "lower --optimizer.lr or clip gradients"
            )
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch))
        if prediction.correspondence is not None:
            hits = match_accuracy(
                prediction.correspondence.argmax(), batch.match, batch.target.shape[1]
            )
            self.log("train/matches", hits.mean().float(), prog_bar=True, batch_size=len(batch))
        return loss

    def validation_step(self, batch: PairBatch, batch_index: int) -> None:
        """Keep what was predicted."""
        self.metrics.update(self(batch.source, batch.target), batch)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of all validation pairs."""
        values = self.metrics.compute()
        self.metrics.reset()
        for name, value in values.items():
            shown = name == "rotation_error_deg_mean"
            self.log(f"val/{name}", value, prog_bar=shown, sync_dist=True)

    def test_step(self, batch: PairBatch, batch_index: int) -> None:
        """Keep what was predicted; the caller reads `metrics` and resets it."""
        self.metrics.update(self(batch.source, batch.target), batch)

    def configure_optimizers(self) -> Any:  # noqa: ANN401 (Lightning's many forms)
        """Adam with the schedule of the settings."""
        how = self.optimizer
        adam = torch.optim.Adam(
            self.parameters(), how.lr, weight_decay=how.weight_decay, fused=True
        )
        if how.schedule == "step":
            rate = torch.optim.lr_scheduler.MultiStepLR(adam, list(how.milestones), how.gamma)
            return {"optimizer": adam, "lr_scheduler": {"scheduler": rate, "interval": "epoch"}}
        steps = int(self.trainer.estimated_stepping_batches)
        rate = torch.optim.lr_scheduler.OneCycleLR(
            adam, how.lr, total_steps=steps, pct_start=how.warmup
        )
        return {"optimizer": adam, "lr_scheduler": {"scheduler": rate, "interval": "step"}}
