"""Fused edge MLP: linear layers, norms and ReLU on the edges of a neighbour graph, max-pooled.

A cloud of P points with K neighbours each has P * K edges, tens of times more rows than points. In
a plain implementation the norm, ReLU and maximum each pass over all of them. Here a norm needs no
pass: the mean and covariance of a linear layer's output follow from those of its input, so the
norm is folded into the weights before the matrix product. The input moments of the next layer are
accumulated slab by slab while a slab is in cache. The last layer's activations are never stored.

`batch_norm_edge_mlp` and `group_norm_edge_mlp` are drop-ins for the plain layers; their twins are
in tests/twins.py, and `make bench` shows where they pay.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

_SLAB_ROWS = 8192  # edges processed together
_MIN_EDGES = 2**15  # below, the plain layers of DGCNN are as fast


class Moments(NamedTuple):
    """Mean (B, C) and covariance (B, C, C) of the edges of each of B samples, in float64."""

    mean: Tensor
    covariance: Tensor


class FusedLinear(NamedTuple):
    """Weight (B, O, I) and bias (B, O) of a linear layer with its norm folded in, per sample."""

    weight: Tensor
    bias: Tensor


class LayerOutput(NamedTuple):
    """Output of `linear_relu_max`."""

    edges: Tensor | None  # (B, P, K, O) activations, if kept
    pooled: Tensor | None  # (B, P, O) maximum over the neighbours, if asked for
    moments: Moments | None  # of the activations, if gathered


def is_worthwhile(edges: Tensor) -> bool:
    """Tell whether fusing pays for batch-normed edges (..., K, C) of this number."""
    return edges.numel() // edges.shape[-1] >= _MIN_EDGES


def batch_norm_edge_mlp(
    edges: Tensor,
    linears: Sequence[nn.Linear],
    norms: Sequence[nn.BatchNorm1d],
    *,
    training: bool,
) -> list[Tensor]:
    """Apply linear, batch norm and ReLU layers to edges and max-pool after every layer.

    Equal to `x = relu(norm(linear(x)))` followed by `x.amax(-2)`, layer by layer, with batch
    norm's own running statistics.

    Args:
        edges: (P, K, I); the whole batch is one sample to a batch norm.
        linears: layers without bias.
        norms: one norm a layer.
        training: whether to use (and track) the statistics of these edges.

    Returns:
        The maximum over the neighbours after each layer, (P, O) each.
    """
    activations = edges.unsqueeze(0)
    input_moments = moments(activations) if training else None
    pooled = []
    for index, (linear, norm) in enumerate(zip(linears, norms, strict=True), 1):
        if input_moments is None:
            mean, variance = _running_statistics(norm)
        else:
            mean, variance = output_moments(linear, input_moments)
            _track(norm, mean[0], variance[0], edges.shape[0] * edges.shape[1])
        layer, more = fold_norm(linear, norm, mean, variance), index < len(linears)
        output = linear_relu_max(activations, layer, keep=more, gather=training and more)
        assert output.pooled is not None
        pooled.append(output.pooled[0])
        if output.edges is not None:
            activations, input_moments = output.edges, output.moments
    return pooled


def group_norm_edge_mlp(edges: Tensor, mlp: nn.Sequential) -> Tensor:
    """Apply a shared MLP with group norms to edges (B, P, K, I) and max-pool: (B, P, O).

    Args:
        edges: no gradient flows to their moments.
        mlp: 1 x 1 convolution, group norm and ReLU a layer, as `networks.pointnet.shared_mlp`.
    """
    layers = list(zip(mlp[::3], mlp[1::3], strict=True))
    output = LayerOutput(edges, None, moments(edges.detach()))
    for index, (linear, norm) in enumerate(layers, 1):
        assert isinstance(linear, nn.Conv1d)
        assert isinstance(norm, nn.GroupNorm)
        assert output.edges is not None
        assert output.moments is not None
        layer, more = _fold_group_norm(linear, norm, output.moments), index < len(layers)
        output = linear_relu_max(output.edges, layer, keep=more, pool=not more, gather=more)
    assert output.pooled is not None
    return output.pooled


def moments(edges: Tensor) -> Moments:
    """Compute the moments of edges (B, P, K, C)."""
    with torch.autocast(edges.device.type, enabled=False):
        flat = _at_least_float32(edges.flatten(1, 2))
        return _moments_from_sums(flat.sum(1), flat.mT @ flat, flat.shape[1])


def output_moments(linear: nn.Linear | nn.Conv1d, input_moments: Moments) -> tuple[Tensor, Tensor]:
    """Compute mean and variance (B, O) of a linear layer's output from its input's moments."""
    weight = linear.weight.view(len(linear.weight), -1).double()
    mean = input_moments.mean @ weight.mT + (0 if linear.bias is None else linear.bias.double())
    return mean, ((weight @ input_moments.covariance) * weight).sum(-1).clamp_min(0)


def fold_norm(
    linear: nn.Linear | nn.Conv1d,
    norm: nn.BatchNorm1d | nn.GroupNorm,
    mean: Tensor,
    variance: Tensor,
) -> FusedLinear:
    """Fold the norm that follows a linear layer into its weight and bias.

    Args:
        linear: weight (O, I) or (O, I, 1), bias (O,) or None.
        norm: gain and shift (O,) and the epsilon.
        mean: (B, O) that the norm subtracts from the layer's output.
        variance: (B, O) by whose root it divides.
    """
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    bias = 0 if linear.bias is None else linear.bias.double()
    weight = linear.weight.view(len(linear.weight), -1).double()
    return FusedLinear(scale.unsqueeze(-1) * weight, scale * (bias - mean) + norm.bias)


def _fold_group_norm(linear: nn.Conv1d, norm: nn.GroupNorm, input_moments: Moments) -> FusedLinear:
    """Fold a group norm: its statistics are those of a group's channels together."""
    per_channel = output_moments(linear, input_moments)
    mean, variance = (t.unflatten(-1, (norm.num_groups, -1)) for t in per_channel)
    group_mean = mean.mean(-1, keepdim=True)
    group_variance = (variance + (mean - group_mean).square()).mean(-1, keepdim=True)
    statistics = (t.expand_as(mean).flatten(1) for t in (group_mean, group_variance))
    return fold_norm(linear, norm, *statistics)


