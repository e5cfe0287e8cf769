"""Sinkhorn's row and column normalisation in the log domain, with slack (RPM-Net, section 4).

After any number of iterations the matrix is exp(A_ij - u_i - v_j), so the code carries only the
potentials u (B, N) and v (B, M). A is a matrix of dot products and is streamed where it is large.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.streaming import fits_in_memory, softmax_rows

Slack = Literal["row", "both", "none"]
_MIN_EXPONENT = -80.0  # below it exp adds nothing to a sum of at least one, and is ten times slower


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
    u, v = a[..., 0] * 0, b[..., 0] * 0
    scores = a @ b.mT if fits_in_memory(a, b) else None  # once for all iterations
    transposed = None if scores is None else scores.mT
    for _ in range(iterations):
        if slack == "row":
            v = _log_sum_exp(b, a, u, transposed, slack=True)
            u = _log_sum_exp(a, b, v, scores, slack=False)
        else:
            u = _log_sum_exp(a, b, v, scores, slack=slack == "both")
            v = _log_sum_exp(b, a, u, transposed, slack=slack == "both")
    return u, v


def _log_sum_exp(a: Tensor, b: Tensor, v: Tensor, scores: Tensor | None, slack: bool) -> Tensor:
    """Compute log(sum_j exp(a_i . b_j - v_j) [+ 1 for slack]), (B, N)."""
    if scores is not None:
        total = _LogSumExp.apply(scores, v)
        return torch.logaddexp(total, torch.zeros_like(total)) if slack else total
    extended = torch.cat([b, v.unsqueeze(-1)], -1)
    last = a[..., 0] * 0 if slack else None
    total, _ = softmax_rows(F.pad(a, (0, 1), value=-1.0), extended, b[..., :0], last)
    return total


class _LogSumExp(torch.autograd.Function):
    """Log(sum_j exp(s_ij - v_j)) of given scores; saves no further matrix for backward."""

    @staticmethod
    def forward(ctx, scores: Tensor, v: Tensor):  # noqa: ANN001, ANN205
        """Compute the log-sum-exp of every row."""
        shifted = scores - v.unsqueeze(1)
        row_max = shifted.amax(2)
        prob = shifted.sub_(row_max.unsqueeze(2)).clamp_min_(_MIN_EXPONENT).exp_()
        total = prob.sum(2).log_().add_(row_max)
        ctx.save_for_backward(scores, v, total)
        return total

    @staticmethod
    def backward(ctx, grad_total: Tensor):  # type: ignore[override]  # noqa: ANN001, ANN205
        """Compute the gradients of scores and v from the softmax."""
        scores, v, total = ctx.saved_tensors
        prob = (scores - v.unsqueeze(1)).sub_(total.unsqueeze(2)).clamp_min_(_MIN_EXPONENT).exp_()
        prob.mul_(grad_total.unsqueeze(2))
        return prob, -prob.sum(1)
