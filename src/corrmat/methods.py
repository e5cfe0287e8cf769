"""The paper's methods: a loss, the one module, a network. No arguments: the paper's settings."""

from typing import ClassVar

from torch import nn

from corrmat.losses import (
    ChamferLoss,
    CorrespondenceLoss,
    MutualLoss,
    RegistrationLoss,
    TransformationLoss,
)
from corrmat.module import OptimizerSettings, RegistrationModule
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.invariant import InvariantNetwork
from corrmat.networks.pcrnet import PCRNetCorrNetwork, PCRNetwork
from corrmat.networks.rpmnet import RPMNetwork


class Method(RegistrationModule):
    """A network and optimizer with the paper's settings, unless others are given."""

    network_type: ClassVar[type[nn.Module]]
    paper_optimizer: ClassVar[OptimizerSettings]

    def __init__(
        self, network: nn.Module | None = None, optimizer: OptimizerSettings | None = None
    ) -> None:
        super().__init__(network or self.network_type(), optimizer or self.paper_optimizer)


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
    """RPM-Net, trained on the correspondence matrix of every iteration; its rate falls to 1e-4."""

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
    """What `corrmat register` ships: no network of the paper, but its loss."""

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
