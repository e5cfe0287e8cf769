"""Fused edge MLP: linear layers, norms and ReLU on the edges of a neighbour graph, max-pooled.

A cloud of P points with K neighbours each has P * K edges, tens of times more rows than points. In
a plain implementation the norm, the ReLU and the maximum each pass over all of them. Here a layer
stores its output before the norm, and the next layer applies norm and ReLU when it reads a slab of
edges that fits in the cache. The norm's statistics are summed while the slab is there.

Norm and ReLU keep the order of a channel's values (or reverse it), so the maximum is taken before
them, and the last layer's edges are never stored. Their gradient has two parts, both cheap: few
edges win a maximum, and the statistics' gradient is an affine function of the layer's input.

`batch_norm_edge_mlp`, `group_norm_edge_mlp` and `linear_max` are drop-ins for the plain layers.
Their twins are in tests/twins.py, and `make bench` shows where they pay.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_SLAB_VALUES = 2**20  # values of the edges that are processed together, on a CPU
_GPU_SLAB_VALUES = 2**27
_MIN_EDGES = 2**15  # below, the plain layers of DGCNN are as fast
_MIN_ROWS = 2**12  # below, plain layers with group norms are faster

Linear = nn.Linear | nn.Conv1d
Norm = nn.BatchNorm1d | nn.GroupNorm


_Slab = tuple[slice, slice]  # samples and points
_Pooled = tuple[Tensor, Tensor]


class Statistics(NamedTuple):
    """Mean and variance (B, C) of the channels of B samples, in float64."""

    mean: Tensor
    variance: Tensor


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

    def statistics_of(norm: nn.BatchNorm1d, channels: Statistics | None) -> Statistics:
        if channels is None:
            return _running_statistics(norm)
        _track(norm, channels, edges.shape[0] * edges.shape[1])
        return channels

    layers = list(zip(linears, norms, strict=True))
    pooled = _edge_mlp(edges.unsqueeze(0), layers, statistics_of, gather=training, pool_all=True)
    return [features[0] for features in pooled]


def group_norm_edge_mlp(edges: Tensor, mlp: nn.Sequential) -> Tensor:
    """Apply a shared MLP with group norms to edges (B, P, K, I) and max-pool: (B, P, O).

    Args:
        edges: K edges of each point.
        mlp: 1 x 1 convolution, group norm and ReLU a layer, as `networks.pointnet.shared_mlp`.
    """

    def statistics_of(norm: nn.GroupNorm, channels: Statistics | None) -> Statistics:
        assert channels is not None
        return _group_statistics(channels, norm.num_groups)

    if edges[..., 0].numel() < _MIN_ROWS:
        return mlp(edges.flatten(1, 2).mT).unflatten(-1, edges.shape[1:3]).amax(-1).mT
    layers = list(zip(mlp[::3], mlp[1::3], strict=True))
    return _edge_mlp(edges, layers, statistics_of, gather=True, pool_all=False)[0]


def linear_max(rows: Tensor, linear: nn.Linear) -> Tensor:
    """Compute the maximum of a linear layer's output over the rows: (B, N, I) to (B, O).

    Equal to `linear(rows).amax(1)`, but of equal maxima one gets the gradient.
    """
    rows = _autocast(rows)
    weight, bias = (t.to(rows.dtype) for t in (linear.weight, linear.bias))
    _, pooled, _, _ = _Layer.apply(
        rows.unsqueeze(1), None, None, weight, bias, False, True, False
    )  # fmt: skip
    return pooled.squeeze(1)


def _edge_mlp(
    edges: Tensor,
    layers: Sequence[tuple[nn.Module, nn.Module]],
    statistics_of: Callable[..., Statistics],
    *,
    gather: bool,
    pool_all: bool,
) -> list[Tensor]:
    """Apply layers to edges (B, P, K, I); return the maxima (B, P, O) of the last or of all.

    Variances come from sums of squares, in the precision of the edges or float32. They are inexact
    where a channel's mean is many times its deviation, which the norms of a network keep it from.

    Args:
        edges: of B samples.
        layers: the linear layer and the norm of each.
        statistics_of: which statistics a norm uses, from those of the channels if gathered.
        gather: whether to gather the statistics of the channels.
        pool_all: whether to pool after every layer.
    """
    edges = _autocast(edges)
    count = edges.shape[1] * edges.shape[2]
    scale, shift, maxima = None, None, []
    for index, (linear, norm) in enumerate(layers, 1):
        assert isinstance(linear, Linear)
        assert isinstance(norm, Norm)
        more = index < len(layers)
        # A negative gain makes a channel's smallest value its largest: the layer is negated there.
        sign = torch.where(norm.weight < 0, -1.0, 1.0).to(norm.weight.dtype)
        weight = sign.unsqueeze(1) * linear.weight.flatten(1)
        bias = torch.zeros_like(sign) if linear.bias is None else sign * linear.bias
        edges, pooled, total, square = _Layer.apply(
            edges, scale, shift, weight.to(edges.dtype), bias.to(edges.dtype),
            more, pool_all or not more, gather,
        )  # fmt: skip
        channels = None
        if gather:
            mean = total / count
            channels = Statistics(sign * mean, (square / count - mean.square()).clamp_min(0))
        mean, variance = statistics_of(norm, channels)
        gain = norm.weight * torch.rsqrt(variance + norm.eps)
        scale, shift = sign * gain, norm.bias - gain * mean
        if pooled is not None:
            dtype = pooled.dtype
            normed = pooled * scale.unsqueeze(1).to(dtype) + shift.unsqueeze(1).to(dtype)
            maxima.append(F.relu(normed))
    return maxima


def _group_statistics(channels: Statistics, groups: int) -> Statistics:
    """Compute the statistics of a group's channels together, repeated for each channel."""
    mean, variance = (t.unflatten(-1, (groups, -1)) for t in channels)
    group_mean = mean.mean(-1, keepdim=True)
    group_variance = (variance + (mean - group_mean).square()).mean(-1, keepdim=True)
    return Statistics(*(t.expand_as(mean).flatten(1) for t in (group_mean, group_variance)))


