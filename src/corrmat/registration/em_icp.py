"""EM-ICP (Granger and Pennec, ECCV 2002) from point to plane, with a network's matches as prior.

Plain ICP matches each point with the nearest one. Two scans share no point, so a flat or round
part slides along itself until it lies where the nearest points happen to be. Here a point matches
many points a little: by how near they are, how parallel their normals, and how probable the
network finds the match. The network has an idea where on the part a point lies.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops import rigid

WIDTHS = np.geomspace(0.1, 0.02, 10)  # standard deviations of the distance of a match
_PLANE = 0.9  # weight of the distance along the normals; the rest is that of the points
_LEAST_PROB = 1e-3  # of any match: the network may be wrong
_OUTLIER = 0.1  # weight of having no match, in units of `_LEAST_PROB`
_LOG_LEAST = -60.0  # exponents below would make denormal numbers, which are slow


def em_icp(
    transform: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    prob: Tensor | None,
    widths: np.ndarray = WIDTHS,
) -> np.ndarray:
    """Refine a rigid transform of one cloud onto another.

    For each width it computes the weights W (N, M) of all matches, and makes one Gauss-Newton step
    on sum_ij W_ij (a (n_i (x_i - y_j))^2 + a (n_j (x_i - y_j))^2 + (1 - a) |x_i - y_j|^2),
    where x_i is a moved source point and n_i its normal.

    Args:
        transform: (4, 4), in units in which a cloud's radius is about one.
        source: (N, 6), xyz and unit normals of any sign.
        target: (M, 6).
        prob: (N, M) probabilities of matches; None if all are equally likely.
        widths: of the iterations, falling.

    Returns:
        (4, 4) float64.
    """
    x, n_x, y, n_y = (
        torch.from_numpy(np.ascontiguousarray(part, np.float32))
        for cloud in (source, target)
        for part in (cloud[:, :3], cloud[:, 3:6])
    )
    prior = _LEAST_PROB if prob is None else prob.float() + _LEAST_PROB
    rotation, translation = (
        torch.from_numpy(part).float() for part in (transform[:3, :3], transform[:3, 3])
    )
    planes = n_y.unsqueeze(2) * n_y.unsqueeze(1)
    on_planes = n_y * (n_y * y).sum(1, keepdim=True)
    terms = torch.cat([y.new_ones(len(y), 1), y, planes.flatten(1), on_planes], 1)
    identity = torch.eye(3, dtype=x.dtype)
    for width in widths.tolist():
        moved, normals = x @ rotation.T + translation, n_x @ rotation.T
        match = _closeness(moved, y, width).mul_((normals @ n_y.T).abs_()).mul_(prior)
        sums = _sums_over_matches(match, terms)
        weight, sum_y, sum_planes, sum_on_planes = sums.split([1, 3, 9, 3], 1)
        apart = weight * moved - sum_y
        along = normals * (normals * apart).sum(1, keepdim=True)
        sum_planes = sum_planes.unflatten(1, (3, 3))
        own_planes = weight.unsqueeze(2) * normals.unsqueeze(2) * normals.unsqueeze(1)
        off_planes = (sum_planes @ moved.unsqueeze(2)).squeeze(2) - sum_on_planes + along
        step = _gauss_newton(
            moved,
            _PLANE * off_planes + (1 - _PLANE) * apart,
            _PLANE * (sum_planes + own_planes) + (1 - _PLANE) * weight.unsqueeze(2) * identity,
        )
        rotation, translation = rigid.compose(step, (rotation, translation))
    u, _, vh = torch.linalg.svd(rotation.double())
    return rigid.to_homogeneous(u @ vh, translation)


def _closeness(x: Tensor, y: Tensor, width: float) -> Tensor:
    """Compute exp(-|x_i - y_j|^2 / 2 width^2): (N, 3) and (M, 3) to (N, M)."""
    x, y = x / width, y / width
    half_x, half_y = (points.square().sum(1, keepdim=True) / 2 for points in (x, y))
    left = torch.cat([x, -half_x, torch.ones_like(half_x)], 1)
    right = torch.cat([y, torch.ones_like(half_y), -half_y], 1)
    return (left @ right.T).clamp_(min=_LOG_LEAST).exp_()


def _sums_over_matches(match: Tensor, terms: Tensor) -> Tensor:
    """Sum terms (M, T) over the matches of each source point, by their weights (N, M).

    Each weight is divided by the root of its row's sum and of its column's sum: a point with many
    matches shares one weight among them, and one without any has none.
    """
    none = _OUTLIER * _LEAST_PROB
    rows, columns = ((match.sum(axis).unsqueeze(1) + none).rsqrt() for axis in (1, 0))
    return rows * (match @ (columns * terms))


def _gauss_newton(points: Tensor, gradient: Tensor, hessian: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the Gauss-Newton step of a rigid motion of points, each with a quadratic cost.

    Args:
        points: (N, 3).
        gradient: (N, 3) of each point's cost by its position.
        hessian: (N, 3, 3) of the same, symmetric.

    Returns:
        Rotation (3, 3) and translation (3,).
    """
    turned = torch.linalg.cross(points.unsqueeze(2), hessian, dim=1)  # [p]x H
    both = torch.linalg.cross(points.unsqueeze(2), turned.mT, dim=1).sum(0)  # [p]x H [p]x^T
    turned = turned.sum(0)
    matrix = torch.cat([torch.cat([both, turned], 1), torch.cat([turned.T, hessian.sum(0)], 1)])
    vector = torch.cat([torch.linalg.cross(points, gradient).sum(0), gradient.sum(0)])
    # Without any match the cost is flat, and there is no step.
    matrix = matrix.double() + 1e-6 * torch.eye(6, dtype=torch.float64)
    rotvec, shift = -torch.linalg.solve(matrix, vector.double()).float().view(2, 3)
    return rigid.axis_angle_to_matrix(F.normalize(rotvec, dim=0), rotvec.norm()), shift
