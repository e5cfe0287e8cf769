"""Sinkhorn's row and column normalisation in the log domain, with slack (RPM-Net, section 4).

The matrix after any number of iterations is exp(A_ij - u_i - v_j), so only the potentials
u (B, N) and v (B, M) are carried along, and A is read but never rewritten.
"""

from typing import Literal

import torch
from torch import Tensor

Slack = Literal["row", "both", "none"]


def sinkhorn(affinity: Tensor, iterations: int, slack: Slack = "row") -> Tensor:
    """Normalise rows and columns of exp(affinity) in turn.

    Slack is one more row or column of ones that takes up what has no match. It is counted
    where sums cross it and not normalised itself.

    Args:
        affinity: A, (B, N, M), one row a source point.
        iterations: how often both are normalised.
        slack: "row": an extra source row for target points without a match, columns first
            (this paper: every source point has a match). "both": an extra row and column,
            rows first (RPM-Net). "none": neither, rows first.

    Returns:
        (B, N, M) logarithm of the normalised matrix, without the slack.
    """
    u, v = affinity.new_zeros(affinity.shape[:2]), affinity.new_zeros(affinity[:, 0].shape)
    for _ in range(iterations):
        if slack == "row":
            v = _log_sum_exp(affinity.mT, u, slack=True)
            u = _log_sum_exp(affinity, v, slack=False)
        else:
            u = _log_sum_exp(affinity, v, slack=slack == "both")
            v = _log_sum_exp(affinity.mT, u, slack=slack == "both")
    return affinity - u.unsqueeze(2) - v.unsqueeze(1)


def _log_sum_exp(affinity: Tensor, potential: Tensor, slack: bool) -> Tensor:
    return _LogSumExp.apply(affinity, potential, slack)  # type: ignore[no-any-return]


class _LogSumExp(torch.autograd.Function):
    """log sum_j exp(A_ij - v_j) [+ exp(0)]: keeps A, v and the result, and no matrix of its own."""

    @staticmethod
    def forward(ctx, affinity: Tensor, potential: Tensor, slack: bool) -> Tensor:  # noqa: ANN001
        result = (affinity - potential.unsqueeze(1)).logsumexp(2)
        if slack:
            result = torch.logaddexp(result, torch.zeros_like(result))
        ctx.save_for_backward(affinity, potential, result)
        return result

    @staticmethod
    def backward(ctx, grad: Tensor):  # type: ignore[override]  # noqa: ANN001, ANN205
        affinity, potential, result = ctx.saved_tensors
        share = (affinity - potential.unsqueeze(1)).sub_(result.unsqueeze(2)).exp_()
        share.mul_(grad.unsqueeze(2))
        return share, -share.sum(1), None
