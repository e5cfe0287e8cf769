"""The soft correspondence matrix: every source point an example, every target point a class."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.ops.sinkhorn import Slack, sinkhorn


class SoftCorrespondence:
    """C = softmax(scale * F_X F_Y^T), one row per source point (paper section 4).

    The features stand for the matrix: callers ask for what they need of it, and only
    `logits` and `prob` promise an N x M tensor.

    Args:
        feature_source: F_X, (B, N, d).
        feature_target: F_Y, (B, M, d).
        scale: factor of the dot products, e.g. 1 / sqrt(d).
    """

    def __init__(self, feature_source: Tensor, feature_target: Tensor, scale: float = 1.0) -> None:
        # Always float32 or wider: bfloat16 logits cannot tell near matches apart.
        self.feature_source = _at_least_float32(feature_source)
        self.feature_target = _at_least_float32(feature_target)
        self.scale = scale

    @functools.cached_property
    def _logits(self) -> Tensor:
        with torch.autocast(self.feature_source.device.type, enabled=False):
            return (self.feature_source * self.scale) @ self.feature_target.mT

    def logits(self) -> Tensor:
        """(B, N, M) scores before the softmax; dense."""
        return self._logits

    def prob(self) -> Tensor:
        """(B, N, M) probabilities; every row sums to one. Dense."""
        return self._logits.softmax(-1)

    def argmax(self) -> Tensor:
        """(B, N) int64: the most probable target point of each source point."""
        return self._logits.argmax(-1)

    def weight(self) -> Tensor:
        """(B, N) in [0, 1]: how much of a row lies on target points; one, for a softmax."""
        return self.feature_source.new_ones(self.feature_source.shape[:2])

    def soft_target(self, y: Tensor) -> Tensor:
        """(B, N, 3): Y_hat = C Y, the expected match of each source point, for y (B, M, 3)."""
        with torch.autocast(y.device.type, enabled=False):
            return self.prob() @ y.to(self._logits.dtype)

    def nll(self, index: Tensor) -> Tensor:
        """Cross-entropy of each row against its true match (paper section 4, L_CE).

        Args:
            index: (B, N) int64, the true target index; anything that is no class of this
                matrix (-1 for no match, M for an outlier) is left out.

        Returns:
            (B, N) negative log-likelihoods; 0 for rows left out.
        """
        index = torch.where(self.is_class(index), index, -1)
        return F.cross_entropy(self._logits.mT, index, ignore_index=-1, reduction="none")

    def is_class(self, index: Tensor) -> Tensor:
        """Which of these indices, of any shape, name a class of this matrix."""
        return (index >= 0) & (index < self.feature_target.shape[1])


class SinkhornCorrespondence(SoftCorrespondence):
    """RPMNet's matrix: affinities -beta (||f_x - f_y||^2 - alpha), normalised by Sinkhorn.

    Rows sum to at most one, and what they lack is doubt: `weight`.

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

    def logits(self) -> Tensor:
        """(B, N, M) logarithm of the normalised matrix; dense."""
        return self._logits

    def prob(self) -> Tensor:
        """(B, N, M) the normalised matrix; dense."""
        return self._logits.exp()

    def weight(self) -> Tensor:
        """(B, N) row sums."""
        return self.prob().sum(-1)

    def soft_target(self, y: Tensor) -> Tensor:
        """(B, N, 3): the expected match of each source point given that it has one."""
        prob = self.prob()
        with torch.autocast(y.device.type, enabled=False):
            return (prob @ y.to(prob.dtype)) / prob.sum(-1, keepdim=True).clamp_min(1e-20)

    def nll(self, index: Tensor) -> Tensor:
        """-log C at the true match, from the log domain; see `SoftCorrespondence.nll`."""
        known = self.is_class(index)
        found = self._logits.gather(2, torch.where(known, index, 0).unsqueeze(2)).squeeze(2)
        return torch.where(known, -found, 0)


def _at_least_float32(feature: Tensor) -> Tensor:
    return feature if feature.dtype == torch.float64 else feature.float()
