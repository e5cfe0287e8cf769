"""The soft correspondence matrix: every source point an example, every target point a class."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.sinkhorn import Slack, sinkhorn


class SoftCorrespondence:
    """C = softmax(scale * F_X F_Y^T), one row per source point (paper section 4).

    The features stand for the matrix: callers ask for what they need of it, and only
    `logits` and `prob` promise an N x M tensor. With an outlier class (supplement A) it is
    N x (M + 1), that class last: index M.

    Args:
        feature_source: F_X, (B, N, d).
        feature_target: F_Y, (B, M, d).
        scale: factor of the dot products, e.g. 1 / sqrt(d).
        outlier: (B, N) logits of the outlier class; None for a matrix without one.
    """

    def __init__(
        self,
        feature_source: Tensor,
        feature_target: Tensor,
        scale: float = 1.0,
        outlier: Tensor | None = None,
    ) -> None:
        # Always float32 or wider: bfloat16 logits cannot tell near matches apart.
        self.feature_source = _at_least_float32(feature_source)
        self.feature_target = _at_least_float32(feature_target)
        self.scale = scale
        self.outlier = None if outlier is None else _at_least_float32(outlier)

    @property
    def num_target(self) -> int:
        """M."""
        return self.feature_target.shape[1]

    @functools.cached_property
    def _logits(self) -> Tensor:
        with torch.autocast(self.feature_source.device.type, enabled=False):
            scores = (self.feature_source * self.scale) @ self.feature_target.mT
        return scores if self.outlier is None else _with_last(scores, self.outlier)

    @functools.cached_property
    def _prob(self) -> Tensor:
        return self._logits.softmax(-1)

    def logits(self) -> Tensor:
        """(B, N, M or M + 1) scores before the softmax; dense."""
        return self._logits

    def prob(self) -> Tensor:
        """(B, N, M or M + 1) probabilities; every row sums to one. Dense."""
        return self._prob

    def argmax(self) -> Tensor:
        """(B, N) int64: the most probable class of each source point, M for the outlier's."""
        return self._logits.argmax(-1)

    def weight(self) -> Tensor:
        """(B, N) in [0, 1]: how much of a row lies on target points; 1 - p_outlier."""
        if self._prob.shape[-1] == self.num_target:
            return self._prob.new_ones(self._prob.shape[:2])
        return 1 - self._prob[..., -1]

    def soft_target(self, y: Tensor) -> Tensor:
        """(B, N, 3): the expected match of each source point, for y (B, M, 3).

        Y_hat = C Y; with an outlier class, given that the point is none.
        """
        with torch.autocast(y.device.type, enabled=False):
            expected = self._prob[..., : self.num_target] @ y.to(self._prob.dtype)
            if self._prob.shape[-1] == self.num_target:
                return expected
            return expected / self.weight().unsqueeze(-1).clamp_min(1e-20)

    def nll(self, index: Tensor) -> Tensor:
        """Cross-entropy of each row against its true match (paper section 4, L_CE).

        Args:
            index: (B, N) int64, the true target index; anything that is no class of this
                matrix (-1 for no match, M for an outlier if it has no such class) is left out.

        Returns:
            (B, N) negative log-likelihoods; 0 for rows left out.
        """
        known = torch.where(self.is_class(index), index, -1)
        rows = self._logits.flatten(0, 1)
        loss = F.cross_entropy(rows, known.flatten(), ignore_index=-1, reduction="none")
        return loss.view_as(index)

    def is_class(self, index: Tensor) -> Tensor:
        """Which of these indices, of any shape, name a class of this matrix."""
        return (index >= 0) & (index < self.num_target + (self.outlier is not None))


class _LogCorrespondence(SoftCorrespondence):
    """A matrix whose logits are its logarithm already; rows sum to at most one."""

    @functools.cached_property
    def _prob(self) -> Tensor:
        return self._logits.exp()

    def nll(self, index: Tensor) -> Tensor:
        """-log C at the true match, from the log domain; see `SoftCorrespondence.nll`."""
        known = self.is_class(index)
        chosen = torch.where(known, index, 0).unsqueeze(-1)
        return torch.where(known, -self._logits.gather(2, chosen).squeeze(-1), 0)

    def weight(self) -> Tensor:
        """(B, N) in [0, 1]: how much of a row lies on target points."""
        return self._prob[..., : self.num_target].sum(-1)

    def soft_target(self, y: Tensor) -> Tensor:
        """(B, N, 3): the expected match of each source point given that it has one."""
        with torch.autocast(y.device.type, enabled=False):
            expected = self._prob[..., : self.num_target] @ y.to(self._prob.dtype)
            return expected / self.weight().unsqueeze(-1).clamp_min(1e-20)