def _running_statistics(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Return a batch norm's running mean and variance, (1, O) float64."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    return norm.running_mean.double()[None], norm.running_var.double()[None]


@torch.no_grad()
def _track(norm: nn.BatchNorm1d, mean: Tensor, variance: Tensor, count: int) -> None:
    """Update running statistics as torch's batch norm does."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    assert norm.momentum is not None
    norm.num_batches_tracked.add_(1)
    norm.running_mean.lerp_(mean.to(norm.running_mean.dtype), norm.momentum)
    unbiased = variance * (count / max(count - 1, 1))
    norm.running_var.lerp_(unbiased.to(norm.running_var.dtype), norm.momentum)


def linear_relu_max(
    edges: Tensor, layer: FusedLinear, *, keep: bool, pool: bool = True, gather: bool = False
) -> LayerOutput:
    """Compute relu(edges @ weight.T + bias) and its maximum over the neighbours.

    Of equal maxima one gets the gradient.

    Args:
        edges: (B, P, K, I).
        layer: one for each sample.
        keep: whether to return the activations.
        pool: whether to return their maximum.
        gather: whether to return their moments as well; needs `keep`.
    """
    device = edges.device.type
    if torch.is_autocast_enabled(device):
        edges = edges.to(torch.get_autocast_dtype(device))
    weight, bias = layer.weight.to(edges.dtype), layer.bias.to(edges.dtype)
    out, pooled, total, second = _LinearReluMax.apply(edges, weight, bias, keep, pool, gather)
    count = edges.shape[1] * edges.shape[2]
    return LayerOutput(out, pooled, _moments_from_sums(total, second, count) if gather else None)


def _moments_from_sums(total: Tensor, second: Tensor, count: int) -> Moments:
    """Compute moments from sums (B, C) and sums of outer products (B, C, C)."""
    mean = total.double() / count
    return Moments(mean, second.double() / count - mean.unsqueeze(-1) * mean.unsqueeze(-2))


def _at_least_float32(edges: Tensor) -> Tensor:
    return edges if edges.dtype == torch.float64 else edges.float()


def _slabs(batch: int, points: int, size: int) -> list[tuple[int, slice]]:
    """Split a batch into slabs: sample by sample, `size` points at a time."""
    starts = range(0, points, size)
    return [(b, slice(at, min(at + size, points))) for b in range(batch) for at in starts]


class _LinearReluMax(torch.autograd.Function):
    """`linear_relu_max` slab by slab, forward and backward."""

    @staticmethod
    def forward(  # noqa: ANN205
        ctx,  # noqa: ANN001
        edges: Tensor,
        weight: Tensor,
        bias: Tensor,
        keep: bool,
        pool: bool,
        gather: bool,
    ):
        """Compute outputs, maxima and moments slab by slab; save only what backward reads."""
        ctx.set_materialize_grads(False)
        batch, points, k, _ = edges.shape
        size = max(1, _SLAB_ROWS // k)
        shape = (k, weight.shape[1])
        out = edges.new_empty(batch, points, *shape) if keep else None
        pooled = edges.new_empty(batch, points, shape[1]) if pool else None
        argmax = None
        if pooled is not None and any(ctx.needs_input_grad):
            argmax = torch.empty_like(pooled, dtype=torch.int16)
        positions = torch.arange(k, dtype=torch.float32, device=edges.device).unsqueeze(-1)
        scratch, marks = edges.new_empty(size, *shape), positions.new_empty(size, *shape)
        total = _at_least_float32(bias).new_zeros(batch, shape[1]) if gather else None
        second = _at_least_float32(bias).new_zeros(batch, shape[1], shape[1]) if gather else None
        for b, part in _slabs(batch, points, size):
            size_here = part.stop - part.start
            active = scratch[:size_here] if out is None else out[b, part]
            flat = active.view(-1, shape[1])
            torch.addmm(bias[b], edges[b, part].flatten(0, 1), weight[b].mT, out=flat).relu_()
            if pooled is not None:
                torch.amax(active, 1, out=pooled[b, part])
            if pooled is not None and argmax is not None:
                # As numbers: torch's maximum with indices takes several times as long.
                torch.eq(active, pooled[b, part].unsqueeze(1), out=marks[:size_here]).mul_(
                    positions
                )
                argmax[b, part] = marks[:size_here].amax(1).to(argmax.dtype)
            if total is not None and second is not None:
                flat_wide = _at_least_float32(flat)
                total[b] += flat_wide.sum(0)
                second[b].addmm_(flat_wide.mT, flat_wide)
        ctx.save_for_backward(edges, weight, out, pooled, argmax)
        return out, pooled, total, second

    @staticmethod
    def backward(  # noqa: ANN205
        ctx,  # noqa: ANN001
        grad_out: Tensor | None,
        grad_pooled: Tensor | None,
        grad_total: Tensor | None,
        grad_second: Tensor | None,
    ):
        """Compute the gradients of edges, weight and bias; each slab is computed again."""
        edges, weight, out, pooled, argmax = ctx.saved_tensors
        batch, points, k, _ = edges.shape
        size, outputs = max(1, _SLAB_ROWS // k), weight.shape[1]
        grad_edges = torch.empty_like(edges) if ctx.needs_input_grad[0] else None
        # Inputs first: a product with few columns takes several times as long as its transpose.
        grad_weight = torch.zeros_like(_at_least_float32(weight.mT))
        grad_bias = torch.zeros_like(grad_weight[:, 0])
        grad_pooled = None if grad_pooled is None else grad_pooled * (pooled > 0)
        grad_outer = None if grad_second is None else (grad_second + grad_second.mT).to(edges.dtype)
        scratch = edges.new_empty(size, k, outputs)
        for b, part in _slabs(batch, points, size):
            grad = scratch[: part.stop - part.start]
            flat = grad.view(-1, outputs)
            grad.zero_() if grad_out is None else grad.copy_(grad_out[b, part])
            if grad_pooled is not None:
                winners = argmax[b, part].long().unsqueeze(1)
                grad.scatter_add_(1, winners, grad_pooled[b, part].unsqueeze(1))
            if out is not None:
                active = out[b, part].flatten(0, 1)
                if grad_outer is not None and grad_total is not None:
                    flat.addmm_(active, grad_outer[b]).add_(grad_total[b])
                torch.ops.aten.threshold_backward.grad_input(flat, active, 0, grad_input=flat)
            grad_weight[b] += edges[b, part].flatten(0, 1).mT @ flat
            grad_bias[b] += flat.sum(0)
            if grad_edges is not None:
                torch.mm(flat, weight[b], out=grad_edges[b, part].flatten(0, 1))
        return (
            grad_edges,
            grad_weight.mT.to(weight.dtype),
            grad_bias.to(weight.dtype),
            None,
            None,
            None,
        )
