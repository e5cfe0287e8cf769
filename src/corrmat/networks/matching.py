"""Matching heads: from features to a correspondence matrix, with or without an outlier class.

The paper solves a least-squares problem for the outlier's feature (supplement A) and says that
there are other ways. The two learned ones are SuperGlue's (Sarlin et al., CVPR 2020) and
LightGlue's (Lindenberger et al., ICCV 2023).
"""

from typing import Literal

import torch
from torch import Tensor, nn

from corrmat.ops.correspondence import (
    MatchabilityCorrespondence,
    SoftCorrespondence,
    outlier_feature,
)

Outlier = Literal["none", "least_squares", "dustbin", "matchability"]


class MatchingHead(nn.Module):
    """C = softmax(F_X F_Y^T / sqrt(d)): every source point has a match."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale = width**-0.5

    def forward(self, f_x: Tensor, f_y: Tensor) -> SoftCorrespondence:
        """Compare features (B, N, d) and (B, M, d): their correspondence matrix."""
        return SoftCorrespondence(f_x, f_y, self.scale)


class LeastSquares(MatchingHead):
    """The outlier's feature is the one that scores -1 at every target point (supplement A)."""

    def forward(self, f_x: Tensor, f_y: Tensor) -> SoftCorrespondence:
        """Compare features (B, N, d) and (B, M, d): their correspondence matrix."""
        with torch.autocast(f_x.device.type, enabled=False):
            f_o = outlier_feature(f_y)
            logit = self.scale * (f_x.to(f_o.dtype) @ f_o.unsqueeze(-1)).squeeze(-1)
        return SoftCorrespondence(f_x, f_y, self.scale, logit)


class Dustbin(MatchingHead):
    """The outlier's logit is one learned number for all points (SuperGlue)."""

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.logit = nn.Parameter(torch.ones(()))

    def forward(self, f_x: Tensor, f_y: Tensor) -> SoftCorrespondence:
        """Compare features (B, N, d) and (B, M, d): their correspondence matrix."""
        return SoftCorrespondence(f_x, f_y, self.scale, self.logit.expand(f_x.shape[:2]))


class Matchability(MatchingHead):
    """Each point's own feature predicts whether it has a match (LightGlue)."""

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.head = nn.Linear(width, 1)

    def forward(self, f_x: Tensor, f_y: Tensor) -> SoftCorrespondence:
        """Compare features (B, N, d) and (B, M, d): their correspondence matrix."""
        m_x, m_y = self.head(f_x).squeeze(-1), self.head(f_y).squeeze(-1)
        return MatchabilityCorrespondence(f_x, f_y, self.scale, m_x, m_y)


MATCHING_HEADS: dict[Outlier, type[MatchingHead]] = {
    "none": MatchingHead,
    "least_squares": LeastSquares,
    "dustbin": Dustbin,
    "matchability": Matchability,
}
