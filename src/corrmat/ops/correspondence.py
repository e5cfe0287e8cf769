"""The soft correspondence matrix: every source point an example, every target point a class."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.neighbors import at_least_float32, gather_points
from corrmat.ops.sinkhorn import Slack, sinkhorn_potentials
from corrmat.ops.streaming import argmax_rows, log_sums, softmax_rows

T = TypeVar("T")


def _cached_with_gradient(compute: Callable[[Any], T]) -> functools.cached_property[T]:
    """Cache a property with its gradient, even if it is first read under `torch.no_grad`."""

    @functools.wraps(compute)
    def computed(self: "SoftCorrespondence") -> T:
        with torch.enable_grad():
            return compute(self)

    return functools.cached_property(computed)


class SoftCorrespondence:
    """C = softmax(scale * F_X F_Y^T), one row per source point (paper section 4).

    Row i is a classifier of source point i: its classes are the M target points and, with
    `outlier` logits, one more class at index M for points without a match (supplement A).

    To stay small, the object holds the features and not the matrix. Every logit is the dot
    product of two vectors, so `nll`, `soft_target`, `argmax` and `weight` stream over rows with
    memory linear in N and M (`ops.streaming`). Only `logits` and `prob` return N x M tensors.

    Args:
        feature_source: F_X, (B, N, d).
        feature_target: F_Y, (B, M, d).
        scale: factor of the dot products, e.g. 1 / sqrt(d).
        outlier: (B, N) logits of the outlier class; None for a matrix without one.

    Raises:
        ValueError: the shapes do not fit each other.
    """

    def __init__(
        self,
        feature_source: Tensor,
        feature_target: Tensor,
        scale: float = 1.0,
        outlier: Tensor | None = None,
    ) -> None:
        shapes = [tuple(feature_source.shape), tuple(feature_target.shape)]
        fit = all(len(s) == 3 for s in shapes) and shapes[0][::2] == shapes[1][::2]
        if not fit or (outlier is not None and tuple(outlier.shape) != shapes[0][:2]):
            shapes += [] if outlier is None else [tuple(outlier.shape)]
            raise ValueError(
                "features must be (B, N, d) and (B, M, d), outlier logits (B, N), not "
                + ", ".join(map(str, shapes))
            )
        # Always float32 or wider: bfloat16 logits cannot tell near matches apart.
        self.feature_source = at_least_float32(feature_source)
        self.feature_target = at_least_float32(feature_target)
        self.scale = scale
        self.outlier = None if outlier is None else at_least_float32(outlier)

    @property
    def num_target(self) -> int:
        """M."""
        return self.feature_target.shape[1]

    @_cached_with_gradient
    def _vectors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """Vectors (B, N, D) and (B, M, D) whose dot products are logits, and outlier logits."""
        return self.scale * self.feature_source, self.feature_target, self.outlier

    def _rows(self, y: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Compute log-sum-exp and mean of y of the rows, over target points alone; cached.

        The outlier class stays apart: beside one of probability 1 the rest would round to zero.
        """
        cached = self.__dict__.get("_cached_rows")
        if cached is None or (y is not None and cached[0] is not y):
            a, b, _ = self._vectors
            values = b[..., :0] if y is None else y.to(b.dtype)
            with torch.enable_grad(), torch.autocast(a.device.type, enabled=False):
                cached = y, *softmax_rows(a, b, values.detach())
            self._cached_rows = cached
        return cached[1:]

    @_cached_with_gradient
    def _logits(self) -> Tensor:
        a, b, last = self._vectors
        with torch.autocast(a.device.type, enabled=False):
            scores = a @ b.mT
        return scores if last is None else torch.cat([scores, last.unsqueeze(-1)], -1)

    @_cached_with_gradient
    def _prob(self) -> Tensor:
        return self._logits.softmax(-1)

    def logits(self) -> Tensor:
        """Return the scores before the softmax, (B, N, M or M + 1), as a dense tensor."""
        return self._logits

    def prob(self) -> Tensor:
        """Return the probabilities (B, N, M or M + 1) as a dense tensor; rows sum to one."""
        return self._prob

    def argmax(self) -> Tensor:
        """Return the most probable class of each source point, (B, N) int64; M means outlier."""
        with torch.autocast(self.feature_source.device.type, enabled=False):
            return argmax_rows(*self._vectors)

    def weight(self) -> Tensor:
        """Return the probability of not being an outlier, (B, N) in [0, 1]: 1 - p_outlier."""
        total, _ = self._rows()
        return torch.ones_like(total) if self.outlier is None else (total - self.outlier).sigmoid()

    def soft_target(self, y: Tensor) -> Tensor:
        """Return the expected match of each source point, (B, N, 3), for y (B, M, 3).

        Y_hat = C Y; with an outlier class, conditional on the point being an inlier. Gradients
        reach the features, not y. The result for one y is kept: do not change y in place.
        """
        return self._rows(y)[1]

    def nll(self, index: Tensor) -> Tensor:
        """Return the cross-entropy of each row against its true match (paper section 4, L_CE).

        Args:
            index: (B, N) int64, the true target index. Rows whose index is not a class of this
                matrix are ignored: -1 for no match, M if there is no outlier class.

        Returns:
            (B, N) negative log-likelihoods; 0 for ignored rows.

        Raises:
            ValueError: an index of another shape, or of no integers, or, on a CPU, outside -1 to M.
        """
        self._check(index)
        total, _ = self._rows()
        if self.outlier is not None:
            total = torch.logaddexp(total, self.outlier)
        return torch.where(self.is_class(index), total - self._logit_at(index), 0)

    def _check(self, index: Tensor) -> None:
        """Check the true matches; their values on a CPU only, where that waits for nothing."""
        if index.shape != self.feature_source.shape[:2]:
            raise ValueError(
                f"true matches of shape {tuple(index.shape)} for features of shape "
                f"{tuple(self.feature_source.shape)}"
            )
        if index.is_floating_point() or index.dtype == torch.bool:
            raise ValueError(f"true matches are integers, not {index.dtype}")
        if index.device.type != "cpu" or not index.numel():
            return
        low, high = index.numpy().min(), index.numpy().max()
        if low < -1 or high > self.num_target:
            raise ValueError(
                f"true matches from {low} to {high} are not rows of {self.num_target} target "
                f"points, nor {self.num_target} for an outlier or -1 for no match"
            )

    def _logit_at(self, index: Tensor) -> Tensor:
        """Return one logit of each row (B, N); arbitrary where the index is not a class."""
        a, b, last = self._vectors
        logit = (a * gather_points(b, index.clamp(0, self.num_target - 1))).sum(-1)
        return logit if last is None else torch.where(index == self.num_target, last, logit)

    def is_class(self, index: Tensor) -> Tensor:
        """Tell which of these indices (any shape) are classes of this matrix."""
        return (index >= 0) & (index < self.num_target + (self.outlier is not None))


