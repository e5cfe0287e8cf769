"""Rigid transforms as batched tensors: apply, compose, invert, axis-angle, weighted Procrustes.

Convention everywhere: `R @ x + t` takes the source onto the target.
"""

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor


def apply(rotation: Tensor, translation: Tensor, points: Tensor) -> Tensor:
    """Move points by a rigid transform.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3).
        points: (..., N, 3), leading dimensions as the transform's.

    Returns:
        (..., N, 3), `R @ x + t` for every point x.
    """
    with torch.autocast(points.device.type, enabled=False):
        return points @ rotation.mT + translation.unsqueeze(-2)


def identity(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the identity transforms for points (B, N, 3): (B, 3, 3) and (B, 3)."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    return eye.expand(len(points), 3, 3), points.new_zeros(len(points), 3)


def compose(outer: tuple[Tensor, Tensor], inner: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Compose two transforms, each ((..., 3, 3), (..., 3)): `inner` is applied first."""
    rotation, translation = outer
    with torch.autocast(rotation.device.type, enabled=False):
        composed = rotation @ inner[0]
    return composed, apply(rotation, translation, inner[1].unsqueeze(-2)).squeeze(-2)


def to_homogeneous(rotation: ArrayLike | Tensor, translation: ArrayLike | Tensor) -> np.ndarray:
    """Build the (..., 4, 4) float64 matrices of transforms ((..., 3, 3), (..., 3)) on a CPU."""
    rotation, translation = (  # NumPy knows no bfloat16
        part.double().numpy() if isinstance(part, Tensor) else np.asarray(part)
        for part in (rotation, translation)
    )
    matrix = np.zeros((*translation.shape[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, translation, 1
    return matrix


def move(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Move points (N, 3) by a transform (4, 4)."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def axis_angle_to_matrix(axis: Tensor, angle_rad: Tensor) -> Tensor:
    """Compute rotation matrices by Rodrigues' formula.

    Args:
        axis: (..., 3) unit vectors.
        angle_rad: (...) angles in radians.

    Returns:
        (..., 3, 3).
    """
    cross = _cross_matrix(axis)
    sine, cosine = angle_rad.sin()[..., None, None], angle_rad.cos()[..., None, None]
    identity = torch.eye(3, dtype=axis.dtype, device=axis.device)
    return identity + sine * cross + (1 - cosine) * (cross @ cross)


def procrustes(
    source: Tensor, target: Tensor, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Solve weighted orthogonal Procrustes (Horn, Kabsch): the rigid transform of least squares.

    It minimises `sum_i w_i ||R x_i + t - y_i||^2` over proper rotations, in float64 inside.
    Where the points do not determine the rotation (all equal, or on a line) it returns one of
    the minimisers, and the gradient is finite.

    Args:
        source: (B, N, 3) points x.
        target: (B, N, 3) their matches y.
        weight: (B, N), not negative; None for equal weights. A pair whose weights sum
            to zero is treated as one without points: identity rotation.

    Returns:
        rotation (B, 3, 3) and translation (B, 3), in the dtype of `source`. NaN where a
        pair's points or weights are not finite; the other pairs are not touched by it.
    """
    x, y = source.double(), target.double()
    if weight is None:
        share = x.new_full(x.shape[:2], 1 / max(x.shape[1], 1))
    else:
        share = weight.double()
        share = share / share.sum(1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
    share = share.unsqueeze(-1)
    centre_x, centre_y = (share * x).sum(1), (share * y).sum(1)
    covariance = (share * (x - centre_x.unsqueeze(1))).mT @ (y - centre_y.unsqueeze(1))
    rotation = rotation_from_covariance(covariance)
    translation = centre_y - (rotation @ centre_x.unsqueeze(-1)).squeeze(-1)
    return rotation.to(source.dtype), translation.to(source.dtype)


def rotation_from_covariance(covariance: Tensor) -> Tensor:
    """Find the proper rotation R that maximises `trace(R @ H)` for H = sum_i w_i x_i y_i^T.

    Args:
        covariance: H, (B, 3, 3).

    Returns:
        (B, 3, 3). Its gradient does not go through the singular vectors, so equal
        singular values do no harm; see `_RotationFromCovariance`.
    """
    return _RotationFromCovariance.apply(covariance)  # type: ignore[no-any-return]


class _RotationFromCovariance(torch.autograd.Function):
    """SVD forward; backward by perturbing the optimality condition instead of the SVD.

    At the optimum G = R H is symmetric. With R -> exp([w]) R and H -> H + dH, staying
    symmetric demands (tr(G) I - G) w = -axial(R dH), a 3 x 3 system that is singular only
    where the rotation itself is not determined. There we drop the undetermined directions.
    """

    @staticmethod
    def forward(ctx, covariance: Tensor) -> Tensor:  # noqa: ANN001
        """Compute the optimal rotation by an SVD; NaN where the covariance is not finite."""
        finite = covariance.isfinite().all(-1).all(-1)[..., None, None]
        identity = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
        u, s, vh = torch.linalg.svd(torch.where(finite, covariance, identity))
        sign = torch.det(vh.mT @ u.mT).sign()
        flip = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
        rotation = torch.where(finite, (vh.mT * flip.unsqueeze(-2)) @ u.mT, torch.nan)
        ctx.save_for_backward(rotation, vh, s * flip)
        return rotation

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:  # type: ignore[override]  # noqa: ANN001
        """Solve the 3 x 3 system above in the basis where it is diagonal."""
        rotation, vh, eigenvalue = ctx.saved_tensors
        # In the basis V, G is diagonal and so is tr(G) I - G.
        curvature = eigenvalue.sum(-1, keepdim=True) - eigenvalue
        floor = eigenvalue[..., :1] * 1e-9 + torch.finfo(grad.dtype).tiny
        inverse = torch.where(curvature > floor, 1 / curvature.clamp_min(floor), 0)
        pull = _axial(grad @ rotation.mT).unsqueeze(-1)
        omega = (vh.mT @ (inverse.unsqueeze(-1) * (vh @ pull))).squeeze(-1)
        return -rotation.mT @ _cross_matrix(omega)


def _cross_matrix(vector: Tensor) -> Tensor:
    """Map (..., 3) to the cross-product matrix (..., 3, 3), `[v] @ u = v x u`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _axial(matrix: Tensor) -> Tensor:
    """Map (..., 3, 3) to the vector a (..., 3) with `<matrix, [w]> = <a, w>` for every w."""
    m = matrix - matrix.mT
    return torch.stack([m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]], -1)
