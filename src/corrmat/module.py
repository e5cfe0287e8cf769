"""The Lightning module of every method: one training, validation and test step."""

from dataclasses import dataclass
from typing import Literal

import lightning as L
import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from corrmat.errors import CorrmatError, DivergedError, check_choices
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
        warmup: share of a one-cycle run in which the rate rises.
        freeze_norms: share of the run after which batch norms no longer follow their batches but
            use their running statistics, as in a test. 1 is never, as in the paper.
    """

    lr: float = 1e-3
    weight_decay: float = 1e-4
    schedule: Literal["step", "onecycle"] = "step"
    milestones: tuple[int, ...] = (25, 50, 100, 150, 200)
    gamma: float = 0.25
    warmup: float = 0.1
    freeze_norms: float = 1.0

    def __post_init__(self) -> None:
        check_choices(self)
        checks = {
            "lr": self.lr > 0,
            "weight_decay": self.weight_decay >= 0,
            "gamma": self.gamma > 0,
            "warmup": 0 < self.warmup < 1,
            "freeze_norms": 0 <= self.freeze_norms <= 1,
        }
        for name, valid in checks.items():
            if not valid:
                raise CorrmatError(f"{name} = {getattr(self, name)} is out of range")


class RegistrationModule(L.LightningModule):
    """A network and its optimizer; a loss mixin of `corrmat.losses` in front makes it a method.

    Args:
        network: a module that satisfies `types.RegistrationNetwork`.
        optimizer: settings of Adam and its schedule.
    """

    def __init__(self, network: nn.Module, optimizer: OptimizerSettings) -> None:
        super().__init__()
        self.network = network
        self.optimizer_settings = optimizer
        self._last_loss: Tensor | None = None
        # Synchronised by hand: a test runs in one process, even after a distributed training.
        self.metrics = RegistrationMetrics(sync_on_compute=False)

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """Compute the training loss; a loss mixin overrides this."""
        raise NotImplementedError(
            f"{type(self).__name__} has no loss: name a mixin of corrmat.losses before Method "
            "in the class's bases"
        )

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Predict the transforms of source (B, N, C) onto target (B, M, C)."""
        return self.network(source, target)

    def on_train_batch_start(self, batch: PairBatch, batch_index: int) -> None:
        """Freeze the statistics of the batch norms from a share of the run on."""
        freeze_at = self.optimizer_settings.freeze_norms * self.trainer.estimated_stepping_batches
        if self.global_step >= freeze_at:
            for module in self.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()

    def training_step(self, batch: PairBatch, batch_index: int) -> Tensor:
        """Compute the loss of a batch; log it and the correct matches where Lightning logs.

        Raises:
            DivergedError: the loss is not finite. A GPU has to be waited for to know this, so that
                it is only asked at the steps that are logged, and before each validation.
        """
        prediction = self(batch.source, batch.target)
        loss = self.loss(prediction, batch)
        self._last_loss = loss.detach()
        is_logged = self._is_logged_step()
        if is_logged or loss.device.type == "cpu":
            self.require_finite_loss(f"batch {batch_index}, shapes {batch.shape.tolist()}")
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch))
        if is_logged and prediction.correspondence is not None:
            predicted = prediction.correspondence.argmax()
            accuracy = match_accuracy(predicted, batch.match, batch.target.shape[1])
            self.log("train/matches", accuracy, prog_bar=True, batch_size=len(batch))
        return loss

    def _is_logged_step(self) -> bool:
        """Tell whether Lightning writes what this step logs; without a Trainer, every step."""
        every = getattr(self._trainer, "log_every_n_steps", 1)
        return every < 2 or (self.global_step + 1) % every == 0

    def require_finite_loss(self, where: str) -> None:
        """Reject a last loss that is not finite."""
        if self._last_loss is not None and not torch.isfinite(self._last_loss):
            raise DivergedError(
                f"the loss is {self._last_loss.item()} at step {self.global_step} (epoch "
                f"{self.current_epoch}, {where}); lower --optimizer.lr or clip gradients"
            )

    def on_validation_start(self) -> None:
        """Check the last loss, so that no checkpoint keeps weights that are not finite."""
        self.require_finite_loss("before validation")

    def validation_step(self, batch: PairBatch, batch_index: int) -> None:
        """Collect the predictions of a batch."""
        self.metrics.update(self(batch.source, batch.target), batch)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of all validation pairs."""
        self._log_metrics("val")

    def test_step(self, batch: PairBatch, batch_index: int) -> None:
        """Collect the predictions of a batch."""
        self.metrics.update(self(batch.source, batch.target), batch)

    def on_test_epoch_end(self) -> None:
        """Log the metrics of all test pairs."""
        self._log_metrics("test")

    def _log_metrics(self, stage: str) -> None:
        """Log the metrics of all pairs seen as `<stage>/<name>`, then forget the pairs."""
        if self.trainer.world_size > 1:
            self.metrics.sync()
        values = self.metrics.compute()
        self.metrics.reset()
        for name, value in values.items():
            in_progress_bar = name == "rotation_error_deg_mean"
            self.log(f"{stage}/{name}", value, prog_bar=in_progress_bar, sync_dist=True)

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Build Adam and the schedule of its learning rate."""
        settings = self.optimizer_settings
        adam = torch.optim.Adam(
            self.parameters(), settings.lr, weight_decay=settings.weight_decay, fused=True
        )
        if settings.schedule == "step":
            rate = torch.optim.lr_scheduler.MultiStepLR(
                adam, list(settings.milestones), settings.gamma
            )
            return {"optimizer": adam, "lr_scheduler": {"scheduler": rate, "interval": "epoch"}}
        steps = int(self.trainer.estimated_stepping_batches)
        rate = torch.optim.lr_scheduler.OneCycleLR(
            adam, settings.lr, total_steps=steps, pct_start=settings.warmup
        )
        return {"optimizer": adam, "lr_scheduler": {"scheduler": rate, "interval": "step"}}
