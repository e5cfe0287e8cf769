"""DGCNN's edge convolutions over one fixed neighbour graph, as DCP uses them (SPEC: 3, DCP).

Every edge tensor is B * N * k rows, and in a plain rewrite batch norm, ReLU and the maximum
over neighbours pass over it again and again. Here batch norm costs no pass: the mean and
variance of a linear layer's output follow from the mean and second moment of its input, so
the norm is folded into the weights before the one matrix product; ReLU and the maximum are
done slab by slab while a slab is in cache.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.ops.neighbors import knn


class DGCNN(nn.Module):
    """Per-point features from edge convolutions on the k-nearest-neighbour graph.

    Args:
        width: feature dimension of the output.
        channels: output widths of the edge convolutions.
        k: neighbours of each point, itself included.
    """

    def __init__(
        self, width: int = 512, channels: tuple[int, ...] = (64, 64, 128, 256), k: int = 20
    ) -> None:
        super().__init__()
        self.k = k
        self.edge = nn.ModuleList(
            FoldedNormLinear(i, o) for i, o in zip((6, *channels[:-1]), channels, strict=True)
        )
        self.fuse = nn.Linear(sum(channels), width, bias=False)
        self.norm = nn.BatchNorm1d(width)

    def forward(self, points: Tensor) -> Tensor:
        """Features (B, N, width) of points (B, N, 3)."""
        batch, n, _ = points.shape
        edges = edge_features(points, knn(points, self.k))
        pooled = []
        for layer in self.edge:
            edges, top = layer(edges)
            pooled.append(top)
        features = self.norm(self.fuse(torch.cat(pooled, -1)))
        return F.relu(features).unflatten(0, (batch, n))


def edge_features(points: Tensor, neighbors: Tensor) -> Tensor:
    """Concatenate each neighbour with its centre (not with their difference).

    Args:
        points: (B, N, 3).
        neighbors: (B, N, k) indices into the N points.

    Returns:
        (k, B * N, 6), neighbours first: one slab of rows per neighbour rank.
    """
    batch, n, k = neighbors.shape
    offset = torch.arange(batch, device=points.device).view(-1, 1, 1) * n
    rows = points.reshape(-1, 3)
    neighbor = rows[(neighbors + offset).reshape(-1, k).T]
    return torch.cat([neighbor, rows.expand(k, -1, -1)], -1)


class Moments(NamedTuple):
    """First and second moments of rows: mean (C,) and covariance (C, C), float64."""

    mean: Tensor
    covariance: Tensor


def moments(rows: Tensor) -> Moments:
    """Moments over all leading dimensions of rows (..., C)."""
    with torch.autocast(rows.device.type, enabled=False):
        flat = rows.flatten(0, -2)
        flat = flat if flat.dtype == torch.float64 else flat.float()
        mean = flat.mean(0).double()
        second = (flat.mT @ flat).double() / len(flat)
    return Moments(mean, second - torch.outer(mean, mean))


class _TrackingNorm(nn.BatchNorm1d):
    """Batch norm's parameters and statistics, known to be there."""

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float


class FoldedNormLinear(nn.Module):
    """Linear without bias, batch norm, ReLU, and the maximum over the slabs.

    Equal to `relu(batch_norm(x @ W.T))` followed by an `amax` over dimension 0, with batch
    norm's own running statistics.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = _TrackingNorm(outputs)

    def forward(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Rows (k, P, inputs) -> activations (k, P, outputs) and their maximum (P, outputs)."""
        weight, norm = self.linear.weight, self.norm
        if self.training:
            mean_in, covariance_in = moments(rows)
            wide = weight.double()
            mean = wide @ mean_in
            variance = ((wide @ covariance_in) * wide).sum(-1).clamp_min(0)
            self._track(mean, variance, rows.shape[0] * rows.shape[1])
        else:
            mean, variance = norm.running_mean.double(), norm.running_var.double()
        gain = norm.weight.double() * torch.rsqrt(variance + norm.eps)
        bias = norm.bias.double() - gain * mean
        folded = gain.unsqueeze(-1) * weight.double()
        device = rows.device.type
        if torch.is_autocast_enabled(device):
            rows = rows.to(torch.get_autocast_dtype(device))
        return _LinearReluMax.apply(rows, folded.to(rows.dtype), bias.to(rows.dtype))

    @torch.no_grad()
    def _track(self, mean: Tensor, variance: Tensor, count: int) -> None:
        norm = self.norm
        norm.num_batches_tracked.add_(1)
        norm.running_mean.lerp_(mean.to(norm.running_mean.dtype), norm.momentum)
        unbiased = variance * (count / max(count - 1, 1))
        norm.running_var.lerp_(unbiased.to(norm.running_var.dtype), norm.momentum)


class _LinearReluMax(torch.autograd.Function):
    """relu(rows @ weight.T + bias) and its maximum over slabs; ties give to the first slab."""

    @staticmethod
    def forward(ctx, rows: Tensor, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ANN001
        ctx.set_materialize_grads(False)
        out = rows.new_empty(*rows.shape[:2], len(weight))
        top = rows.new_zeros(out.shape[1:])
        for slab, result in zip(rows, out, strict=True):
            torch.addmm(bias, slab, weight.T, out=result).relu_()
            torch.maximum(top, result, out=top)
        ctx.save_for_backward(rows, weight, out, top)
        return out, top

    @staticmethod
    def backward(ctx, grad_out: Tensor | None, grad_top: Tensor | None):  # type: ignore[override]  # noqa: ANN001, ANN205
        rows, weight, out, top = ctx.saved_tensors
        grad_rows = torch.empty_like(rows) if ctx.needs_input_grad[0] else None
        wide = torch.promote_types(weight.dtype, torch.float32)  # the sums over slabs
        grad_weight = torch.zeros_like(weight, dtype=wide)
        grad_bias = torch.zeros_like(weight[:, 0], dtype=wide)
        left = torch.zeros_like(top) if grad_top is None else grad_top.clone()
        grad = torch.empty_like(top)
        for j, (slab, result) in enumerate(zip(rows, out, strict=True)):
            # As numbers, not as a mask: masked kernels are several times slower on CPUs.
            torch.eq(result, top, out=grad).mul_(left)
            left -= grad
            if grad_out is not None:
                grad += grad_out[j]
            torch.ops.aten.threshold_backward.grad_input(grad, result, 0, grad_input=grad)
            grad_weight += grad.T @ slab
            grad_bias += grad.sum(0)
            if grad_rows is not None:
                torch.mm(grad, weight, out=grad_rows[j])
        return grad_rows, grad_weight.to(weight.dtype), grad_bias.to(weight.dtype)
