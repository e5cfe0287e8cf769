"""Sinkhorn's row and column normalisation in the log domain, with slack (RPM-Net, section 4).

The matrix after any number of iterations is exp(A_ij - u_i - v_j), so only the potentials
u (B, N) and v (B, M) are carried along. A is a matrix of dot products, so that it need not exist.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.streaming import small, softmax_rows

Slack = Literal["row", "both", "none"]
_LEAST = -80.0  # exp of less adds nothing to a sum of at least one, and takes ten times as long


def sinkhorn_potentials(
    a: Tensor, b: Tensor, iterations: int, slack: Slack = "row"
) -> tuple[Tensor, Tensor]:
    """Normalise rows and columns of exp(a b^T) in turn.

    Slack is one more row or column of ones that takes up what has no match. It is counted
    where sums cross it and not normalised itself.

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
    scores = a @ b.mT if small(a, b) else None  # once for all iterations, where it may exist
    back = None if scores is None else scores.mT
    for _ in range(iterations):
        if slack == "row":
            v = _log_sum_exp(b, a, u, back, slack=True)
            u = _log_sum_exp(a, b, v, scores, slack=False)
        else:
            u = _log_sum_exp(a, b, v, scores, slack=slack == "both")
            v = _log_sum_exp(b, a, u, back, slack=slack == "both")
    return u, v


def _log_sum_exp(a: Tensor, b: Tensor, v: Tensor, scores: Tensor | None, slack: bool) -> Tensor:
    """Log sum_j exp(a_i . b_j - v_j) [+ exp(0)], (B, N)."""
    if scores is not None:
        total = _LogSumExp.apply(scores, v)
        return torch.logaddexp(total, torch.zeros_like(total)) if slack else total
    lowered = torch.cat([b, v.unsqueeze(-1)], -1)
    last = a[..., 0] * 0 if slack else None
    total, _ = softmax_rows(F.pad(a, (0, 1), value=-1.0), lowered, b[..., :0], last)
    return total


class _LogSumExp(torch.autograd.Function):
    """Log sum_j exp(s_ij - v_j) of scores that exist; keeps no further matrix for backward."""

    @staticmethod
    def forward(ctx, scores: Tensor, v: Tensor):  # noqa: ANN001, ANN205
        lowered = scores - v.unsqueeze(1)
        most = lowered.amax(2)
        share = lowered.sub_(most.unsqueeze(2)).clamp_min_(_LEAST).exp_()
        total = share.sum(2).log_().add_(most)
        ctx.save_for_backward(scores, v, total)
        return total

    @staticmethod
    def backward(ctx, grad_total: Tensor):  # type: ignore[override]  # noqa: ANN001, ANN205
        scores, v, total = ctx.saved_tensors
        share = (scores - v.unsqueeze(1)).sub_(total.unsqueeze(2)).clamp_min_(_LEAST).exp_()
        share.mul_(grad_total.unsqueeze(2))
        return share, -share.sum(1)
