"""Shared MLPs (the same layers for every point) and PointNet."""

from collections.abc import Callable, Iterable, Sequence

import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.ops.edge_mlp import linear_max

Norm = Callable[[int], nn.Module]


def shared_mlp(channels: Sequence[int], norm: Norm) -> nn.Sequential:
    """Build a shared MLP (1 x 1 convolution, norm, ReLU a layer) on tensors (B, channels, L).

    Args:
        channels: width of the input and of every layer.
        norm: builds a layer's norm from its width.
    """
    layers: list[nn.Module] = []
    for inputs, outputs in zip(channels, channels[1:], strict=False):
        layers += [nn.Conv1d(inputs, outputs, 1), norm(outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class PointNet(nn.Module):
    """PointNet's five layers, 64-64-64-128-width: per-point features (Qi et al., CVPR 2017).

    It runs linear layers on rows of points: on CPUs a third faster than 1 x 1 convolutions.

    Without norms, weights start so that every layer keeps the size of its input
    (`keep_signal_size`).

    Args:
        width: feature dimension.
        norm: builds a layer's norm from its width; None for no norms.
        bias: whether the linear layers have one.
    """

    def __init__(self, width: int = 1024, norm: Norm | None = None, bias: bool = True) -> None:
        super().__init__()
        channels = (3, 64, 64, 64, 128, width)
        layers: list[nn.Module] = []
        for inputs, outputs in zip(channels, channels[1:], strict=False):
            layers.append(nn.Linear(inputs, outputs, bias=bias))
            layers += [norm(outputs)] if norm else []
            layers.append(nn.ReLU(inplace=True))
        self.layers = nn.Sequential(*layers)
        if norm is None:
            keep_signal_size(self.layers)

    def forward(self, points: Tensor) -> Tensor:
        """Map points (B, N, 3) to features (B, N, width)."""
        return self.layers(points.flatten(0, 1)).unflatten(0, points.shape[:2])

    def pooled(self, points: Tensor) -> Tensor:
        """Compute the maximum of the features over a cloud's points: (B, N, 3) to (B, width).

        Only for a network without norms.
        """
        narrow, widest = self.layers[:-2], self.layers[-2]
        assert isinstance(widest, nn.Linear)
        features = narrow(points.flatten(0, 1)).unflatten(0, points.shape[:2])
        return F.relu(linear_max(features, widest))


def keep_signal_size(layers: Iterable[nn.Module]) -> None:
    """Initialise linear layers before a ReLU as He et al. (ICCV 2015).

    torch's default shrinks the signal to 0.4 of its size a layer. After ten layers without norms,
    what comes out hardly depends on what goes in.
    """
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
