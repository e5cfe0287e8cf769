"""Softmax rows of an N x M matrix of dot products that never exists.

Everything the losses and poses ask of a correspondence matrix is a log-sum-exp over its rows or
a mean under their softmax. Both are made slice by slice of rows, and again in the backward pass,
as cut cross-entropy does for one classifier (Wijmans et al., ICLR 2025); here every pair of a
batch has its own.
"""

import torch
from torch import Tensor

_DENSE = 2**23  # entries of a matrix that is made whole
_SLICE = 2**21  # entries of a larger one that exist at once


def small(f_x: Tensor, f_y: Tensor) -> bool:
    """Whether the whole matrix of dot products may be made."""
    return f_x.shape[0] * f_x.shape[1] * f_y.shape[1] <= _DENSE


def softmax_rows(
    f_x: Tensor, f_y: Tensor, values: Tensor, last: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Log-sum-exp of the rows of S = F_X F_Y^T, and the mean of values under their softmax.

    Memory grows with N and M, not with their product, in the backward pass as well. Where the
    whole matrix is small, it is made: that is a little faster (`make bench` says how much).

    Args:
        f_x: (B, N, d).
        f_y: (B, M, d).
        values: (B, M, V); no gradient goes to them.
        last: (B, N) one more entry of every row, of value zero; None for none.

    Returns:
        (B, N) log-sum-exp and (B, N, V) means.
    """
    if not small(f_x, f_y):
        return _SoftmaxRows.apply(f_x, f_y, values, last)  # type: ignore[no-any-return]
    scores = f_x @ f_y.mT
    if last is not None:
        scores = torch.cat([scores, last.unsqueeze(-1)], -1)
    total = scores.logsumexp(2)
    if not values.shape[2]:
        return total, values.new_empty(*total.shape, 0)
    return total, scores.softmax(2)[..., : f_y.shape[1]] @ values


@torch.no_grad()
def argmax_rows(f_x: Tensor, f_y: Tensor, last: Tensor | None = None) -> Tensor:
    """(B, N) column of the largest entry of every row of F_X F_Y^T; M where `last` is larger."""
    found = []
    for rows in _slices(f_x, f_y):
        most, index = (f_x[:, rows] @ f_y.mT).max(2)
        if last is not None:
            index = torch.where(last[:, rows] > most, f_y.shape[1], index)
        found.append(index)
    return torch.cat(found, 1)


def _slices(f_x: Tensor, f_y: Tensor) -> list[slice]:
    size = max(1, _SLICE // max(1, f_x.shape[0] * f_y.shape[1]))
    return [slice(start, start + size) for start in range(0, f_x.shape[1], size)]


class _SoftmaxRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx, f_x: Tensor, f_y: Tensor, values: Tensor, last: Tensor | None):  # noqa: ANN001, ANN205
        total, mean = (
            f_x.new_empty(f_x.shape[:2]),
            values.new_empty(*f_x.shape[:2], values.shape[2]),
        )
        for rows in _slices(f_x, f_y):
            scores = f_x[:, rows] @ f_y.mT
            most = scores.amax(2)
            if last is not None:
                most = torch.maximum(most, last[:, rows])
            share = scores.sub_(most.unsqueeze(2)).exp_()
            mass = share.sum(2)
            if last is not None:
                mass = mass + (last[:, rows] - most).exp()
            total[:, rows] = most + mass.log()
            mean[:, rows] = share @ values / mass.unsqueeze(2)
        ctx.save_for_backward(f_x, f_y, values, last, total, mean)
        return total, mean

    @staticmethod
    def backward(ctx, grad_total: Tensor, grad_mean: Tensor):  # type: ignore[override]  # noqa: ANN001, ANN205
        f_x, f_y, values, last, total, mean = ctx.saved_tensors
        # d S_ij = p_ij (g_i + h_i . v_j) with g the gradient of the total less h_i . mean_i
        base = grad_total - (grad_mean * mean).sum(2)
        grad_x, grad_y = torch.empty_like(f_x), torch.zeros_like(f_y)
        for rows in _slices(f_x, f_y):
            share = (f_x[:, rows] @ f_y.mT).sub_(total[:, rows].unsqueeze(2)).exp_()
            pull = torch.baddbmm(base[:, rows].unsqueeze(2), grad_mean[:, rows], values.mT)
            share.mul_(pull)
            grad_x[:, rows] = share @ f_y
            grad_y.baddbmm_(share.mT, f_x[:, rows])
        grad_last = None if last is None else (last - total).exp() * base
        return grad_x, grad_y, None, grad_last