class _LogCorrespondence(SoftCorrespondence):
    """A matrix whose logits are already its logarithm; rows sum to at most one."""

    @_cached_with_gradient
    def _prob(self) -> Tensor:
        return self._logits.exp()

    def nll(self, index: Tensor) -> Tensor:
        """Return -log C at the true match; see `SoftCorrespondence.nll`."""
        self._check(index)
        return torch.where(self.is_class(index), -self._logit_at(index), 0)

    def weight(self) -> Tensor:
        """Return the sum of each row over target points, (B, N) in [0, 1]."""
        return self._rows()[0].exp()


class SinkhornCorrespondence(_LogCorrespondence):
    """RPMNet's matrix: affinities -beta (||f_x - f_y||^2 - alpha), normalised by Sinkhorn.

    Rows sum to at most one; the rest is the probability of having no match (see `weight`).
    `logits` is the logarithm of the normalised matrix.

    Args:
        feature_source: F_X, (B, N, d), unit vectors.
        feature_target: F_Y, (B, M, d), unit vectors.
        beta: (B,) inverse temperature.
        alpha: (B,) squared distance beyond which a match scores below slack.
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
        self.beta, self.alpha = at_least_float32(beta), at_least_float32(alpha)
        self.iterations = iterations
        self.slack: Slack = slack

    @_cached_with_gradient
    def _vectors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """Write the normalised log matrix as dot products of longer vectors."""
        f_x, f_y = self.feature_source, self.feature_target
        beta, alpha = self.beta[:, None, None], self.alpha[:, None, None]
        # beta (alpha - |f_x|^2 - |f_y|^2 + 2 f_x . f_y) as one dot product.
        offset = beta * (alpha - f_x.square().sum(-1, keepdim=True))
        a = torch.cat([2 * beta * f_x, offset, -beta.expand_as(offset)], -1)
        b = torch.cat([F.pad(f_y, (0, 1), value=1.0), f_y.square().sum(-1, keepdim=True)], -1)
        with torch.autocast(f_x.device.type, enabled=False):
            u, v = sinkhorn_potentials(a, b, self.iterations, self.slack)
        return *_subtract_potentials(a, b, u, v), None


class MatchabilityCorrespondence(_LogCorrespondence):
    """LightGlue's matrix: softmax over rows and columns, times both points' matchability.

    C_ij = m_i m_j softmax_j(S)_ij softmax_i(S)_ij, and the outlier class has probability 1 - m_i.
    Rows sum to at most one.

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
        self.matchable_target = at_least_float32(matchable_target)

    @_cached_with_gradient
    def _vectors(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """Add the softmax over columns and the matchabilities, as dot products too."""
        a, b, out = super()._vectors
        assert out is not None
        with torch.autocast(a.device.type, enabled=False):
            rows, columns = log_sums(a, b)
        u, v = rows - F.logsigmoid(-out), columns - F.logsigmoid(self.matchable_target)
        return *_subtract_potentials(2 * a, b, u, v), F.logsigmoid(out)

    def transposed(self) -> "MatchabilityCorrespondence":
        """Return the same matrix with target points as rows and their own outlier class last."""
        assert self.outlier is not None
        transposed = MatchabilityCorrespondence(
            self.feature_target,
            self.feature_source,
            self.scale,
            self.matchable_target,
            -self.outlier,
        )
        a, b, _ = self._vectors
        transposed._vectors = b, a, F.logsigmoid(-self.matchable_target)
        return transposed


def _subtract_potentials(a: Tensor, b: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Extend a and b so that their dot products become a_i . b_j - u_i - v_j."""
    a = torch.cat([F.pad(a, (0, 1), value=-1.0), -u.unsqueeze(-1)], -1)
    return a, F.pad(torch.cat([b, v.unsqueeze(-1)], -1), (0, 1), value=1.0)


def outlier_feature(feature_target: Tensor, b: float = -1.0) -> Tensor:
    """Solve f_O = argmin_f ||F_Y f - b 1||, a feature that scores b at every target (supplement A).

    If there are more features than target points, the solution of smallest norm is returned.

    Args:
        feature_target: F_Y, (B, M, d).
        b: the score; the paper chooses -1.

    Returns:
        (B, d), float32 or wider.
    """
    f = feature_target.double()
    gram = f.mT @ f
    # The ridge selects the solution of smallest norm, and zero for features of zero.
    ridge = 1e-9 * gram.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] + 1e-12
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    # Without a check for errors, for which a GPU would have to wait: the ridge keeps it solvable.
    solution = torch.linalg.solve_ex(gram + ridge * eye, f.sum(1).unsqueeze(2)).result.squeeze(2)
    return (b * solution).to(at_least_float32(feature_target).dtype)
