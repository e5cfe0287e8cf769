"""Point-pair features: a neighbourhood as it looks from any side (RPM-Net, section 5.1)."""

from typing import NamedTuple

import torch
from torch import Tensor

from corrmat.ops import rigid
from corrmat.ops.neighbors import take, within_radius


class Neighborhoods(NamedTuple):
    """Every point of a cloud with K neighbours; moves with the cloud."""

    centre: Tensor  # (B, N, 3)
    offset: Tensor  # (B, N, K, 3) neighbour minus centre
    ppf: Tensor  # (B, N, K, 4) does not change when the cloud moves

    def moved(self, rotation: Tensor, translation: Tensor) -> "Neighborhoods":
        """The neighbourhoods after `R @ x + t`, rotation (B, 3, 3) and translation (B, 3)."""
        offset = (self.offset.flatten(1, 2) @ rotation.mT).view_as(self.offset)
        return Neighborhoods(rigid.apply(rotation, translation, self.centre), offset, self.ppf)

    def features(self) -> Tensor:
        """(B, 10, N, K): centre, offset, ppf."""
        centre = self.centre.unsqueeze(2).expand_as(self.offset)
        return torch.cat([centre, self.offset, self.ppf], -1).permute(0, 3, 1, 2).contiguous()


@torch.no_grad()
def neighborhoods(cloud: Tensor, radius: float, k: int) -> Neighborhoods:
    """Up to k neighbours within a radius, and the pair features of each.

    Args:
        cloud: (B, N, 6) xyz and unit normals.
        radius: in units of the cloud.
        k: neighbours of each point; see `within_radius` for which.
    """
    points, normals = cloud[..., :3], cloud[..., 3:]
    index = within_radius(points, radius, k)
    offset = take(points, index) - points.unsqueeze(2)
    ppf = point_pair_features(offset, normals.unsqueeze(2), take(normals, index))
    return Neighborhoods(points, offset, ppf)


def point_pair_features(offset: Tensor, normal: Tensor, neighbor_normal: Tensor) -> Tensor:
    """(angle(n_r, d), angle(n_i, d), angle(n_r, n_i), |d|), angles in radians.

    Args:
        offset: d, (..., 3), neighbour minus centre.
        normal: n_r, (..., 3), unit normal at the centre.
        neighbor_normal: n_i, (..., 3), unit normal at the neighbour.

    Returns:
        (..., 4).
    """
    normal = normal.expand_as(neighbor_normal)
    angles = _angle_rad(normal, offset), _angle_rad(neighbor_normal, offset)
    turn, distance = _angle_rad(normal, neighbor_normal), offset.norm(dim=-1)
    return torch.stack([*angles, turn, distance], -1)


def _angle_rad(a: Tensor, b: Tensor) -> Tensor:
    cross, dot = torch.linalg.cross(a, b), (a * b).sum(-1)
    return torch.atan2(cross.norm(dim=-1), dot)
