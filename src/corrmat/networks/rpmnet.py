"""RPM-Net (Yew & Lee, CVPR 2020), the network of experiments 2.1 to 2.4."""

from functools import partial
from typing import get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.errors import CorrmatError, require_choice, require_positive
from corrmat.networks.pointnet import shared_mlp
from corrmat.networks.ppf import Neighborhoods, neighborhoods
from corrmat.ops import rigid
from corrmat.ops.correspondence import SinkhornCorrespondence
from corrmat.ops.edge_mlp import group_norm_edge_mlp
from corrmat.ops.rigid import procrustes
from corrmat.ops.sinkhorn import Slack
from corrmat.types import Prediction, last_of


class RPMNetwork(nn.Module):
    """Neighbourhood features, annealed affinities, Sinkhorn, weighted Procrustes, iterated.

    Every iteration moves the source by the current transform, without its gradient. The target
    never moves, so its features are computed once. Neighbours and pair features of both clouds
    never change.

    Args:
        width: feature dimension d, a multiple of 8.
        k: neighbours of each point.
        radius: within which they lie, in units of the clouds.
        iterations: number of iterations in training.
        test_iterations: number of iterations in evaluation.
        sinkhorn_iterations: normalisations of rows and columns in each iteration.
        slack: see `sinkhorn_potentials`.
        annealing_width: width of the annealing network's pooled feature.
    """

    min_points = 3

    def __init__(
        self,
        width: int = 96,
        k: int = 64,
        radius: float = 0.3,
        iterations: int = 2,
        test_iterations: int = 5,
        sinkhorn_iterations: int = 5,
        slack: Slack = "row",
        annealing_width: int = 1024,
    ) -> None:
        super().__init__()
        for name, size, groups in ("width", width, 8), ("annealing_width", annealing_width, 16):
            if size < groups or size % groups:
                raise CorrmatError(f"{name} {size} is not a multiple of {groups} groups")
        require_choice("slack", slack, get_args(Slack))
        require_positive(
            k=k, iterations=iterations, test_iterations=test_iterations,
            sinkhorn_iterations=sinkhorn_iterations,
        )  # fmt: skip
        if not radius > 0:
            raise CorrmatError(f"radius {radius} is not positive")
        self.k, self.radius = k, radius
        self.iterations, self.test_iterations = iterations, test_iterations
        self.sinkhorn_iterations = sinkhorn_iterations
        self.slack: Slack = slack
        self.embed = NeighborhoodNet(width)
        self.annealing = AnnealingNet(annealing_width)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 6) to target (B, M, 6): xyz and unit normals."""
        if min(source.shape[-1], target.shape[-1]) < 6:
            raise ValueError("RPMNet needs normals: clouds of 6 columns, xyz and unit normal")
        x, y = source[..., :3], target[..., :3]
        neighborhoods_x = neighborhoods(source, self.radius, self.k)
        f_y = self.embed(neighborhoods(target, self.radius, self.k))
        rotation, translation = rigid.identity(x)
        steps: list[Prediction] = []
        for _ in range(self.iterations if self.training else self.test_iterations):
            current = rotation.detach(), translation.detach()
            f_x = self.embed(neighborhoods_x.moved(*current))
            beta, alpha = self.annealing(rigid.apply(*current, x), y)
            correspondence = SinkhornCorrespondence(
                f_x, f_y, beta, alpha, self.sinkhorn_iterations, self.slack
            )
            y_hat = correspondence.soft_target(y)
            rotation, translation = procrustes(x, y_hat, correspondence.weight())
            steps.append(Prediction(rotation, translation, correspondence))
        return last_of(steps)


class NeighborhoodNet(nn.Module):
    """Point features of unit length: shared MLP on neighbours, max-pooling, another MLP."""

    def __init__(self, width: int = 96) -> None:
        super().__init__()
        norm = partial(nn.GroupNorm, 8)
        self.edge = shared_mlp((10, width, width, 2 * width), norm)
        self.point = shared_mlp((2 * width, 2 * width, width), norm)
        self.out = nn.Conv1d(width, width, 1)

    def forward(self, neighborhoods: Neighborhoods) -> Tensor:
        """Compute unit features (B, N, d)."""
        pooled = group_norm_edge_mlp(neighborhoods.features(), self.edge)
        return F.normalize(self.out(self.point(pooled.mT)).mT, dim=-1)


class AnnealingNet(nn.Module):
    """Predicts the annealing parameters of the affinities from both clouds: beta and alpha."""

    def __init__(self, width: int = 1024) -> None:
        super().__init__()
        self.point = nn.Sequential(
            *shared_mlp((4, 64, 64, 64, 128), partial(nn.GroupNorm, 8)),
            *shared_mlp((128, width), partial(nn.GroupNorm, 16)),
        )
        self.pooled = nn.Sequential(
            nn.Linear(width, 512), nn.GroupNorm(16, 512), nn.ReLU(),
            nn.Linear(512, 256), nn.GroupNorm(16, 256), nn.ReLU(),
            nn.Linear(256, 2),
        )  # fmt: skip

    def forward(self, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Map clouds (B, N, 3) and (B, M, 3) in one frame to positive beta (B,) and alpha (B,)."""
        flagged = torch.cat([F.pad(source, (0, 1), value=0.0), F.pad(target, (0, 1), value=1.0)], 1)
        # All points are the neighbours of one: the maximum over the clouds.
        pooled = self.pooled(group_norm_edge_mlp(flagged.unsqueeze(1), self.point).squeeze(1))
        beta, alpha = F.softplus(pooled).unbind(1)
        return beta, alpha
