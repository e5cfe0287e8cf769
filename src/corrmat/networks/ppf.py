"""Point-pair features: a neighbourhood as it looks from any side (RPM-Net, section 5.1)."""

import math
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
        still = torch.zeros_like(translation)
        offset = rigid.apply(rotation, still, self.offset.flatten(1, 2)).view_as(self.offset)
        return Neighborhoods(rigid.apply(rotation, translation, self.centre), offset, self.ppf)

    def features(self) -> Tensor:
        """(B, N, K, 10): centre, offset, ppf."""
        centre = self.centre.unsqueeze(2).expand_as(self.offset)
        return torch.cat([centre, self.offset, self.ppf], -1)


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


SIGNLESS = 13  # numbers that `signless_pair_features` gives
_LENGTHS = (0.05, 0.1, 0.17, 0.27, 0.42, 0.65, 1.0, 1.6)


def signless_pair_features(offset: Tensor, normal: Tensor, neighbor_normal: Tensor) -> Tensor:
    """Pair features that stay as they are when either normal is turned over.

    Eight bumps over the distance, one at each of a growing row of lengths; |n_r . d|, |n_i . d|
    and |n_r . n_i| for the unit offset d; and two products in which every normal comes twice:
    (n_r . d)(n_i . d)(n_r . n_i), which tells a bend from a step, and (n_r x n_i . d)(n_r . n_i),
    which changes its sign in a mirror and so tells left from right.

    Args:
        offset: (..., 3), neighbour minus centre.
        normal: n_r, (..., 3), unit normal at the centre.
        neighbor_normal: n_i, (..., 3), unit normal at the neighbour.

    Returns:
        (..., 13), each of order one.
    """
    # Coordinates first: sums over a last dimension of three are several times slower.
    x, n, m = (t.movedim(-1, 0).contiguous() for t in (offset, normal, neighbor_normal))
    distance = x.square().sum(0).sqrt().clamp_min(1e-6)
    d = x / distance
    a, b, c = (n * d).sum(0), (m * d).sum(0), (n * m).sum(0)
    turn = (torch.linalg.cross(*torch.broadcast_tensors(n, m), dim=0) * d).sum(0)
    log = distance.log()
    bumps = [torch.exp(-((log - math.log(at)) / 0.45).square()) for at in _LENGTHS]
    return torch.stack([*bumps, a.abs(), b.abs(), c.abs(), a * b * c, turn * c], -1)
