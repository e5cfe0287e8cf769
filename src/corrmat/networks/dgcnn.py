"""DGCNN (Wang et al., TOG 2019) over one fixed neighbour graph, as DCP's released code has it."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.errors import require_positive
from corrmat.ops import edge_mlp
from corrmat.ops.neighbors import gather_points, knn


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
        require_positive(k=k, width=width, channels=min(channels, default=0))
        self.k = k
        self.edge = nn.ModuleList(
            EdgeConvolution(i, o) for i, o in zip((6, *channels[:-1]), channels, strict=True)
        )
        self.fuse = nn.Linear(sum(channels), width, bias=False)
        self.norm = nn.BatchNorm1d(width)

    def forward(self, points: Tensor) -> Tensor:
        """Compute features (B, N, width) of points (B, N, 3)."""
        edges = edge_features(points, knn(points, self.k)).flatten(0, 1)  # (B * N, k, 6)
        if edge_mlp.is_worthwhile(edges):
            linears, norms = zip(*((layer.linear, layer.norm) for layer in self.edge), strict=True)
            follow_batches = self.norm.training  # norms may be frozen in training
            pooled = edge_mlp.batch_norm_edge_mlp(edges, linears, norms, training=follow_batches)
        else:
            pooled = []
            for layer in self.edge:
                edges = layer(edges)
                pooled.append(edges.amax(dim=1))  # over the neighbours
        features = F.relu(self.norm(self.fuse(torch.cat(pooled, dim=-1))))
        return features.unflatten(0, points.shape[:2])


class EdgeConvolution(nn.Module):
    """Linear layer without bias, batch norm and ReLU on every edge."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, edges: Tensor) -> Tensor:
        """Map edges (P, k, inputs) to (P, k, outputs)."""
        out = self.norm(self.linear(edges).flatten(0, 1))
        return F.relu(out).unflatten(0, edges.shape[:2])


def edge_features(points: Tensor, neighbors: Tensor) -> Tensor:
    """Concatenate each neighbour with its centre (not with their difference).

    Args:
        points: (B, N, 3).
        neighbors: (B, N, k) indices into the N points.

    Returns:
        (B, N, k, 6), the neighbour's coordinates first.
    """
    neighbor = gather_points(points, neighbors)
    centre = points.unsqueeze(2).expand_as(neighbor)
    return torch.cat([neighbor, centre], dim=-1)