class SinkhornCorrespondence(_LogCorrespondence):
    """RPMNet's matrix: affinities -beta (||f_x - f_y||^2 - alpha), normalised by Sinkhorn.

    Rows sum to at most one, and what they lack is doubt: `weight`. `logits` is the logarithm
    of the normalised matrix.

    Args:
        feature_source: F_X, (B, N, d), unit vectors.
        feature_target: F_Y, (B, M, d), unit vectors.
        beta: (B,) inverse temperature.
        alpha: (B,) squared distance from where on a match is worth less than slack.
        iterations: of `sinkhorn`.
        slack: of `sinkhorn`.
    """

    def __init__(
        self,
        feature_source: Tensor,
        feature_target: Tensor,
        beta: Tensor,
        alpha: Tensor,
        iterations: int,
        slack: Slack,
    ) -> None:
        super().__init__(feature_source, feature_target)
        self.beta, self.alpha = _at_least_float32(beta), _at_least_float32(alpha)
        self.iterations = iterations
        self.slack: Slack = slack

    @functools.cached_property
    def _logits(self) -> Tensor:
        f_x, f_y = self.feature_source, self.feature_target
        beta, alpha = self.beta[:, None, None], self.alpha[:, None, None]
        with torch.autocast(f_x.device.type, enabled=False):
            squares = f_x.square().sum(-1).unsqueeze(2) + f_y.square().sum(-1).unsqueeze(1)
            affinity = beta * (alpha - squares + 2 * (f_x @ f_y.mT))
            return sinkhorn(affinity, self.iterations, self.slack)


class MatchabilityCorrespondence(_LogCorrespondence):
    """LightGlue's matrix: softmax over rows and columns, times both points' matchability.

    C_ij = m_i m_j softmax_j(S)_ij softmax_i(S)_ij; the outlier's class gets 1 - m_i. Rows sum
    to at most one.

    Args:
        feature_source: F_X, (B, N, d).
        feature_target: F_Y, (B, M, d).
        scale: factor of the dot products.
        matchable_source: (B, N) logits of m_i.
        matchable_target: (B, M) logits of m_j.
    """

    def __init__(
        self,
        feature_source: Tensor,
        feature_target: Tensor,
        scale: float,
        matchable_source: Tensor,
        matchable_target: Tensor,
    ) -> None:
        super().__init__(feature_source, feature_target, scale, -matchable_source)
        self.matchable_target = _at_least_float32(matchable_target)

    @functools.cached_property
    def _logits(self) -> Tensor:
        assert self.outlier is not None
        with torch.autocast(self.feature_source.device.type, enabled=False):
            scores = (self.feature_source * self.scale) @ self.feature_target.mT
            both = scores.log_softmax(2) + scores.log_softmax(1)
            matchable = F.logsigmoid(-self.outlier).unsqueeze(2)
            matchable = matchable + F.logsigmoid(self.matchable_target).unsqueeze(1)
            return _with_last(both + matchable, F.logsigmoid(self.outlier))


def outlier_feature(feature_target: Tensor, b: float = -1.0) -> Tensor:
    """f_O = argmin_f ||F_Y f - b 1||: a feature whose scores at all targets are b (supplement A).

    Where features outnumber target points, the smallest such f.

    Args:
        feature_target: F_Y, (B, M, d).
        b: the score; the paper chose -1.

    Returns:
        (B, d), float32 or wider.
    """
    f = feature_target.double()
    gram = f.mT @ f
    # Of no effect but to pick the smallest of many solutions, and zero for features of zero.
    ridge = 1e-9 * gram.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] + 1e-12
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    found = torch.linalg.solve(gram + ridge * eye, f.sum(1))
    return (b * found).to(_at_least_float32(feature_target).dtype)


def _at_least_float32(feature: Tensor) -> Tensor:
    return feature if feature.dtype == torch.float64 else feature.float()


def _with_last(scores: Tensor, last: Tensor) -> Tensor:
    return torch.cat([scores, last.unsqueeze(-1)], -1)
