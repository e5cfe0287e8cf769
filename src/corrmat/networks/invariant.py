"""The network behind `corrmat register`: DCP's idea on features that no motion changes.

DCP embeds coordinates and must learn every rotation from examples. Here the only things read of
a cloud are its pair features, how two of its points and their normals lie to each other (Drost
et al., CVPR 2010), so that whatever is learnt holds at every pose. Normals of a real cloud have
no sign, and neither have these features; they tell left from right all the same. They come in
twice: within a point's neighbourhood, and from a point to anchors all over its cloud, where
attention reads them as GeoTransformer's does between superpoints (Qin et al., CVPR 2022).
"""

import torch
from torch import Tensor, nn

from corrmat.networks.attention import Attention, FeedForward
from corrmat.networks.compare import Matchability
from corrmat.networks.ppf import SIGNLESS, signless_pair_features
from corrmat.ops.neighbors import take
from corrmat.ops.rigid import procrustes
from corrmat.types import Prediction, with_earlier


class InvariantNetwork(nn.Module):
    """Neighbourhoods, then attention within and between clouds, then matches and doubt.

    Args:
        width: feature dimension d.
        heads: attention heads.
        layers: times that a cloud looks at itself and at the other.
        anchors: points of a cloud that each of its points looks at.
        neighbors: points read of each neighbourhood.
        shares: sizes of the neighbourhoods, as shares of the cloud: what is near does not
            depend on how many points the surface was sampled with.
    """

    def __init__(
        self,
        width: int = 128,
        heads: int = 4,
        layers: int = 2,
        anchors: int = 64,
        neighbors: int = 8,
        shares: tuple[float, ...] = (0.05, 0.1, 0.2),
    ) -> None:
        super().__init__()
        self.min_points = 3
        self.anchors, self.neighbors, self.shares = anchors, neighbors, shares
        self.embed = NeighborhoodEmbedding(width, len(shares))
        self.layers = nn.ModuleList(Layer(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.compare = Matchability(width)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 6) to target (B, M, 6): xyz and unit normals of any sign."""
        if min(source.shape[-1], target.shape[-1]) < 6:
            raise ValueError("normals are needed: clouds of 6 columns, xyz and unit normal")
        x, y = source[..., :3], target[..., :3]
        scale = 2 / (radius(x) + radius(y))
        around_x, around_y = self.around(source, scale), self.around(target, scale)
        anchor_x, anchor_y = spread(x.shape[1], self.anchors), spread(y.shape[1], self.anchors)
        seen_x, seen_y = _pairs(source, anchor_x, scale), _pairs(target, anchor_y, scale)
        f_x, f_y = self.embed(around_x), self.embed(around_y)
        # What neighbourhoods alone say is trained, too: attention then has something to weigh.
        steps = [self.match(f_x, f_y, x, y)] if self.training else []
        for layer in self.layers:
            f_x, f_y = layer(f_x, f_y, seen_x, anchor_x), layer(f_y, f_x, seen_y, anchor_y)
        return with_earlier([*steps, self.match(f_x, f_y, x, y)])

    def match(self, f_x: Tensor, f_y: Tensor, x: Tensor, y: Tensor) -> Prediction:
        """The matches that features (B, N, d) and (B, M, d) of points x and y say."""
        c = self.compare(self.norm(f_x), self.norm(f_y))
        return Prediction(*procrustes(x, c.soft_target(y), c.weight()), c)

    @torch.no_grad()
    def around(self, cloud: Tensor, scale: Tensor) -> Tensor:
        """Pair features of every point's neighbourhoods, (B, N, sizes, neighbors, F)."""
        points = cloud[..., :3]
        n = points.shape[1]
        sizes = [min(n, max(2, round(share * n))) for share in self.shares]
        nearest = torch.cdist(points, points).topk(max(sizes), largest=False).indices
        ranks = torch.stack([spread(size, self.neighbors) for size in sizes])
        return _pairs(cloud, nearest[..., ranks.to(nearest.device)], scale)


def radius(points: Tensor) -> Tensor:
    """(B,) median distance of points (B, N, 3) from their centroid; few outliers do not move it."""
    centred = points - points.mean(1, keepdim=True)
    return centred.norm(dim=-1).median(1).values


def spread(size: int, count: int) -> Tensor:
    """`count` indices into `size`, even from first to last; some come twice if size < count."""
    return torch.linspace(0, size - 1, count).round().long()


@torch.no_grad()
def _pairs(cloud: Tensor, index: Tensor, scale: Tensor) -> Tensor:
    """Features (B, N, ..., F) of points (B, N, 6) to those at index (B, N, ...), or (A,) for all.

    Lengths are multiplied by scale (B,).
    """
    other = cloud[:, index].unsqueeze(1) if index.ndim == 1 else take(cloud, index)
    own = cloud[(slice(None), slice(None), *[None] * (other.ndim - 3))]
    wide = scale[(slice(None), *[None] * (other.ndim - 1))]
    offset = (other[..., :3] - own[..., :3]) * wide
    return signless_pair_features(offset, own[..., 3:6], other[..., 3:6])


class NeighborhoodEmbedding(nn.Module):
    """A point's feature: what its neighbours are to it, the mean and the most at each size.

    Args:
        width: feature dimension.
        sizes: neighbourhoods of a point.
    """

    def __init__(self, width: int, sizes: int) -> None:
        super().__init__()
        self.edge = nn.Sequential(nn.Linear(SIGNLESS, 48), nn.ReLU(inplace=True))
        self.point = FeedForward(2 * 48 * sizes, 2 * width, width)

    def forward(self, around: Tensor) -> Tensor:
        """Pair features (B, N, sizes, neighbors, F) -> (B, N, width)."""
        edges = self.edge(around)
        return self.point(torch.cat([edges.max(3).values, edges.mean(3)], -1).flatten(2))


class Layer(nn.Module):
    """Attention within the cloud, which sees pair features, and to the other; feed-forward."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.within = PairAttention(width, heads)
        self.between = Attention(width, heads)
        self.feedforward = FeedForward(width, 2 * width, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(4))

    def forward(self, x: Tensor, other: Tensor, seen: Tensor, anchors: Tensor) -> Tensor:
        """(B, N, d), (B, M, d) and pair features (B, N, A, F) to the anchors (A,) -> (B, N, d)."""
        normed = self.norms[0](x)
        x = x + self.within(normed, normed[:, anchors], seen)
        x = x + self.between(self.norms[1](x), self.norms[2](other))
        return x + self.feedforward(self.norms[3](x))


class PairAttention(nn.Module):
    """Attention whose keys and values are what two points are to each other, too.

    With r_ij the pair features: logits (q_i . k_j + p_i . r_ij) / sqrt(size), and under them the
    mean of v_j beside the mean of r_ij.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads, self.size = heads, width // heads
        self.query = nn.Linear(width, width + heads * SIGNLESS)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width + heads * SIGNLESS, width)

    def forward(self, x: Tensor, anchors: Tensor, pairs: Tensor) -> Tensor:
        """(B, N, d), (B, A, d), pair features (B, N, A, F) -> (B, N, d)."""
        width = self.heads * self.size
        q, p = self.query(x).split([width, self.heads * SIGNLESS], -1)
        k, v = self.key_value(anchors).split(width, -1)
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (q, k, v))
        geometry = p.unflatten(-1, (self.heads, -1)) @ pairs.mT  # (B, N, H, A)
        share = ((q @ k.mT + geometry.transpose(1, 2)) * self.size**-0.5).softmax(-1)
        met = (share @ v).transpose(1, 2).flatten(2)
        related = (share.transpose(1, 2) @ pairs).flatten(2)
        return self.out(torch.cat([met, related], -1))
