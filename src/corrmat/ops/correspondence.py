"""The soft correspondence matrix: every source point an example, every target point a class."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor


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


def _at_least_float32(feature: Tensor) -> Tensor:
    return feature if feature.dtype == torch.float64 else feature.float()
