"""PCRNet (Sarode et al., 2019), and its corr variant: the networks of experiments 3.1 to 3.3."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.errors import require_positive
from corrmat.networks.matching import MatchingHead
from corrmat.networks.pointnet import PointNet, keep_signal_size
from corrmat.ops import rigid
from corrmat.ops.rigid import procrustes
from corrmat.types import Prediction, last_of


class PCRNetwork(nn.Module):
    """Regresses a pose from the two clouds' global features, iteratively (section 5.3).

    Every iteration moves the source by the predicted pose and composes the poses, with their
    gradient. The last layer is initialised near the identity pose: from an arbitrary pose, eight
    iterations diverge and nothing is learnt. The layers before it keep the size of their input:
    with torch's default weights the pose would hardly depend on the clouds, and stay there.

    Args:
        width: dimension of a cloud's global feature.
        iterations: number of pose corrections.
    """

    min_points = 1

    def __init__(self, width: int = 1024, iterations: int = 8) -> None:
        super().__init__()
        require_positive(width=width, iterations=iterations)
        self.iterations = iterations
        self.embed = PointNet(width)
        sizes = (2 * width, 1024, 1024, 512, 512, 256)
        hidden = [
            layer
            for i, o in zip(sizes, sizes[1:], strict=False)
            for layer in (nn.Linear(i, o), nn.ReLU())
        ]
        keep_signal_size(hidden)
        last = nn.Linear(256, 7)
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias.copy_(torch.tensor([1.0, 0, 0, 0, 0, 0, 0]))
        self.pose = nn.Sequential(*hidden, last)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3], target[..., :3]
        centre_x, centre_y = x.mean(1), y.mean(1)
        x, y = x - centre_x.unsqueeze(1), y - centre_y.unsqueeze(1)
        f_y = self.embed.pooled(y)
        moved, steps = x, []
        transform = rigid.identity(x)
        for _ in range(self.iterations):
            pose = self.pose(torch.cat([f_y, self.embed.pooled(moved)], 1)).to(x.dtype)
            update = quaternion_to_matrix(pose[:, :4]), pose[:, 4:]
            moved, transform = rigid.apply(*update, moved), rigid.compose(update, transform)
            # From centred clouds back to the original coordinates.
            rotation, shift = transform
            translation = rigid.apply(rotation, shift + centre_y, -centre_x.unsqueeze(1)).squeeze(1)
            steps.append(Prediction(rotation, translation))
        return last_of(steps)


class PCRNetCorrNetwork(nn.Module):
    """PCRNet's per-point features compared as in DCP, without iterations (section 5.3).

    A feature depends on its own point alone, so under any rotation it can only learn to compare
    the points' distances from the origin.

    Args:
        width: feature dimension d.
    """

    min_points = 3

    def __init__(self, width: int = 512) -> None:
        super().__init__()
        require_positive(width=width)
        self.embed = PointNet(width, nn.BatchNorm1d, bias=False)
        self.matching_head = MatchingHead(width)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3], target[..., :3]
        correspondence = self.matching_head(self.embed(x), self.embed(y))
        return Prediction(*procrustes(x, correspondence.soft_target(y)), correspondence)


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Convert quaternions (..., 4), w first, of any length but zero, to rotations (..., 3, 3)."""
    w, x, y, z = F.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
