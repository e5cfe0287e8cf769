"""The paper's methods: a loss mixin, the Lightning module and a network.

Without arguments, a method has the paper's own network, loss and optimizer. Its hyper-parameters
are plain values and are saved in every checkpoint, so `DCPCorr.load_from_checkpoint("best.ckpt")`
needs no other file.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import ClassVar

from torch import nn

from corrmat.losses import (
    ChamferLoss,
    CorrespondenceLoss,
    MutualLoss,
    NoSettings,
    RegistrationLoss,
    TransformationLoss,
)
from corrmat.module import OptimizerSettings, RegistrationModule
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.invariant import InvariantNetwork
from corrmat.networks.pcrnet import PCRNetCorrNetwork, PCRNetwork
from corrmat.networks.rpmnet import RPMNetwork

Hyperparameters = Mapping[str, object]


class Method(RegistrationModule):
    """A network, a loss and an optimizer; the defaults are the paper's.

    Args:
        network: keyword arguments of `network_type`.
        loss: fields of the loss mixin's `LossSettings`.
        optimizer: fields of `OptimizerSettings`; None for the paper's optimizer.
    """

    network_type: ClassVar[type[nn.Module]]
    paper_optimizer: ClassVar[OptimizerSettings] = OptimizerSettings()
    LossSettings: ClassVar[type] = NoSettings

    def __init__(
        self,
        network: Hyperparameters | None = None,
        loss: Hyperparameters | None = None,
        optimizer: Hyperparameters | OptimizerSettings | None = None,
    ) -> None:
        if optimizer is None:
            optimizer = self.paper_optimizer
        if not isinstance(optimizer, OptimizerSettings):
            optimizer = OptimizerSettings(**optimizer)  # pyright: ignore[reportArgumentType]
        network = dict(network or {})
        super().__init__(self.network_type(**network), optimizer)
        self.loss_settings = self.LossSettings(**(loss or {}))
        self.save_hyperparameters(logger=False)
        # Plain values only, so that torch loads a checkpoint with weights_only=True.
        self.hparams.update(
            network=network, loss=asdict(self.loss_settings), optimizer=asdict(optimizer)
        )

    def on_save_checkpoint(self, checkpoint: dict[str, object]) -> None:
        """Add the method's name, by which `weights.load_model` rebuilds it."""
        checkpoint["method"] = type(self).__name__


class DCP(TransformationLoss, Method):
    """Deep Closest Point, trained on the error of the transform."""

    network_type = DCPNetwork
    paper_optimizer = OptimizerSettings()


class DCPCorr(CorrespondenceLoss, Method):
    """Deep Closest Point, trained on the correspondence matrix."""

    network_type = DCPNetwork
    paper_optimizer = DCP.paper_optimizer


class RPMNet(RegistrationLoss, Method):
    """RPM-Net, trained on the distances of transformed points."""

    network_type = RPMNetwork
    paper_optimizer = OptimizerSettings(1e-4, 0.0, milestones=())


class RPMNetCorr(CorrespondenceLoss, Method):
    """RPM-Net, trained on every iteration's correspondence matrix; its rate decays to 1e-4."""

    network_type = RPMNetwork
    paper_optimizer = OptimizerSettings(1e-2, 0.0, milestones=(500, 750), gamma=0.1)


class PCRNet(ChamferLoss, Method):
    """PCRNet's pose network, trained on the Chamfer distance of the two clouds."""

    network_type = PCRNetwork
    paper_optimizer = OptimizerSettings(1e-3, 0.0, milestones=())


class PCRNetCorr(CorrespondenceLoss, Method):
    """PCRNet's point features, trained on the correspondence matrix."""

    network_type = PCRNetCorrNetwork
    paper_optimizer = OptimizerSettings(1e-3, 1e-4, milestones=(75, 150, 200), gamma=0.1)


class InvariantCorr(MutualLoss, Method):
    """The network that `corrmat register` ships: not the paper's, but trained on its loss."""

    network_type = InvariantNetwork
    paper_optimizer = OptimizerSettings(1e-3, 0.0, schedule="onecycle")


METHODS: dict[str, type[Method]] = {
    "DCP": DCP,
    "DCP_corr": DCPCorr,
    "RPMNet": RPMNet,
    "RPMNet_corr": RPMNetCorr,
    "PCRNet": PCRNet,
    "PCRNet_corr": PCRNetCorr,
    "Invariant_corr": InvariantCorr,
}
