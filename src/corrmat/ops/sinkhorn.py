"""Sinkhorn's row and column normalisation in the log domain, with slack (RPM-Net, section 4).

After any number of iterations the matrix is exp(A_ij - u_i - v_j), so the code carries only the
potentials u (B, N) and v (B, M). A is a matrix of dot products and is streamed where it is large.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.streaming import MIN_EXPONENT, fits_in_memory, softmax_rows

Slack = Literal["row", "both", "none"]


def sinkhorn_potentials(
    a: Tensor, b: Tensor, iterations: int, slack: Slack = "row"
) -> tuple[Tensor, Tensor]:
    """Normalise rows and columns of exp(a b^T) in turn.

    Slack is one more row or column of ones that absorbs points without a match. It is part of
    the sums that cross it and is not normalised itself.

    Args:
        a: (B, N, D), one vector a source point.
        b: (B, M, D), one a target point.
        iterations: how often both are normalised.
        slack: "row": an extra source row for target points without a match, columns first
            (this paper: every source point has a match). "both": an extra row and column,
            rows first (RPM-Net). "none": neither, rows first.

    Returns:
        u (B, N) and v (B, M): the logarithm of the matrix is a_i . b_j - u_i - v_j.
    """
    if iterations and fits_in_memory(a, b):
        return _Potentials.apply(a @ b.mT, iterations, slack)  # type: ignore[no-any-return]
    u, v = a[..., 0] * 0, b[..., 0] * 0
    for normalise_rows, has_slack in _order(slack) * iterations:
        if normalise_rows:
            u = _streamed_log_sum_exp(a, b, v, has_slack)
        else:
            v = _streamed_log_sum_exp(b, a, u, has_slack)
    return u, v


def _order(slack: Slack) -> list[tuple[bool, bool]]:
    """Return the two halves of an iteration: whether it normalises rows, whether with slack."""
    if slack == "row":
        return [(False, True), (True, False)]
    return [(True, slack == "both"), (False, slack == "both")]


def _streamed_log_sum_exp(a: Tensor, b: Tensor, v: Tensor, slack: bool) -> Tensor:
    """Compute log(sum_j exp(a_i . b_j - v_j) [+ 1 for slack]), (B, N), slice by slice."""
    extended = torch.cat([b, v.unsqueeze(-1)], -1)
    last = a[..., 0] * 0 if slack else None
    total, _ = softmax_rows(F.pad(a, (0, 1), value=-1.0), extended, b[..., :0], last)
    return total


class _Potentials(torch.autograd.Function):
    """The potentials of a whole matrix of scores S (B, N, M).

    Forward: a log-sum-exp for each half of an iteration. Backward: every matrix on the way,
    exp(S - u_t - v_t), is the final one with its rows and columns scaled by exp(u - u_t) and
    exp(v - v_t). So the gradients of the potentials are matrix-vector products, and that of S is
    the final matrix times a matrix of low rank. The scales are small: columns that sum to one or
    less let u rise by log(M) at most in an iteration.
    """

    @staticmethod
    def forward(ctx, scores: Tensor, iterations: int, slack: Slack):  # noqa: ANN001, ANN205
        """Normalise; save the scores and the potentials after every half."""
        u, v = torch.zeros_like(scores[:, :, 0]), torch.zeros_like(scores[:, 0])
        ctx.halves, saved = _order(slack) * iterations, []
        for normalise_rows, has_slack in ctx.halves:
            if normalise_rows:
                u = _log_sum_exp(scores, v, has_slack)
            else:
                v = _log_sum_exp(scores.mT, u, has_slack)
            saved += [u, v]
        ctx.save_for_backward(scores, *saved)
        return u, v

    @staticmethod
    def backward(ctx, grad_u: Tensor, grad_v: Tensor):  # type: ignore[override]  # noqa: ANN001, ANN205
        """Go through the halves from the last to the first."""
        scores, *saved = ctx.saved_tensors
        last_u, last_v = saved[-2:]
        final = (scores - last_u.unsqueeze(2)).sub_(last_v.unsqueeze(1))
        final = final.clamp_min_(MIN_EXPONENT).exp_()
        rows, columns = [], []  # of the low-rank matrix
        halves = list(zip(ctx.halves, saved[::2], saved[1::2], strict=True))
        for (normalise_rows, _), u, v in reversed(halves):
            row, column = (last_u - u).exp(), (last_v - v).exp()
            if normalise_rows:
                row = row * grad_u
                grad_v = grad_v - column * (row.unsqueeze(1) @ final).squeeze(1)
                grad_u = torch.zeros_like(grad_u)
            else:
                column = column * grad_v
                grad_u = grad_u - row * (final @ column.unsqueeze(2)).squeeze(2)
                grad_v = torch.zeros_like(grad_v)
            rows.append(row)
            columns.append(column)
        low_rank = torch.stack(rows, 2) @ torch.stack(columns, 1)
        return low_rank.mul_(final), None, None


def _log_sum_exp(scores: Tensor, v: Tensor, slack: bool) -> Tensor:
    """Compute log(sum_j exp(s_ij - v_j) [+ 1 for slack]) of every row, (B, N)."""
    shifted = scores - v.unsqueeze(1)
    row_max = shifted.amax(2)
    prob = shifted.sub_(row_max.unsqueeze(2)).clamp_min_(MIN_EXPONENT).exp_()
    total = prob.sum(2).log_().add_(row_max)
    return torch.logaddexp(total, torch.zeros_like(total)) if slack else total
