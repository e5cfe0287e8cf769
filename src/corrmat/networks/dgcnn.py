"""DGCNN's edge convolutions over one fixed neighbour graph, as DCP's released code has them."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.networks.edges import Edges, Moments, folded, linear_relu_max, moments, output_moments
from corrmat.ops.neighbors import knn, take


class DGCNN(nn.Module):
    """Per-point features from edge convolutions on the k-nearest-neighbour graph.

    Args:
        width: feature dimension of the output.
        channels: output widths of the edge convolutions.
        k: neighbours of each point, itself included.
    """

    def __init__(
        self, width: int = 512, channels: tuple[int, ...] = (64, 64, 128, 256), k: int = 20
    ) -> None:
        super().__init__()
        self.k = k
        self.edge = nn.ModuleList(
            EdgeConvolution(i, o) for i, o in zip((6, *channels[:-1]), channels, strict=True)
        )
        self.fuse = nn.Linear(sum(channels), width, bias=False)
        self.norm = nn.BatchNorm1d(width)

    def forward(self, points: Tensor) -> Tensor:
        """Features (B, N, width) of points (B, N, 3)."""
        rows = edge_features(points, knn(points, self.k))
        seen = moments(rows) if self.training else None
        pooled = []
        for layer in self.edge:
            edges = layer(rows, seen, last=layer is self.edge[-1])
            rows, seen = edges.rows, edges.moments
            pooled.append(edges.top)
        features = self.norm(self.fuse(torch.cat(pooled, -1)[0]))
        return F.relu(features).unflatten(0, points.shape[:2])


def edge_features(points: Tensor, neighbors: Tensor) -> Tensor:
    """Concatenate each neighbour with its centre (not with their difference).

    Args:
        points: (B, N, 3).
        neighbors: (B, N, k) indices into the N points.

    Returns:
        (1, B * N, k, 6), neighbours first: to a batch norm the batch is one sample.
    """
    neighbor = take(points, neighbors)
    centre = points.unsqueeze(2).expand_as(neighbor)
    return torch.cat([neighbor, centre], -1).flatten(0, 1).unsqueeze(0)


class _TrackingNorm(nn.BatchNorm1d):
    """Batch norm's parameters and statistics, known to be there."""

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float


class EdgeConvolution(nn.Module):
    """Linear without bias, batch norm, ReLU, and the maximum over the neighbours.

    Equal to `relu(batch_norm(x @ W.T))` followed by an `amax`, with batch norm's own running
    statistics; see `edges` for how.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = _TrackingNorm(outputs)

    def forward(self, rows: Tensor, seen: Moments | None, last: bool = False) -> Edges:
        """Edges (1, P, k, inputs) and, in training, their moments -> activations and maximum.

        The last layer's activations are not kept.
        """
        norm = self.norm
        if seen is not None:
            mean, variance = output_moments(self.linear, seen)
            self._track(mean[0], variance[0], rows.shape[1] * rows.shape[2])
        else:
            mean, variance = norm.running_mean.double()[None], norm.running_var.double()[None]
        layer = folded(self.linear, norm, mean, variance)
        return linear_relu_max(rows, layer, keep=not last, gather=self.training and not last)

    @torch.no_grad()
    def _track(self, mean: Tensor, variance: Tensor, count: int) -> None:
        norm = self.norm
        norm.num_batches_tracked.add_(1)
        norm.running_mean.lerp_(mean.to(norm.running_mean.dtype), norm.momentum)
        unbiased = variance * (count / max(count - 1, 1))
        norm.running_var.lerp_(unbiased.to(norm.running_var.dtype), norm.momentum)
