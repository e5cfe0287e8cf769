"""Row softmax of an N x M matrix of dot products, without holding the matrix in memory.

Losses and poses need two things of a correspondence matrix: the log-sum-exp of its rows and means
under their softmax. Both are computed over slices of rows, forward and again backward. Cut
cross-entropy does the same for one classifier (Wijmans et al., ICLR 2025); here every pair of a
batch has its own matrix.
"""

import torch
from torch import Tensor

_DENSE = 2**23  # entries up to which the whole matrix is computed at once
_SLICE = 2**21  # entries of one slice of a larger matrix
MIN_EXPONENT = -80.0  # below it exp adds nothing to a sum of at least one, and is ten times slower


def fits_in_memory(f_x: Tensor, f_y: Tensor) -> bool:
    """Tell whether the matrix of dot products is small enough to be computed whole."""
    return f_x.shape[0] * f_x.shape[1] * f_y.shape[1] <= _DENSE


def softmax_rows(
    f_x: Tensor, f_y: Tensor, values: Tensor, last: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Compute the log-sum-exp of the rows of S = F_X F_Y^T and means under their softmax.

    Memory grows with N and M, not with their product, in the backward pass as well. A small
    matrix is computed whole, which is a little faster (`make bench` says how much).

    Args:
        f_x: (B, N, d).
        f_y: (B, M, d).
        values: (B, M, V); no gradient goes to them.
        last: (B, N) one more entry of every row, of value zero; None for none.

    Returns:
        (B, N) log-sum-exp and (B, N, V) means.
    """
    if not fits_in_memory(f_x, f_y):
        return _SoftmaxRows.apply(f_x, f_y, values, last)  # type: ignore[no-any-return]
    scores = f_x @ f_y.mT
    if last is not None:
        scores = torch.cat([scores, last.unsqueeze(-1)], -1)
    total = scores.logsumexp(2)
    if not values.shape[2]:
        return total, values.new_empty(*total.shape, 0)
    return total, scores.softmax(2)[..., : f_y.shape[1]] @ values


def log_sums(f_x: Tensor, f_y: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the log-sum-exp of the rows (B, N) and of the columns (B, M) of S = F_X F_Y^T."""
    if not fits_in_memory(f_x, f_y):
        return (
            softmax_rows(f_x, f_y, f_y[..., :0])[0],
            softmax_rows(f_y, f_x, f_x[..., :0])[0],
        )
    scores = f_x @ f_y.mT
    return scores.logsumexp(2), scores.logsumexp(1)


@torch.no_grad()
def argmax_rows(f_x: Tensor, f_y: Tensor, last: Tensor | None = None) -> Tensor:
    """Find the column (B, N) of the largest entry of each row of F_X F_Y^T; M if `last` is."""
    column = f_x.new_empty(f_x.shape[:2], dtype=torch.int64)
    for part in _slices(f_x, f_y):
        row_max, index = (f_x[part] @ f_y[part[0]].mT).max(2)
        if last is not None:
            index = torch.where(last[part] > row_max, f_y.shape[1], index)
        column[part] = index
    return column


def _slices(f_x: Tensor, f_y: Tensor) -> list[tuple[slice, slice]]:
    """Split the matrices into parts of at most `_SLICE` entries: whole ones, or rows of one."""
    (batch, n, _), m = f_x.shape, f_y.shape[1]
    rows = max(1, _SLICE // max(1, m))
    samples = max(1, rows // max(1, n))
    return [
        (slice(b, b + samples), slice(i, i + rows))
        for b in range(0, batch, samples)
        for i in range(0, n, rows)
    ]


class _SoftmaxRows(torch.autograd.Function):
    """`softmax_rows` over slices; the backward pass computes each slice again."""

    @staticmethod
    def forward(ctx, f_x: Tensor, f_y: Tensor, values: Tensor, last: Tensor | None):  # noqa: ANN001, ANN205
        """Compute log-sum-exp and mean of every row, slice by slice."""
        total, mean = (
            f_x.new_empty(f_x.shape[:2]),
            values.new_empty(*f_x.shape[:2], values.shape[2]),
        )
        for part in _slices(f_x, f_y):
            scores = f_x[part] @ f_y[part[0]].mT
            row_max = scores.amax(2)
            if last is not None:
                row_max = torch.maximum(row_max, last[part])
            prob = scores.sub_(row_max.unsqueeze(2)).clamp_min_(MIN_EXPONENT).exp_()
            mass = prob.sum(2)
            if last is not None:
                mass = mass + (last[part] - row_max).exp()
            total[part] = row_max + mass.log()
            mean[part] = prob @ values[part[0]] / mass.unsqueeze(2)
        ctx.save_for_backward(f_x, f_y, values, last, total, mean)
        return total, mean

    @staticmethod
    def backward(ctx, grad_total: Tensor, grad_mean: Tensor):  # type: ignore[override]  # noqa: ANN001, ANN205
        """Compute the gradients of features and last class, slice by slice; values have none."""
        f_x, f_y, values, last, total, mean = ctx.saved_tensors
        # d S_ij = p_ij (g_i + h_i . v_j) with g_i = grad_total_i - h_i . mean_i
        base = grad_total - (grad_mean * mean).sum(2)
        grad_x, grad_y = torch.empty_like(f_x), torch.zeros_like(f_y)
        for part in _slices(f_x, f_y):
            samples = part[0]
            prob = (f_x[part] @ f_y[samples].mT).sub_(total[part].unsqueeze(2))
            prob.clamp_min_(MIN_EXPONENT).exp_()
            prob *= torch.baddbmm(base[part].unsqueeze(2), grad_mean[part], values[samples].mT)
            grad_x[part] = prob @ f_y[samples]
            grad_y[samples] += prob.mT @ f_x[part]
        grad_last = None if last is None else (last - total).exp() * base
        return grad_x, grad_y, None, grad_last
