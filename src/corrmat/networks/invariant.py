"""The network behind `corrmat register`: DCP's idea on rotation-invariant features.

DCP embeds coordinates and must learn every rotation from examples. This network reads a cloud
through point pair features only (Drost et al., CVPR 2010), so what it learns holds at every pose.
Estimated normals have no reliable sign, and these features do not depend on it. They enter twice:
within a point's neighbourhood, and from every point to anchors spread over its cloud, where
attention uses them as GeoTransformer does between superpoints (Qin et al., CVPR 2022).
"""

import torch
from torch import Tensor, nn

from corrmat.errors import CorrmatError, require_positive
from corrmat.networks.attention import Attention, FeedForward
from corrmat.networks.matching import Matchability
from corrmat.networks.ppf import SIGNLESS, signless_pair_features
from corrmat.ops.neighbors import gather_points, neighbors_at_ranks
from corrmat.ops.rigid import procrustes
from corrmat.types import Prediction, last_of


class InvariantNetwork(nn.Module):
    """Neighbourhood features, attention within and between clouds, matches with matchability.

    Args:
        width: feature dimension d.
        heads: attention heads.
        layers: attention layers.
        anchors: points of a cloud that each of its points attends to in training.
        test_anchors: the same when it registers. More make the means of attention less noisy.
        neighbors: points sampled of each neighbourhood.
        shares: sizes of the neighbourhoods, as shares of the cloud, so that they do not depend
            on the sampling density.
    """

    def __init__(
        self,
        width: int = 128,
        heads: int = 4,
        layers: int = 2,
        anchors: int = 64,
        test_anchors: int = 256,
        neighbors: int = 8,
        shares: tuple[float, ...] = (0.05, 0.1, 0.2),
    ) -> None:
        super().__init__()
        require_positive(
            width=width, heads=heads, anchors=anchors, test_anchors=test_anchors,
            neighbors=neighbors,
        )  # fmt: skip
        if layers < 0:
            raise CorrmatError(f"layers {layers} is negative")
        if not shares or not all(0 < share <= 1 for share in shares):
            raise CorrmatError(f"shares {shares} are not in (0, 1]")
        self.min_points = 3
        self.anchors, self.test_anchors = anchors, test_anchors
        self.neighbors, self.shares = neighbors, shares
        self.embed = NeighborhoodEmbedding(width, len(shares))
        self.layers = nn.ModuleList(Layer(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.matching_head = Matchability(width)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 6) to target (B, M, 6): xyz and unit normals of any sign."""
        if min(source.shape[-1], target.shape[-1]) < 6:
            raise ValueError("normals are needed: clouds of 6 columns, xyz and unit normal")
        x, y = source[..., :3], target[..., :3]
        scale = 2 / (radius(x) + radius(y))
        local_x = self.local_pair_features(source, scale)
        local_y = self.local_pair_features(target, scale)
        anchors_x, anchors_y = self.anchors_of(x.shape[1]), self.anchors_of(y.shape[1])
        pairs_x = pair_features(source, anchors_x, scale)
        pairs_y = pair_features(target, anchors_y, scale)
        f_x, f_y = self.embed(local_x), self.embed(local_y)
        # Matches of the neighbourhoods alone are trained as well: attention then refines them.
        steps = [self.match(f_x, f_y, x, y)] if self.training else []
        for layer in self.layers:
            f_x, f_y = layer(f_x, f_y, pairs_x, anchors_x), layer(f_y, f_x, pairs_y, anchors_y)
        return last_of([*steps, self.match(f_x, f_y, x, y)])

    def match(self, f_x: Tensor, f_y: Tensor, x: Tensor, y: Tensor) -> Prediction:
        """Match points x and y by their features (B, N, d) and (B, M, d), and fit a transform."""
        correspondence = self.matching_head(self.norm(f_x), self.norm(f_y))
        y_hat = correspondence.soft_target(y)
        return Prediction(*procrustes(x, y_hat, correspondence.weight()), correspondence)

    def anchors_of(self, size: int) -> Tensor:
        """Return the rows of the anchors of a cloud of `size` points."""
        count = self.anchors if self.training else self.test_anchors
        return evenly_spaced_indices(size, min(size, count))

    @torch.no_grad()
    def local_pair_features(self, cloud: Tensor, scale: Tensor) -> Tensor:
        """Compute pair features of every point's neighbourhoods, (B, N, sizes, neighbors, F)."""
        points = cloud[..., :3]
        n = points.shape[1]
        sizes = [min(n, max(2, round(share * n))) for share in self.shares]
        ranks = torch.stack([evenly_spaced_indices(size, self.neighbors) for size in sizes])
        return pair_features(cloud, neighbors_at_ranks(points, ranks), scale)


def radius(points: Tensor) -> Tensor:
    """Compute the median distance (B,) of points (B, N, 3) from their centroid."""
    centred = points - points.mean(1, keepdim=True)
    return centred.norm(dim=-1).median(1).values


def evenly_spaced_indices(size: int, count: int) -> Tensor:
    """Spread `count` indices evenly over range(size); indices repeat if size < count."""
    return torch.linspace(0, size - 1, count).round().long()


@torch.no_grad()
def pair_features(cloud: Tensor, index: Tensor, scale: Tensor) -> Tensor:
    """Compute pair features (B, N, ..., F) from every point to the points at an index.

    Args:
        cloud: (B, N, 6) xyz and unit normals.
        index: (B, N, ...) for each point, or (A,) for all points.
        scale: (B,) factor of all lengths.
    """
    points = cloud.movedim(-1, 0).contiguous()  # sums over a last dimension of three are slow
    if index.ndim == 1:
        other = points[..., index].unsqueeze(2)
    else:
        other = gather_points(cloud, index).movedim(-1, 0)
    centre = points[(..., *[None] * (other.ndim - 3))]
    factor = scale[(slice(None), *[None] * (other.ndim - 2))]
    offset = (other[:3] - centre[:3]) * factor
    vectors = (vector.movedim(0, -1) for vector in (offset, centre[3:6], other[3:6]))
    return signless_pair_features(*vectors)


class NeighborhoodEmbedding(nn.Module):
    """A point's feature: mean and maximum over its neighbours' pair features, at each size.

    Args:
        width: feature dimension.
        sizes: number of neighbourhoods of a point.
    """

    def __init__(self, width: int, sizes: int) -> None:
        super().__init__()
        self.edge = nn.Sequential(nn.Linear(SIGNLESS, 48), nn.ReLU(inplace=True))
        self.point = FeedForward(2 * 48 * sizes, 2 * width, width)

    def forward(self, pair_features: Tensor) -> Tensor:
        """Map pair features (B, N, sizes, neighbors, F) to features (B, N, width)."""
        edges = self.edge(pair_features)
        return self.point(torch.cat([edges.amax(3), edges.mean(3)], -1).flatten(2))


class Layer(nn.Module):
    """Self-attention with pair features, cross-attention to the other cloud, feed-forward.

    A new layer changes nothing, so that one can be added to a trained network.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.within = PairAttention(width, heads)
        self.between = Attention(width, heads)
        self.feedforward = FeedForward(width, 2 * width, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(4))
        for last in (self.within.out, self.between.out, self.feedforward[-1]):
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: Tensor, other: Tensor, pairs: Tensor, anchors: Tensor) -> Tensor:
        """Update features (B, N, d) of a cloud.

        Args:
            x: (B, N, d).
            other: (B, M, d) features of the other cloud.
            pairs: (B, N, A, F) pair features to the anchors.
            anchors: (A,) indices of the anchors.
        """
        normed = self.norms[0](x)
        x = x + self.within(normed, normed[:, anchors], pairs)
        x = x + self.between(self.norms[1](x), self.norms[2](other))
        return x + self.feedforward(self.norms[3](x))


class PairAttention(nn.Module):
    """Attention whose keys and values include pair features.

    With r_ij the pair features of points i and j, the logits are (q_i . k_j + p_i . r_ij) /
    sqrt(size); the output joins the means of v_j and of r_ij under their softmax.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads, self.size = heads, width // heads
        self.query = nn.Linear(width, width + heads * SIGNLESS)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width + heads * SIGNLESS, width)

    def forward(self, x: Tensor, anchors: Tensor, pairs: Tensor) -> Tensor:
        """Let x (B, N, d) attend to anchors (B, A, d), given pair features (B, N, A, F)."""
        width = self.heads * self.size
        scaled = self.query(x) * self.size**-0.5
        q, p = scaled.split([width, self.heads * SIGNLESS], -1)
        k, v = self.key_value(anchors).split(width, -1)
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (q, k, v))
        geometry = p.unflatten(-1, (self.heads, -1)) @ pairs.mT  # (B, N, H, A)
        attention = (q @ k.mT).add_(geometry.transpose(1, 2)).softmax(-1)
        values = (attention @ v).transpose(1, 2).flatten(2)
        relations = (attention.transpose(1, 2) @ pairs).flatten(2)
        return self.out(torch.cat([values, relations], -1))
