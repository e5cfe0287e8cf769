"""Neighbour queries: k nearest, within a radius, and the nearest point of another cloud."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

_EXACT = "donot_use_mm_for_euclid_dist"
_CHUNK = 2**24  # entries of a distance matrix that exist at once


@torch.no_grad()
def knn(points: Tensor, k: int) -> Tensor:
    """Find the k nearest points of the same cloud, the point itself included.

    Only a slice of the distance matrix exists at a time. Large clouds get it from matrix products,
    which round by the distance from the origin: a cloud a hundred radii away has wrong neighbours.

    Args:
        points: (B, N, 3), near the origin.
        k: how many, at most N.

    Returns:
        (B, N, k) int64, nearest first.

    Raises:
        ValueError: the cloud has fewer than k points.
    """
    if points.shape[1] < k:
        raise ValueError(f"{k} neighbours asked of a cloud with {points.shape[1]} points")
    points = points.float()
    rows = max(1, _CHUNK // max(1, points.shape[0] * points.shape[1]))
    parts = [torch.cdist(x, points).topk(k, largest=False).indices for x in points.split(rows, 1)]
    return torch.cat(parts, 1)


@torch.no_grad()
def neighbors_at_ranks(points: Tensor, ranks: Tensor) -> Tensor:
    """Find each point's r-th nearest point of its cloud, for every rank r. Rank 0 is itself.

    Equally near points come in the order of the cloud.

    Args:
        points: (B, N, 3).
        ranks: int64 of any shape, below N.

    Returns:
        (B, N, *ranks.shape) int64.
    """
    squared = points.new_zeros(len(points), points.shape[1], points.shape[1], dtype=torch.float32)
    for axis in points.float().movedim(-1, 0).contiguous():
        offset = axis.unsqueeze(-1) - axis.unsqueeze(-2)
        squared.addcmul_(offset, offset)
    if squared.device.type == "cpu":
        order = torch.from_numpy(_nearest_first(squared.numpy(), int(ranks.numpy().max()) + 1))
    else:
        order = squared.argsort(dim=-1, stable=True)
    return order[..., ranks.to(order.device)]


def _nearest_first(squared: np.ndarray, count: int) -> np.ndarray:
    """Return the columns of the `count` smallest of each row, smallest first; (..., count) int64.

    Bits of a float that is not negative sort as the float does. With the column in the lower
    half, numpy's vector instructions sort both as one integer: ten times as fast as `argsort`.
    """
    keys = squared.view(np.int32).astype(np.int64) << 32 | np.arange(squared.shape[-1])
    smallest = np.partition(keys, count - 1, -1)[..., :count]
    smallest.sort(-1)
    return smallest & 0xFFFFFFFF


@torch.no_grad()
def within_radius(points: Tensor, radius: float, k: int) -> Tensor:
    """Find the k points of LOWEST INDEX within a radius, the point itself left out (RPM-Net).

    Lowest index, not nearest: which neighbours a point gets depends on the order of its
    cloud, so that two shuffled copies of a cloud have different neighbourhoods.

    Args:
        points: (B, N, 3).
        radius: in units of the points; the border counts as inside.
        k: how many.

    Returns:
        (B, N, k) int64, ascending; unused places hold the point's own index.
    """
    batch, n, _ = points.shape
    rows = torch.arange(n, device=points.device).unsqueeze(1)
    wanted = torch.arange(1, k + 1, dtype=torch.int32, device=points.device)
    points, parts = at_least_float32(points), []
    for part in rows.split(max(1, _CHUNK // max(1, batch * n))):
        near = torch.cdist(points[:, part[:, 0]], points, compute_mode=_EXACT) <= radius
        near &= part != rows.mT
        rank = near.cumsum(-1, dtype=torch.int32)  # how many neighbours have this index or less
        index = torch.searchsorted(rank, wanted.expand(batch, len(part), -1).contiguous())
        parts.append(torch.where(index < n, index, part))
    return torch.cat(parts, 1)


@torch.no_grad()
def nearest(points: Tensor, cloud: Tensor) -> Tensor:
    """Find the nearest point of `cloud` (B, M, 3) to each of `points` (B, N, 3): (B, N) int64.

    The result is exact, and only a slice of the distance matrix exists at a time.
    """
    rows = max(1, _CHUNK // max(1, cloud.shape[0] * cloud.shape[1]))
    cloud = at_least_float32(cloud)
    parts = at_least_float32(points).split(rows, 1)
    return torch.cat([torch.cdist(x, cloud, compute_mode=_EXACT).argmin(-1) for x in parts], 1)


def at_least_float32(values: Tensor) -> Tensor:
    """Return half precision as float32; `torch.cdist` has no kernels for it on CPUs."""
    return values if values.dtype == torch.float64 else values.float()


def gather_points(values: Tensor, index: Tensor) -> Tensor:
    """Gather rows of values (B, M, C) at index (B, ...): (B, ..., C)."""
    first_row = torch.arange(
        0, values.shape[0] * values.shape[1], values.shape[1], device=index.device
    )
    # As an embedding: on CPUs several times faster than `gather`, forward and backward.
    return F.embedding(index + first_row.view(-1, *[1] * (index.ndim - 1)), values.flatten(0, 1))
