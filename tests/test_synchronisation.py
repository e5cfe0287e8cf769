"""A training step must not wait for the device: on a GPU the host would fall behind."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from corrmat.data.pairs import Key, PairSettings, make_pairs
from corrmat.data.shapes import dataset
from corrmat.methods import METHODS

SMALL = {
    "DCP": {"width": 32, "feedforward": 32, "edge_channels": (8, 8, 16, 16), "k": 8},
    "RPMNet": {"width": 8, "k": 4, "annealing_width": 32},
    "PCRNet": {"width": 32},
    "Invariant": {"width": 32, "layers": 1, "anchors": 8, "neighbors": 4},
}
# Operators that hand a value or a shape back to the host.
WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "_unique2", "equal")


class WaitingOperators(TorchDispatchMode):
    """Collects the operators that a GPU's host would have to wait for."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        if name in WAITING:
            self.names.append(name)
        return function(*args, **(kwargs or {}))


def test_waiting_operators_are_seen():
    with WaitingOperators() as waiting:
        torch.ones(3).nonzero()
        torch.ones(()).item()
    assert waiting.names == ["nonzero", "_local_scalar_dense"]


@pytest.mark.parametrize("outlier", [None, "least_squares", "dustbin", "matchability"])
@pytest.mark.parametrize("name", METHODS)
def test_forward_loss_and_backward_never_wait_for_the_device(name, outlier):
    family = name.removesuffix("_corr")
    if outlier is not None and name != "DCP_corr":
        pytest.skip("only DCP has outlier classes")
    hparams = SMALL[family] | ({} if outlier is None else {"outlier": outlier})
    method = METHODS[name](hparams).train()
    settings = PairSettings(num_points=48, keep=0.7)
    pairs = make_pairs(dataset.load("test", 2), [0, 1], [Key(0, 0, 0, i) for i in (0, 1)], settings)
    with WaitingOperators() as waiting:
        method.loss(method(pairs.source, pairs.target), pairs).backward()
    assert not waiting.names
