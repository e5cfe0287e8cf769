"""PCRNet (Sarode et al., 2019), and its corr variant: the networks of experiments 3.1 to 3.3."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.networks.compare import Compare
from corrmat.networks.pointnet import PointNet
from corrmat.ops import rigid
from corrmat.ops.rigid import procrustes
from corrmat.types import Prediction, with_earlier


class PCRNetwork(nn.Module):
    """Regresses a pose from the two clouds' global features, again and again (section 5.3).

    Every iteration moves the source by the pose found and composes the poses, with their gradient.
    The last layer starts near the identity pose: from an arbitrary one, eight of them wander
    off and nothing is learnt.

    Args:
        width: dimension of a cloud's global feature.
        iterations: how often the pose is corrected.
    """

    min_points = 1

    def __init__(self, width: int = 1024, iterations: int = 8) -> None:
        super().__init__()
        self.iterations = iterations
        self.embed = PointNet(width)
        sizes = (2 * width, 1024, 1024, 512, 512, 256)
        hidden = [
            layer
            for i, o in zip(sizes, sizes[1:], strict=False)
            for layer in (nn.Linear(i, o), nn.ReLU())
        ]
        last = nn.Linear(256, 7)
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(torch.tensor([1.0, 0, 0, 0, 0, 0, 0]))
        self.pose = nn.Sequential(*hidden, last)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3], target[..., :3]
        centre_x, centre_y = x.mean(1), y.mean(1)
        x, y = x - centre_x.unsqueeze(1), y - centre_y.unsqueeze(1)
        f_y = self.embed(y).amax(1)
        moved, steps = x, []
        motion = rigid.identity(x)
        for _ in range(self.iterations):
            pose = self.pose(torch.cat([f_y, self.embed(moved).amax(1)], 1)).to(x.dtype)
            turn = quaternion_to_matrix(pose[:, :4]), pose[:, 4:]
            moved, motion = rigid.apply(*turn, moved), rigid.compose(turn, motion)
            # From centred clouds back to where they lie.
            rotation, shift = motion
            translation = rigid.apply(rotation, shift + centre_y, -centre_x.unsqueeze(1)).squeeze(1)
            steps.append(Prediction(rotation, translation))
        return with_earlier(steps)


class PCRNetCorrNetwork(nn.Module):
    """PCRNet's point features, one at a time, compared as in DCP; no iteration (section 5.3).

    A feature sees its own point and nothing else, so what it can learn to compare under any
    rotation is the point's distance from the origin.

    Args:
        width: feature dimension d.
    """

    min_points = 3

    def __init__(self, width: int = 512) -> None:
        super().__init__()
        self.embed = PointNet(width, nn.BatchNorm1d, bias=False)
        self.compare = Compare(width)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3], target[..., :3]
        c = self.compare(self.embed(x), self.embed(y))
        return Prediction(*procrustes(x, c.soft_target(y)), c)


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Rotation (..., 3, 3) of a quaternion (..., 4), w first, of any length but zero."""
    w, x, y, z = F.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
