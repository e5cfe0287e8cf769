"""EM-ICP (Granger and Pennec, ECCV 2002) from point to plane, with a network's matches as prior.

Plain ICP matches each point with the nearest one. Two scans share no point, so a flat or round
part slides along itself until it lies where the nearest points happen to be. Here a point matches
many points a little: by how near they are, how parallel their normals, and how probable the
network finds the match. The network knows where on the part a point lies, and holds it there.
"""

import numpy as np
import torch
from torch import Tensor

_WIDTHS = 0.1, 0.02  # standard deviation of the distance of a match, first and last
_ITERATIONS = 10
_PLANE = 0.9  # weight of the distance along the normals; the rest is that of the points
_LEAST_PROB = 1e-3  # of any match: the network may be wrong
_OUTLIER = 0.1  # weight of having no match, in units of `_LEAST_PROB`
_LOG_LEAST = -60.0  # exponents below would make denormal numbers, which are slow


def em_icp(
    transforms: np.ndarray, source: np.ndarray, target: np.ndarray, prob: Tensor | None
) -> np.ndarray:
    """Refine rigid transforms of one cloud onto another.

    Each iteration computes the weights W (N, M) of all matches, and then makes one Gauss-Newton
    step on sum_ij W_ij (a ((n_i (x_i - y_j))^2 + (n_j (x_i - y_j))^2) + (1 - a) |x_i - y_j|^2),
    where x_i is a moved source point and n its normal.

    Args:
        transforms: (T, 4, 4), in units in which a cloud's radius is about one.
        source: (N, 6), xyz and unit normals of any sign.
        target: (M, 6).
        prob: (N, M) probabilities of matches; None if all are equally likely.

    Returns:
        (T, 4, 4) float64.
    """
    x, n_x, y, n_y = (
        torch.from_numpy(np.ascontiguousarray(part, np.float32))
        for cloud in (source, target)
        for part in (cloud[:, :3], cloud[:, 3:6])
    )
    prior = torch.full((1, 1), _LEAST_PROB) if prob is None else prob.float() + _LEAST_PROB
    current = torch.from_numpy(transforms)
    rotation, translation = current[:, :3, :3].float(), current[:, :3, 3:].float().mT
    outer = n_y.unsqueeze(2) * n_y.unsqueeze(1)
    # Sums over the matches of a point: their weight, sum of y, of n n^T and of n n^T y.
    terms = torch.cat([torch.ones(len(y), 1), y, outer.flatten(1), n_y * (n_y * y).sum(1, True)], 1)
    for width in np.geomspace(*_WIDTHS, _ITERATIONS).tolist():
        moved, normals = x @ rotation.mT + translation, n_x @ rotation.mT
        weights = _closeness(moved, y, width).mul_((normals @ n_y.mT).abs_()).mul_(prior)
        # As in one normalisation of rows and columns: a point with many matches splits among them.
        outlier = _OUTLIER * _LEAST_PROB
        rows = (weights.sum(2, keepdim=True) + outlier).rsqrt()
        columns = (weights.sum(1).unsqueeze(2) + outlier).rsqrt()
        sums = rows * (weights @ (columns * terms))
        weight, sum_y, planes, sum_planes = sums.split([1, 3, 9, 3], 2)
        planes = planes.unflatten(2, (3, 3))
        rest = weight * moved - sum_y
        along = normals * (normals * rest).sum(2, keepdim=True)
        on_planes = (planes @ moved.unsqueeze(3)).squeeze(3) - sum_planes
        force = _PLANE * (on_planes + along) + (1 - _PLANE) * rest
        own_plane = normals.unsqueeze(3) * normals.unsqueeze(2)
        stiffness = _PLANE * planes + weight.unsqueeze(3) * (
            _PLANE * own_plane + (1 - _PLANE) * torch.eye(3)
        )
        step_rotation, step_translation = _gauss_newton(moved, force, stiffness)
        rotation = step_rotation @ rotation
        translation = translation @ step_rotation.mT + step_translation
    refined = torch.eye(4, dtype=torch.float64).repeat(len(current), 1, 1)
    u, _, v = torch.linalg.svd(rotation.double())
    refined[:, :3, :3], refined[:, :3, 3] = u @ v, translation.squeeze(1).double()
    return refined.numpy()


def _closeness(x: Tensor, y: Tensor, width: float) -> Tensor:
    """Compute exp(-|x_i - y_j|^2 / 2 width^2): (T, N, 3) and (M, 3) to (T, N, M)."""
    x, y = x / width, y / width
    half_x, half_y = (points.square().sum(-1, keepdim=True) / 2 for points in (x, y))
    left = torch.cat([x, -half_x, torch.ones_like(half_x)], -1)
    right = torch.cat([y, torch.ones_like(half_y), -half_y], -1)
    return (left @ right.mT).clamp_(min=_LOG_LEAST).exp_()


def _gauss_newton(points: Tensor, force: Tensor, stiffness: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the rigid motion that balances the forces of springs.

    Args:
        points: (T, N, 3), where the springs are attached.
        force: (T, N, 3), with which they push.
        stiffness: (T, N, 3, 3), symmetric.

    Returns:
        Rotation (T, 3, 3) and translation (T, 1, 3).
    """
    turned = torch.linalg.cross(points.unsqueeze(3), stiffness, dim=2)  # [p]x K
    both = torch.linalg.cross(points.unsqueeze(3), turned.mT, dim=2).sum(1)  # [p]x K [p]x^T
    turned = turned.sum(1)
    matrix = torch.cat(
        [torch.cat([both, turned], 2), torch.cat([turned.mT, stiffness.sum(1)], 2)], 1
    ).double()
    torque = torch.linalg.cross(points, force).sum(1)
    vector = torch.cat([torque, force.sum(1)], 1).double()
    # Without any match there is nothing to balance, and no step.
    step = -torch.linalg.solve(matrix + 1e-6 * torch.eye(6), vector).float()
    zero = torch.zeros(len(step))
    a, b, c = step[:, :3].unbind(1)
    skew = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], 1).unflatten(1, (3, 3))
    return torch.linalg.matrix_exp(skew), step[:, 3:].unsqueeze(1)
