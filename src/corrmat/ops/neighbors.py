"""Which points are near: k nearest neighbours."""

import torch
from torch import Tensor


@torch.no_grad()
def knn(points: Tensor, k: int) -> Tensor:
    """The k nearest points of the same cloud, the point itself included.

    Args:
        points: (B, N, 3).
        k: how many, at most N.

    Returns:
        (B, N, k) int64, nearest first.

    Raises:
        ValueError: the cloud has fewer than k points.
    """
    if points.shape[1] < k:
        raise ValueError(f"{k} neighbours asked of a cloud with {points.shape[1]} points")
    return torch.cdist(points.float(), points.float()).topk(k, largest=False).indices