def _running_statistics(norm: nn.BatchNorm1d) -> Statistics:
    """Return a batch norm's running mean and variance, (1, C)."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    return Statistics(norm.running_mean.double()[None], norm.running_var.double()[None])


@torch.no_grad()
def _track(norm: nn.BatchNorm1d, statistics: Statistics, count: int) -> None:
    """Update running statistics as torch's batch norm does."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    assert norm.momentum is not None
    norm.num_batches_tracked.add_(1)
    unbiased = statistics.variance[0] * (count / max(count - 1, 1))
    # Unseen by autograd, as in torch's batch norm: the norm of another cloud may have saved them.
    mean, variance = norm.running_mean.data, norm.running_var.data
    mean.lerp_(statistics.mean[0].to(mean.dtype), norm.momentum)
    variance.lerp_(unbiased.to(variance.dtype), norm.momentum)


class _Layer(torch.autograd.Function):
    """A linear layer on relu(edges * scale + shift), slab by slab, forward and backward.

    Inputs:
        edges: (B, P, K, I), the output of the layer before, or the network's input.
        scale, shift: (B, I), the norm of the layer before; None for the network's input.
        weight, bias: (O, I) and (O,).
        keep, pool, gather: which outputs are asked for; the others are None.

    Outputs:
        z (B, P, K, O), before its own norm; its maximum over the neighbours (B, P, O), of equal
        values the last gets the gradient; the sums of z and of z^2, (B, O) float64.
    """

    @staticmethod
    def forward(  # noqa: ANN205
        ctx,  # noqa: ANN001
        edges: Tensor,
        scale: Tensor | None,
        shift: Tensor | None,
        weight: Tensor,
        bias: Tensor,
        keep: bool,
        pool: bool,
        gather: bool,
    ):
        """Compute outputs, maxima and sums slab by slab; save what backward reads."""
        ctx.set_materialize_grads(False)
        (batch, points, k, _), outputs = edges.shape, len(weight)
        out = edges.new_empty(batch, points, k, outputs) if keep else None
        pooled = edges.new_empty(batch, points, outputs) if pool else None
        index = torch.int16 if k <= torch.iinfo(torch.int16).max else torch.int32
        winner = edges.new_empty(batch, points, outputs, dtype=index) if pool else None
        total = edges.new_zeros(batch, outputs, dtype=torch.float64) if gather else None
        square = torch.zeros_like(total) if total is not None else None
        wide, scratch, norm = _wide(edges), _Scratch(edges), _as_slabs(edges, scale, shift)
        place = torch.arange(k, dtype=wide, device=edges.device).unsqueeze(-1)
        for slab in _slabs(edges, outputs):
            x = _active(edges, norm, slab, scratch)
            shape = *x.shape[:3], outputs
            z = scratch("z", shape) if out is None else out[slab]
            torch.addmm(bias, x.flatten(0, 2), weight.mT, out=z.view(-1, outputs))
            if total is not None and square is not None:
                rows = z.flatten(1, 2).to(wide)
                total[slab[0]] += rows.sum(1)
                squares = torch.mul(rows, rows, out=scratch("wide", rows.shape, wide))
                square[slab[0]] += squares.sum(1)
            if pooled is not None and winner is not None:
                pooled[slab] = z.amax(2)
                # As numbers: torch's maximum with indices takes several times as long.
                wins = scratch("wide", shape, wide)
                torch.eq(z, pooled[slab].unsqueeze(2), out=wins).mul_(place)
                winner[slab] = wins.amax(2).to(winner.dtype)
        ctx.save_for_backward(edges, scale, shift, weight, bias, out, winner)
        return out, pooled, total, square

    @staticmethod
    def backward(  # noqa: ANN205
        ctx,  # noqa: ANN001
        grad_out: Tensor | None,
        grad_pooled: Tensor | None,
        grad_total: Tensor | None,
        grad_square: Tensor | None,
    ):
        """Compute the gradients slab by slab; activations are computed again."""
        edges, scale, shift, weight, bias, out, winner = ctx.saved_tensors
        grad_edges = torch.empty_like(edges) if ctx.needs_input_grad[0] else None
        grad_scale = None if scale is None else torch.zeros_like(scale)
        grad_shift = None if shift is None else torch.zeros_like(shift)
        if out is not None and grad_out is None:
            grad_out = torch.zeros_like(out)
        scratch, norm = _Scratch(edges), _as_slabs(edges, scale, shift)
        gradient = _LinearGradient(weight, bias, len(edges), grad_total, grad_square)
        for slab in _slabs(edges, len(weight)):
            samples, x = slab[0], _active(edges, norm, slab, scratch)
            grad_x = None if grad_edges is None else grad_edges[slab]
            pooled = None if grad_pooled is None else (winner[slab], grad_pooled[slab])
            if out is None:
                gradient.from_maximum(x, pooled, samples, grad_x)
            else:
                # In place: the next layer made this gradient, and nobody else reads it.
                assert grad_out is not None
                gradient.from_output(x, out[slab], grad_out[slab], pooled, samples, grad_x)
            if grad_x is not None and grad_scale is not None and grad_shift is not None:
                assert norm is not None
                torch.ops.aten.threshold_backward.grad_input(grad_x, x, 0, grad_input=grad_x)
                grad_shift[samples] += grad_x.flatten(1, 2).sum(1)
                torch.mul(grad_x, edges[slab], out=x)
                grad_scale[samples] += x.flatten(1, 2).sum(1)
                grad_x *= norm[0][samples]
        count = edges.shape[1] * edges.shape[2] if out is None else 0
        return grad_edges, grad_scale, grad_shift, *gradient.of_parameters(count), None, None, None


