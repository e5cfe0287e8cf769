"""Point pair features (Drost et al., CVPR 2010), as RPM-Net uses them (its section 5.1)."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from corrmat.ops import rigid
from corrmat.ops.neighbors import gather_points, within_radius


class Neighborhoods(NamedTuple):
    """K neighbours of every point of a cloud."""

    centre: Tensor  # (B, N, 3)
    offset: Tensor  # (B, N, K, 3) neighbour minus centre
    ppf: Tensor  # (B, N, K, 4) point pair features; a rigid transform does not change them

    def moved(self, rotation: Tensor, translation: Tensor) -> "Neighborhoods":
        """Transform the neighbourhoods by rotation (B, 3, 3) and translation (B, 3)."""
        zero = torch.zeros_like(translation)
        offset = rigid.apply(rotation, zero, self.offset.flatten(1, 2)).view_as(self.offset)
        return Neighborhoods(rigid.apply(rotation, translation, self.centre), offset, self.ppf)

    def features(self) -> Tensor:
        """Concatenate centre, offset and ppf: (B, N, K, 10)."""
        centre = self.centre.unsqueeze(2).expand_as(self.offset)
        return torch.cat([centre, self.offset, self.ppf], -1)


@torch.no_grad()
def neighborhoods(cloud: Tensor, radius: float, k: int) -> Neighborhoods:
    """Find up to k neighbours within a radius and compute the pair features of each.

    Args:
        cloud: (B, N, 6) xyz and unit normals.
        radius: in units of the cloud.
        k: neighbours of each point; see `within_radius` for which.
    """
    points, normals = cloud[..., :3], cloud[..., 3:]
    index = within_radius(points, radius, k)
    offset = gather_points(points, index) - points.unsqueeze(2)
    ppf = point_pair_features(offset, normals.unsqueeze(2), gather_points(normals, index))
    return Neighborhoods(points, offset, ppf)


def point_pair_features(offset: Tensor, normal: Tensor, neighbor_normal: Tensor) -> Tensor:
    """Compute (angle(n_r, d), angle(n_i, d), angle(n_r, n_i), |d|), angles in radians.

    Args:
        offset: d, (..., 3), neighbour minus centre.
        normal: n_r, (..., 3), unit normal at the centre.
        neighbor_normal: n_i, (..., 3), unit normal at the neighbour.

    Returns:
        (..., 4).
    """
    d, n_r, n_i = _coordinates_first(offset, normal, neighbor_normal)
    angles = _angle_rad(n_r, d), _angle_rad(n_i, d), _angle_rad(n_r, n_i)
    return torch.stack([*angles, d.square().sum(0).sqrt()], -1)


def _coordinates_first(*vectors: Tensor) -> list[Tensor]:
    """Move coordinates to the front: sums over a last dimension of three are slow."""
    return [vector.movedim(-1, 0).contiguous() for vector in vectors]


def _angle_rad(a: Tensor, b: Tensor) -> Tensor:
    """Compute the angles between vectors (3, ...); 0 where one of them is zero."""
    cross = torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=0)
    # The sum turns a dot product of -0, whose angle would be pi, into 0.
    return torch.atan2(cross.square().sum(0).sqrt(), (a * b).sum(0))


SIGNLESS = 13  # features of `signless_pair_features`
_BUMP_WIDTH = 0.45
_BUMP_CENTRES = (0.05, 0.1, 0.17, 0.27, 0.42, 0.65, 1.0, 1.6)


def signless_pair_features(offset: Tensor, normal: Tensor, neighbor_normal: Tensor) -> Tensor:
    """Compute pair features that do not change when either normal is flipped.

    They are eight radial bumps over log distance, then |n_r . d|, |n_i . d| and |n_r . n_i| for
    the unit offset d, then two products in which every normal occurs twice:
    (n_r . d)(n_i . d)(n_r . n_i) separates a bend from a step, and (n_r x n_i . d)(n_r . n_i)
    changes sign under reflection, so it tells a shape from its mirror image.

    Args:
        offset: (..., 3), neighbour minus centre.
        normal: n_r, (..., 3), unit normal at the centre.
        neighbor_normal: n_i, (..., 3), unit normal at the neighbour.

    Returns:
        (..., 13), each of order one.
    """
    x, n, m = _coordinates_first(offset, normal, neighbor_normal)
    distance = _dot(x, x).sqrt_().clamp_min_(1e-6)
    d = x / distance
    a, b, c = _dot(n, d), _dot(m, d), _dot(n, m)
    # Every feature is written to its place in one block: several times as fast as a stack.
    features = distance.new_empty(SIGNLESS, *distance.shape)
    log_distance = distance.log_().div_(_BUMP_WIDTH)
    for bump, centre in zip(features, _BUMP_CENTRES, strict=False):
        torch.sub(log_distance, math.log(centre) / _BUMP_WIDTH, out=bump).square_().neg_().exp_()
    for feature, value in zip(features[-5:], (a, b, c), strict=False):
        torch.abs(value, out=feature)
    torch.mul(a.mul_(b), c, out=features[-2])
    triple = torch.zeros_like(c)
    for k in range(3):
        triple.addcmul_(d[k], (n[k - 2] * m[k - 1]).addcmul_(n[k - 1], m[k - 2], value=-1))
    torch.mul(triple, c, out=features[-1])
    return features.movedim(0, -1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Compute dot products of vectors, coordinates first."""
    return torch.addcmul(a[0] * b[0], a[1], b[1]).addcmul_(a[2], b[2])
