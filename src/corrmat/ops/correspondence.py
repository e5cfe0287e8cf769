"""The soft correspondence matrix: every source point an example, every target point a class."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.neighbors import take
from corrmat.ops.sinkhorn import Slack, sinkhorn_potentials
from corrmat.ops.streaming import argmax_rows, softmax_rows


class SoftCorrespondence:
    """C = softmax(scale * F_X F_Y^T), one row per source point (paper section 4).

    Vectors stand for the matrix, a logit is the dot product of two of them, and only `logits`
    and `prob` promise an N x M tensor: all else takes memory linear in N and M. With an outlier
    class (supplement A) it is N x (M + 1), that class last: index M.

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
    def _vectors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """What logits are dot products of, (B, N, D) and (B, M, D), and the last column's."""
        return self.scale * self.feature_source, self.feature_target, self.outlier

    def _rows(self, y: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Log-sum-exp of the rows, and the means of y under their softmax; made once."""
        known = self.__dict__.get("_made")
        if known is None or (y is not None and known[0] is not y):
            a, b, last = self._vectors
            values = b[..., :0] if y is None else y.to(b.dtype)
            with torch.autocast(a.device.type, enabled=False):
                known = y, *softmax_rows(a, b, values.detach(), last)
            self._made = known
        return known[1:]

    @functools.cached_property
    def _logits(self) -> Tensor:
        a, b, last = self._vectors
        with torch.autocast(a.device.type, enabled=False):
            scores = a @ b.mT
        return scores if last is None else torch.cat([scores, last.unsqueeze(-1)], -1)

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
        with torch.autocast(self.feature_source.device.type, enabled=False):
            return argmax_rows(*self._vectors)

    def weight(self) -> Tensor:
        """(B, N) in [0, 1]: how much of a row lies on target points; 1 - p_outlier."""
        total, _ = self._rows()
        if self.outlier is None:
            return torch.ones_like(total)
        return 1 - (self.outlier - total).exp()

    def soft_target(self, y: Tensor) -> Tensor:
        """(B, N, 3): the expected match of each source point, for y (B, M, 3).

        Y_hat = C Y; with an outlier class, given that the point is none.
        """
        total, mean = self._rows(y)
        last = self._vectors[2]
        if last is None:
            return mean
        return mean / (1 - (last - total).exp()).unsqueeze(-1).clamp_min(1e-20)

    def nll(self, index: Tensor) -> Tensor:
        """Cross-entropy of each row against its true match (paper section 4, L_CE).

        Args:
            index: (B, N) int64, the true target index; anything that is no class of this
                matrix (-1 for no match, M for an outlier if it has no such class) is left out.

        Returns:
            (B, N) negative log-likelihoods; 0 for rows left out.
        """
        total, _ = self._rows()
        return torch.where(self.is_class(index), total - self._picked(index), 0)

    def _picked(self, index: Tensor) -> Tensor:
        """(B, N) logits at a class of each row; anything where the index is none."""
        a, b, last = self._vectors
        found = (a * take(b, index.clamp(0, self.num_target - 1))).sum(-1)
        return found if last is None else torch.where(index == self.num_target, last, found)

    def is_class(self, index: Tensor) -> Tensor:
        """Which of these indices, of any shape, name a class of this matrix."""
        return (index >= 0) & (index < self.num_target + (self.outlier is not None))


class _LogCorrespondence(SoftCorrespondence):
    """A matrix whose logits are its logarithm already; rows sum to at most one."""

    @functools.cached_property
    def _prob(self) -> Tensor:
        return self._logits.exp()

    def nll(self, index: Tensor) -> Tensor:
        """-log C at the true match; see `SoftCorrespondence.nll`."""
        return torch.where(self.is_class(index), -self._picked(index), 0)

    def weight(self) -> Tensor:
        """(B, N) in [0, 1]: how much of a row lies on target points."""
        total, last = self._rows()[0], self._vectors[2]
        return total.exp() - (0 if last is None else last.exp())


class SinkhornCorrespondence(_LogCorrespondence):
    """RPMNet's matrix: affinities -beta (||f_x - f_y||^2 - alpha), normalised by Sinkhorn.

    Rows sum to at most one, and what they lack is doubt: `weight`. `logits` is the logarithm
    of the normalised matrix.

    Args:
        feature_source: F_X, (B, N, d), unit vectors.
        feature_target: F_Y, (B, M, d), unit vectors.
        beta: (B,) inverse temperature.
        alpha: (B,) squared distance from where on a match is worth less than slack.
        iterations: of `sinkhorn_potentials`.
        slack: of `sinkhorn_potentials`.
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
    def _vectors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        f_x, f_y = self.feature_source, self.feature_target
        beta, alpha = self.beta[:, None, None], self.alpha[:, None, None]
        # beta (alpha - |f_x|^2 - |f_y|^2 + 2 f_x . f_y) as one dot product.
        own = beta * (alpha - f_x.square().sum(-1, keepdim=True))
        a = torch.cat([2 * beta * f_x, own, -beta.expand_as(own)], -1)
        b = torch.cat([F.pad(f_y, (0, 1), value=1.0), f_y.square().sum(-1, keepdim=True)], -1)
        with torch.autocast(f_x.device.type, enabled=False):
            u, v = sinkhorn_potentials(a, b, self.iterations, self.slack)
        return *_less(a, b, u, v), None


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
    def _vectors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        a, b, out = super()._vectors
        assert out is not None
        with torch.autocast(a.device.type, enabled=False):
            rows, _ = softmax_rows(a, b, b[..., :0])
            columns, _ = softmax_rows(b, a, a[..., :0])
        u, v = rows - F.logsigmoid(-out), columns - F.logsigmoid(self.matchable_target)
        return *_less(2 * a, b, u, v), F.logsigmoid(out)

    def transposed(self) -> "MatchabilityCorrespondence":
        """The same matrix with target points as rows, and their doubt as the last class."""
        assert self.outlier is not None
        other = MatchabilityCorrespondence(
            self.feature_target,
            self.feature_source,
            self.scale,
            self.matchable_target,
            -self.outlier,
        )
        a, b, _ = self._vectors
        other._vectors = b, a, F.logsigmoid(-self.matchable_target)
        return other


def _less(a: Tensor, b: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors of the dot products a_i . b_j - u_i - v_j."""
    a = torch.cat([F.pad(a, (0, 1), value=-1.0), -u.unsqueeze(-1)], -1)
    return a, F.pad(torch.cat([b, v.unsqueeze(-1)], -1), (0, 1), value=1.0)


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
