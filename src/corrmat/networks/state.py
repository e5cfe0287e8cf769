"""Load tensors by name into a network."""

from torch import Tensor, nn

from corrmat.errors import CorrmatError

State = dict[str, Tensor]


def load_state(network: nn.Module, state: State) -> nn.Module:
    """Load a state into a network, or name every parameter that does not fit."""
    expected = network.state_dict()
    wrong = [f"{name} is missing" for name in expected if name not in state]
    wrong += [f"{name} is unknown" for name in state if name not in expected]
    wrong += [
        f"{name} is {_shape(state[name])}, not {_shape(tensor)}"
        for name, tensor in expected.items()
        if name in state and _shape(state[name]) != _shape(tensor)
    ]
    if wrong:
        more = f"; and {len(wrong) - 8} more" if len(wrong) > 8 else ""
        raise CorrmatError(f"the checkpoint does not fit: {'; '.join(wrong[:8])}{more}")
    network.load_state_dict({name: state[name].view_as(t) for name, t in expected.items()})
    return network.eval()


def _shape(tensor: Tensor) -> tuple[int, ...]:
    """Drop trailing ones, by which a 1 x 1 convolution differs from a linear layer."""
    shape = list(tensor.shape)
    while shape and shape[-1] == 1:
        shape.pop()
    return tuple(shape)