class _LinearGradient:
    """Gradients of z = x W^T + b, by x slab by slab, and by W and b at the end.

    The sums of z and of z^2 have a gradient as well. By z it is `slope * z + offset`, with slope
    and offset (B, O), so it can be had without z: by x it is affine in x, and by W and b it
    follows from the sums of x and of x x^T.
    """

    def __init__(
        self,
        weight: Tensor,
        bias: Tensor,
        samples: int,
        grad_total: Tensor | None,
        grad_square: Tensor | None,
    ) -> None:
        (outputs, inputs), wide = weight.shape, _wide(weight)
        self.weight = weight
        # Inputs first: a product with few columns takes several times as long as its transpose.
        self.by_weight = weight.new_zeros(inputs, outputs, dtype=wide)
        self.by_bias = weight.new_zeros(outputs, dtype=wide)
        self.slope = self.offset = self.broadcast = None
        if grad_total is not None and grad_square is not None:
            self.slope, self.offset = 2 * grad_square, grad_total
            self.broadcast = _as_slabs(weight, self.slope, self.offset)
            self.constant = self.slope * bias.double() + self.offset  # (B, O)
            self.sum_x = weight.new_zeros(samples, inputs, dtype=wide)
            self.sum_xx = weight.new_zeros(samples, inputs, inputs, dtype=wide)

    @functools.cached_property
    def _by_x(self) -> tuple[Tensor, Tensor]:
        """Matrix (B, I, I) and vector (B, I): the sums' gradient by x is x @ matrix + vector."""
        assert self.slope is not None
        w = self.weight.double()
        matrix, vector = (w.mT * self.slope.unsqueeze(1)) @ w, self.constant @ w
        return matrix.to(self.weight.dtype), vector.to(self.weight.dtype)

    def from_output(
        self,
        x: Tensor,
        z: Tensor,
        grad: Tensor,
        pooled: _Pooled | None,
        b: slice,
        by_x: Tensor | None,
    ) -> None:
        """Compute the gradient of x from that of z, which is overwritten.

        Args:
            x: (b, p, K, I) of a slab.
            z: (b, p, K, O).
            grad: (b, p, K, O), gradient of z.
            pooled: winners and gradient of the maximum over the neighbours, (b, p, O) each.
            b: samples of the slab.
            by_x: (b, p, K, I), where the gradient of x is written; None if nobody asks for it.
        """
        if self.broadcast is not None:
            slope, offset = (value[b] for value in self.broadcast)
            grad.addcmul_(z, slope).add_(offset)
        if pooled is not None:
            winner, grad_pooled = (t.unsqueeze(2) for t in pooled)
            grad.scatter_add_(2, winner.long(), grad_pooled)
        rows = grad.flatten(0, 2)
        self.by_weight += x.flatten(0, 2).mT @ rows
        self.by_bias += rows.sum(0)
        if by_x is not None:
            torch.mm(rows, self.weight, out=by_x.flatten(0, 2))

    def from_maximum(
        self, x: Tensor, pooled: _Pooled | None, b: slice, by_x: Tensor | None
    ) -> None:
        """Compute the gradient of x where z is only pooled and summed; see `from_output`."""
        rows, grad = x.flatten(1, 2), None if by_x is None else by_x.flatten(1, 2)
        if self.slope is not None:
            self.sum_x[b] += rows.sum(1)
            self.sum_xx[b] += rows.mT @ rows
            if grad is not None:
                matrix, vector = (t[b] for t in self._by_x)
                torch.baddbmm(vector.unsqueeze(1), rows, matrix, out=grad)
        elif grad is not None:
            grad.zero_()
        if pooled is not None:
            winner, grad_pooled = (t.flatten(0, 1) for t in pooled)  # (n, O)
            self.by_bias += grad_pooled.sum(0)
            k, rows = x.shape[2], x.flatten(0, 2)
            start = torch.arange(0, len(rows), k, dtype=torch.int32, device=x.device).unsqueeze(1)
            # By W: every channel sums the rows that won it. By x: every row sums the weights of
            # the channels that it won. Sorted by winner, the channels of a row are neighbours.
            bounds = torch.arange(0, winner.numel() + 1, len(winner), device=x.device)
            index = (start + winner).mT.flatten()
            self.by_weight += _bag_sums(rows, index, bounds, grad_pooled.mT).mT
            if grad is None:
                return
            winner, channel = winner.sort(1)
            each_row = torch.arange(len(rows) + 1, device=x.device)
            bounds = torch.searchsorted((start + winner).flatten(), each_row)
            weights = grad_pooled.gather(1, channel)
            grad += _bag_sums(self.weight, channel.flatten(), bounds, weights).view_as(grad)

    def of_parameters(self, count: int) -> tuple[Tensor, Tensor]:
        """Return the gradients of W (O, I) and b (O,), after all slabs.

        Args:
            count: edges of a sample that `from_maximum` has seen.
        """
        by_weight, by_bias = self.by_weight.mT.double(), self.by_bias.double()
        if count and self.slope is not None:
            w, sum_x, sum_xx = (t.double() for t in (self.weight, self.sum_x, self.sum_xx))
            slope = self.slope.unsqueeze(2)
            by_weight = by_weight + (slope * (w @ sum_xx)).sum(0) + self.constant.mT @ sum_x
            by_bias = by_bias + (self.slope * (sum_x @ w.mT) + count * self.constant).sum(0)
        return by_weight.to(self.weight.dtype), by_bias.to(self.weight.dtype)


