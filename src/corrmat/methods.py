"""The paper's methods: a loss, the one module, a network. No arguments: the paper's settings."""

from corrmat.losses import CorrespondenceLoss, TransformationLoss
from corrmat.module import OptimizerSettings, RegistrationModule
from corrmat.networks.dcp import DCPNetwork


class _DCP(RegistrationModule):
    """DCP's network, with DCP's optimizer."""

    network_type = DCPNetwork

    def __init__(
        self, network: DCPNetwork | None = None, optimizer: OptimizerSettings | None = None
    ) -> None:
        super().__init__(network or DCPNetwork(), optimizer or OptimizerSettings())


class DCP(TransformationLoss, _DCP):
    """Deep Closest Point, trained on the error of the transform."""


class DCPCorr(CorrespondenceLoss, _DCP):
    """Deep Closest Point, trained on the correspondence matrix."""


METHODS: dict[str, type[_DCP]] = {"DCP": DCP, "DCP_corr": DCPCorr}
