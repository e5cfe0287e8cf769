"""Edges of a neighbour graph: linear layer, norm, ReLU, and the maximum over neighbours.

An edge tensor has P points times K neighbours as rows, tens of times more than the cloud, and in
a plain rewrite norm, ReLU and maximum pass over it again and again. Here a norm costs no pass:
mean and covariance of a linear layer's output follow from those of its input, so the norm is
folded into the weights before the one matrix product, and the moments that the next layer needs
are gathered slab by slab, while a slab is in cache. Where only the maximum is asked for, the
edges are never there all at once.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

_ROWS = 8192  # edges of a slab


class Moments(NamedTuple):
    """Mean (B, C) and covariance (B, C, C) of the edges of each of B samples, in float64."""

    mean: Tensor
    covariance: Tensor


class Linear(NamedTuple):
    """Weight (B, O, I) and bias (B, O) of a linear layer of each of B samples."""

    weight: Tensor
    bias: Tensor


class Edges(NamedTuple):
    """What `linear_relu_max` gives."""

    rows: Tensor | None  # (B, P, K, O), if kept
    top: Tensor  # (B, P, O) maximum over the neighbours
    moments: Moments | None  # of rows, if gathered


def moments(rows: Tensor) -> Moments:
    """Moments of edges (B, P, K, C)."""
    with torch.autocast(rows.device.type, enabled=False):
        flat = _wide(rows.flatten(1, 2))
        return _moments(flat.sum(1), flat.mT @ flat, flat.shape[1])


def folded(
    linear: nn.Linear | nn.Conv1d,
    norm: nn.BatchNorm1d | nn.GroupNorm,
    mean: Tensor,
    variance: Tensor,
) -> Linear:
    """A linear layer and the norm after it as one linear layer for each of B samples.

    Args:
        linear: weight (O, I) or (O, I, 1), bias (O,) or None.
        norm: gain and shift (O,) and the epsilon.
        mean: (B, O) that the norm takes off the layer's output.
        variance: (B, O) that it divides by the root of.
    """
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    start = 0 if linear.bias is None else linear.bias.double()
    weight = linear.weight.view(len(linear.weight), -1).double()
    return Linear(scale.unsqueeze(-1) * weight, scale * (start - mean) + norm.bias)


def output_moments(linear: nn.Linear | nn.Conv1d, seen: Moments) -> tuple[Tensor, Tensor]:
    """Mean and variance (B, O) of the output of a linear layer whose input has been seen."""
    weight = linear.weight.view(len(linear.weight), -1).double()
    mean = seen.mean @ weight.mT + (0 if linear.bias is None else linear.bias.double())
    return mean, ((weight @ seen.covariance) * weight).sum(-1).clamp_min(0)


def top_of_mlp(rows: Tensor, mlp: nn.Sequential) -> Tensor:
    """A shared MLP with group norms on edges (B, P, K, I), and the maximum (B, P, O) over K.

    Args:
        rows: edges; no gradient goes to their moments.
        mlp: from `shared_mlp`.
    """
    layers = list(zip(mlp[::3], mlp[1::3], strict=True))
    found = Edges(rows, rows, moments(rows.detach()))
    for at, (linear, norm) in enumerate(layers, 1):
        assert isinstance(linear, nn.Conv1d)
        assert isinstance(norm, nn.GroupNorm)
        assert found.rows is not None
        assert found.moments is not None
        layer, more = _group_normed(linear, norm, found.moments), at < len(layers)
        found = linear_relu_max(found.rows, layer, keep=more, gather=more)
    return found.top


def _group_normed(linear: nn.Conv1d, norm: nn.GroupNorm, seen: Moments) -> Linear:
    """A linear layer and the group norm after it, folded."""
    mean, variance = (t.unflatten(-1, (norm.num_groups, -1)) for t in output_moments(linear, seen))
    common = mean.mean(-1, keepdim=True)
    spread = (variance + (mean - common).square()).mean(-1, keepdim=True)
    whole = (t.expand_as(mean).flatten(1) for t in (common, spread))
    return folded(linear, norm, *whole)


def linear_relu_max(rows: Tensor, layer: Linear, *, keep: bool, gather: bool = False) -> Edges:
    """relu(rows @ weight.T + bias) and its maximum over the neighbours.

    Of neighbours that are equally high, one is the maximum and gets its gradient.

    Args:
        rows: (B, P, K, I) edges.
        layer: one for each sample.
        keep: whether the activations are wanted besides their maximum.
        gather: whether their moments are wanted as well; needs `keep`.
    """
    device = rows.device.type
    if torch.is_autocast_enabled(device):
        rows = rows.to(torch.get_autocast_dtype(device))
    weight, bias = layer.weight.to(rows.dtype), layer.bias.to(rows.dtype)
    out, top, total, second = _LinearReluMax.apply(rows, weight, bias, keep, gather)
    count = rows.shape[1] * rows.shape[2]
    return Edges(out, top, _moments(total, second, count) if gather else None)


def _moments(total: Tensor, second: Tensor, count: int) -> Moments:
    mean = total.double() / count
    return Moments(mean, second.double() / count - mean.unsqueeze(-1) * mean.unsqueeze(-2))


def _wide(rows: Tensor) -> Tensor:
    return rows if rows.dtype == torch.float64 else rows.float()


def _slabs(batch: int, points: int, size: int) -> list[tuple[int, slice]]:
    """Sample by sample, `size` points at a time."""
    starts = range(0, points, size)
    return [(b, slice(at, min(at + size, points))) for b in range(batch) for at in starts]


class _LinearReluMax(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows: Tensor, weight: Tensor, bias: Tensor, keep: bool, gather: bool):  # noqa: ANN001, ANN205
        ctx.set_materialize_grads(False)
        batch, points, k, _ = rows.shape
        size = max(1, _ROWS // k)
        shape = (k, weight.shape[1])
        out = rows.new_empty(batch, points, *shape) if keep else None
        top = rows.new_empty(batch, points, shape[1])
        learning = any(ctx.needs_input_grad)
        which = torch.empty_like(top, dtype=torch.int16) if learning else None
        ranks = torch.arange(k, dtype=torch.float32, device=rows.device).unsqueeze(-1)
        scratch, marks = rows.new_empty(size, *shape), ranks.new_empty(size, *shape)
        total = _wide(bias).new_zeros(batch, shape[1]) if gather else None
        second = _wide(bias).new_zeros(batch, shape[1], shape[1]) if gather else None
        for b, part in _slabs(batch, points, size):
            some = part.stop - part.start
            active = scratch[:some] if out is None else out[b, part]
            flat = active.view(-1, shape[1])
            torch.addmm(bias[b], rows[b, part].flatten(0, 1), weight[b].mT, out=flat).relu_()
            torch.amax(active, 1, out=top[b, part])
            if which is not None:
                # As numbers: torch's maximum with indices takes several times as long.
                torch.eq(active, top[b, part].unsqueeze(1), out=marks[:some]).mul_(ranks)
                which[b, part] = marks[:some].amax(1).to(which.dtype)
            if total is not None and second is not None:
                wide = _wide(flat)
                total[b] += wide.sum(0)
                second[b].addmm_(wide.mT, wide)
        ctx.save_for_backward(rows, weight, out, top, which)
        return out, top, total, second

    @staticmethod
    def backward(  # noqa: ANN205
        ctx,  # noqa: ANN001
        grad_out: Tensor | None,
        grad_top: Tensor | None,
        grad_total: Tensor | None,
        grad_second: Tensor | None,
    ):
        rows, weight, out, top, which = ctx.saved_tensors
        batch, points, k, _ = rows.shape
        size, outputs = max(1, _ROWS // k), weight.shape[1]
        grad_rows = torch.empty_like(rows) if ctx.needs_input_grad[0] else None
        # Inputs first: a product with few columns takes several times as long as its transpose.
        grad_weight = torch.zeros_like(_wide(weight.mT))
        grad_bias = torch.zeros_like(grad_weight[:, 0])
        grad_top = None if grad_top is None else grad_top * (top > 0)
        bend = None if grad_second is None else (grad_second + grad_second.mT).to(rows.dtype)
        scratch = rows.new_empty(size, k, outputs)
        for b, part in _slabs(batch, points, size):
            grad = scratch[: part.stop - part.start]
            flat = grad.view(-1, outputs)
            grad.zero_() if grad_out is None else grad.copy_(grad_out[b, part])
            if grad_top is not None:
                winner = which[b, part].long().unsqueeze(1)
                grad.scatter_add_(1, winner, grad_top[b, part].unsqueeze(1))
            if out is not None:
                active = out[b, part].flatten(0, 1)
                if bend is not None and grad_total is not None:
                    flat.addmm_(active, bend[b]).add_(grad_total[b])
                torch.ops.aten.threshold_backward.grad_input(flat, active, 0, grad_input=flat)
            grad_weight[b] += rows[b, part].flatten(0, 1).mT @ flat
            grad_bias[b] += flat.sum(0)
            if grad_rows is not None:
                torch.mm(flat, weight[b], out=grad_rows[b, part].flatten(0, 1))
        return grad_rows, grad_weight.mT.to(weight.dtype), grad_bias.to(weight.dtype), None, None