def _bag_sums(rows: Tensor, index: Tensor, bounds: Tensor, weights: Tensor) -> Tensor:
    """Sum weighted rows in bags: bag i has the entries from bounds[i] to bounds[i + 1].

    Args:
        rows: (n, C).
        index: (E,) which row each entry is.
        bounds: (bags + 1,).
        weights: E weights.

    Returns:
        (bags, C).
    """
    return F.embedding_bag(
        index.int(), rows, bounds.int(), mode="sum",
        per_sample_weights=weights.flatten(), include_last_offset=True,
    )  # fmt: skip


class _Scratch:
    """Memory that every slab uses again, so that it stays in the cache; the first is largest."""

    def __init__(self, like: Tensor) -> None:
        self._like = like
        self._buffers: dict[str, Tensor] = {}

    def __call__(self, name: str, shape: Sequence[int], dtype: torch.dtype | None = None) -> Tensor:
        """Return a tensor of this shape, with the content of its last use."""
        size = math.prod(shape)
        if name not in self._buffers:
            self._buffers[name] = self._like.new_empty(size, dtype=dtype or self._like.dtype)
        return self._buffers[name][:size].view(shape)


def _slabs(edges: Tensor, outputs: int) -> list[_Slab]:
    """Split edges (B, P, K, I) into slabs: some whole samples, or some points of one sample."""
    batch, points, k, inputs = edges.shape
    values = _GPU_SLAB_VALUES if edges.is_cuda else _SLAB_VALUES
    size = max(1, values // (k * max(inputs, outputs)))  # points of a slab
    samples = max(1, size // points)
    return [
        (slice(b, min(b + samples, batch)), slice(p, min(p + size, points)))
        for b in range(0, batch, samples)
        for p in range(0, points, size)
    ]


def _as_slabs(like: Tensor, *values: Tensor | None) -> tuple[Tensor, ...] | None:
    """Shape values (B, C) so that they broadcast over a slab; None if there are none."""
    present = [value[:, None, None].to(like.dtype) for value in values if value is not None]
    return tuple(present) or None


def _active(
    edges: Tensor, norm: tuple[Tensor, ...] | None, slab: _Slab, scratch: _Scratch
) -> Tensor:
    """Apply norm and ReLU of the layer before to a slab of its output: (b, p, K, I)."""
    values = edges[slab]
    if norm is None:
        return values
    scale, shift = (value[slab[0]] for value in norm)
    return torch.addcmul(shift, values, scale, out=scratch("x", values.shape)).relu_()


def _autocast(values: Tensor) -> Tensor:
    """Convert values to the format of autocast, if it is on."""
    device = values.device.type
    if torch.is_autocast_enabled(device):
        return values.to(torch.get_autocast_dtype(device))
    return values


def _wide(values: Tensor) -> torch.dtype:
    """Return the format for sums of these values: float32, or float64 for float64."""
    return torch.promote_types(values.dtype, torch.float32)
