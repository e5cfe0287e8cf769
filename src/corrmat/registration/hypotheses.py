"""Candidate transforms between two clouds, from the network and from classical pipelines.

All generators have one signature, and `register` refines, scores and selects their hypotheses in
the same way. Lengths are in units in which a cloud's radius is about one.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torch import nn

from corrmat.baselines import (
    FPFH_FGR,
    FPFH_RANSAC,
    KISS,
    FpfhSettings,
    KissSettings,
    fpfh_fgr,
    fpfh_ransac,
    kiss_matcher,
)
from corrmat.errors import CorrmatError
from corrmat.networks.verification import VerificationNetwork
from corrmat.ops import rigid
from corrmat.ops.correspondence import MatchabilityCorrespondence, SoftCorrespondence
from corrmat.ops.ransac import best_by_matches, best_distinct, fit_triples
from corrmat.types import MATCH_DISTANCE, fewest_points
from corrmat.weights import load_verification

_STRONGEST = 256  # matches that RANSAC draws from
_INLIER_THRESHOLD = 0.15  # largest residual of a match
_BY_MATCHES, _BY_AGREEMENT = 16, 24  # hypotheses at most
_MANY, _BY_MANY = 2048, 200  # where a cloud is large: matches, and hypotheses by agreement
_ROUGH_POINTS = 64, 256  # of source and target, to rank them by
_ROUGH_DISTANCE = 0.3  # beyond which two points do not agree
_MAX_UNMATCHED_NLL = 8.0  # of a point: the network may be wrong
_SUPPORT_DISTANCE = 0.2  # residual beyond which a match does not support a transform
_NO_MATCHES = np.empty((0, 2), np.int64), np.empty(0)


class Hypotheses(NamedTuple):
    """Rigid transforms that may take the source onto the target, and the matches behind them."""

    transforms: np.ndarray  # (T, 4, 4) float64, T_target_source
    matches: np.ndarray  # (K, 2) int64 rows of source and target; K may be 0
    confidence: np.ndarray  # (K,) in [0, 1]
    prob: torch.Tensor | None = None  # (N, M), probabilities of all matches
    # (N,) and (M,): -log of the probability that a source point, or a target point, has no match.
    unmatched_nll: tuple[np.ndarray, np.ndarray] | None = None
    features: tuple[torch.Tensor, torch.Tensor] | None = None  # (N, d) and (M, d)
    verification: VerificationNetwork | None = None  # of the network's hypotheses

    def unmatched_loss(self, distances: tuple[np.ndarray, np.ndarray]) -> float:
        """Compute the cross-entropy of the points that a transform leaves without a match.

        A wrong transform leaves points without a match that the network would match. This is the
        part of the training loss that labels such points, with the transform in the truth's place.

        Args:
            distances: from each source point to the nearest target point under the transform, and
                the other way round. The first N and M are those of `unmatched_nll`.

        Returns:
            Mean over the points of each cloud, matched ones counting zero, and over the clouds;
            0 without `unmatched_nll`.
        """
        if self.unmatched_nll is None:
            return 0.0
        means = [
            np.where(distance[: len(nll)] > MATCH_DISTANCE, nll, 0).mean()
            for distance, nll in zip(distances, self.unmatched_nll, strict=True)
        ]
        return float(np.mean(means))

    def support(self, transform: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
        """Compute the share of the matches, by weight, that support a transform; 1 without any.

        Args:
            transform: (4, 4).
            source: (N, 3 or more), rows as in `matches`.
            target: (M, 3 or more).
        """
        if not len(self.matches):
            return 1.0
        weight = np.sqrt(self.confidence)
        return float(weight @ self.match_support(transform, source, target) / weight.sum())

    def match_support(
        self, transform: np.ndarray, source: np.ndarray, target: np.ndarray
    ) -> np.ndarray:
        """Compute how well a transform explains each match, (K,) in [0, 1]; see `support`."""
        x, y = source[self.matches[:, 0], :3], target[self.matches[:, 1], :3]
        residual = np.linalg.norm(rigid.move(transform, x) - y, axis=1)
        return np.clip(1 - (residual / _SUPPORT_DISTANCE) ** 2, 0, None)


HypothesisGenerator = Callable[[np.ndarray, np.ndarray, int], Hypotheses]
"""(source (N, 6), target (M, 6), seed) -> Hypotheses; rows are xyz and unit normal."""


class NetworkHypotheses:
    """Hypotheses from a network's correspondence matrix: RANSAC on its strongest matches.

    The transforms that RANSAC fits to triples of matches are ranked twice: by the matches that they
    explain, and by how well they put the clouds on each other, which right transforms do even
    where most matches are wrong. The network's own transform is one more hypothesis.

    Args:
        network: (source, target) -> Prediction with a correspondence.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network = network
        self.verification = load_verification(network)

    @torch.no_grad()
    def __call__(self, source: np.ndarray, target: np.ndarray, seed: int) -> Hypotheses:
        """Generate hypotheses for source (N, 6) and target (M, 6)."""
        x, y = (torch.from_numpy(np.asarray(c, np.float32)).unsqueeze(0) for c in (source, target))
        own_transform, correspondence = self._predict(x, y)
        if correspondence is None:
            return Hypotheses(own_transform, *_NO_MATCHES)
        prob = correspondence.prob()[0, :, : y.shape[1]].cpu()
        matches, confidence = strongest_matches(prob, _STRONGEST)
        weighted = *ends_of(matches, x[0], y[0]), confidence.sqrt(), _INLIER_THRESHOLD
        fits = fit_triples(*weighted, generator=torch.Generator().manual_seed(seed))
        by_matches = rigid.to_homogeneous(*best_by_matches(*fits, *weighted, _BY_MATCHES))
        by_agreement = best_by_agreement(*fits, x[0], y[0], _BY_AGREEMENT)
        transforms = np.concatenate([by_matches, by_agreement, own_transform])
        features = correspondence.feature_source[0].cpu(), correspondence.feature_target[0].cpu()
        unmatched = unmatched_nll(correspondence)
        return Hypotheses(
            transforms,
            matches.numpy(),
            confidence.double().numpy(),
            prob,
            unmatched,
            features,
            self.verification,
        )

    def _predict(
        self, x: torch.Tensor, y: torch.Tensor
    ) -> tuple[np.ndarray, SoftCorrespondence | None]:
        """Run the network, wherever it lies, and leave it in the mode that it was in.

        Args:
            x: (1, N, 6).
            y: (1, M, 6).

        Returns:
            Its own transform (1, 4, 4), and the correspondence matrix; None without any.
        """
        of_method = getattr(self.network, "network", self.network)
        least = fewest_points(of_method)
        if min(x.shape[1], y.shape[1]) < least:
            raise CorrmatError(f"this network needs clouds of at least {least} points")
        parameter = next(self.network.parameters(), x)  # where and in which precision it computes
        modes = [(module, module.training) for module in self.network.modules()]
        self.network.eval()
        try:
            prediction = self.network(x.to(parameter), y.to(parameter))
        finally:
            for module, mode in modes:
                module.training = mode
        transform = rigid.to_homogeneous(prediction.rotation.cpu(), prediction.translation.cpu())
        if not np.isfinite(transform).all():
            raise CorrmatError("the network's transform is not finite: has its training diverged?")
        return transform, prediction.correspondence


def strongest_matches(prob: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the strongest matches (K, 2), K <= count, and their probabilities (K,).

    Args:
        prob: (N, M). A match is an entry that is the maximum of its row or of its column.
        count: of matches at most.
    """
    is_max = (prob == prob.amax(0)) | (prob == prob.amax(1, keepdim=True))
    weight, place = (prob * is_max).flatten().topk(min(count, prob.numel()))
    weight, place = weight[weight > 0], place[weight > 0]
    return torch.stack([place // prob.shape[1], place % prob.shape[1]], 1), weight


def ends_of(
    matches: torch.Tensor, source: torch.Tensor, target: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the source points and the target points (K, 3) of matches (K, 2)."""
    return source[matches[:, 0], :3], target[matches[:, 1], :3]


def from_many_matches(
    prob: torch.Tensor, source: np.ndarray, target: np.ndarray, seed: int
) -> np.ndarray:
    """Fit transforms to many more matches: (T, 4, 4).

    Where two scans share little, hardly any of the strongest matches are right. Among more of them
    there are more right ones, and the clouds tell which transforms are.

    Args:
        prob: (N, M) of the model.
        source: (N, 6), xyz and unit normal.
        target: (M, 6).
        seed: of the random draws.
    """
    x, y = (torch.from_numpy(np.asarray(cloud, np.float32)) for cloud in (source, target))
    matches, weight = strongest_matches(prob, _MANY)
    fits = fit_triples(
        *ends_of(matches, x, y),
        weight.sqrt(),
        _INLIER_THRESHOLD,
        generator=torch.Generator().manual_seed(seed),
    )
    return best_by_agreement(*fits, x, y, _BY_MANY)


def best_by_agreement(
    rotation: torch.Tensor,
    translation: torch.Tensor,
    source: torch.Tensor,
    target: torch.Tensor,
    count: int,
) -> np.ndarray:
    """Select the distinct transforms that put two clouds best on each other, roughly: (T, 4, 4).

    Args: see `rough_agreement`; count is the number of transforms returned at most.
    """
    agreement = rough_agreement(rotation, translation, source, target)
    best = best_distinct(rotation, agreement, count)
    return rigid.to_homogeneous(rotation[best], translation[best])


def unmatched_nll(c: SoftCorrespondence) -> tuple[np.ndarray, np.ndarray] | None:
    """Compute -log P(no match) of source points (N,) and target points (M,).

    Returns None unless the matrix has matchabilities, which say it of both clouds.
    """
    if not isinstance(c, MatchabilityCorrespondence):
        return None
    assert c.outlier is not None
    source, target = (
        -F.logsigmoid(logits[0]).clamp(min=-_MAX_UNMATCHED_NLL).double().cpu()
        for logits in (c.outlier, -c.matchable_target)
    )
    return source.numpy(), target.numpy()


def rough_agreement(
    rotation: torch.Tensor, translation: torch.Tensor, source: torch.Tensor, target: torch.Tensor
) -> torch.Tensor:
    """Score how well many transforms put a few source points on the target.

    Args:
        rotation: (F, 3, 3).
        translation: (F, 3).
        source: (N, 6) xyz and unit normals of any sign, in random order.
        target: (M, 6), the same.

    Returns:
        (F,) in [0, 1]; see `scoring.Alignment`.
    """
    source, target = source[: _ROUGH_POINTS[0]], target[: _ROUGH_POINTS[1]]
    rotation, translation = rotation.to(source), translation.to(source)
    moved = source[:, :3] @ rotation.mT + translation.unsqueeze(1)
    normals = source[:, 3:6] @ rotation.mT
    # No point within the distance: the distance is infinite, and the index one past the last.
    tree = KDTree(target[:, :3].numpy())
    distance, nearest = tree.query(
        moved.numpy(), distance_upper_bound=_ROUGH_DISTANCE, workers=torch.get_num_threads()
    )
    closeness = np.clip(1 - (distance / _ROUGH_DISTANCE) ** 2, 0, None)
    nearest_normals = target[np.minimum(nearest, len(target) - 1), 3:6]
    parallel = (normals * nearest_normals).sum(-1).abs()
    return (parallel * torch.from_numpy(closeness)).mean(1)


def icp(source: np.ndarray, target: np.ndarray, seed: int) -> Hypotheses:
    """Return one hypothesis, centroid on centroid: everything else is left to ICP."""
    shift = target[:, :3].mean(0) - source[:, :3].mean(0)
    return Hypotheses(rigid.to_homogeneous(np.eye(3), shift)[None], *_NO_MATCHES)


def ransac(
    source: np.ndarray, target: np.ndarray, seed: int, settings: FpfhSettings = FPFH_RANSAC
) -> Hypotheses:
    """Return the one hypothesis of RANSAC over FPFH features."""
    return Hypotheses(fpfh_ransac(source, target, [seed], settings), *_NO_MATCHES)


def fgr(
    source: np.ndarray, target: np.ndarray, seed: int, settings: FpfhSettings = FPFH_FGR
) -> Hypotheses:
    """Return the one hypothesis of Fast Global Registration over FPFH features."""
    return Hypotheses(fpfh_fgr(source, target, seed, settings)[None], *_NO_MATCHES)


def kiss(
    source: np.ndarray, target: np.ndarray, seed: int, settings: KissSettings = KISS
) -> Hypotheses:
    """Return the one hypothesis of KISS-Matcher."""
    return Hypotheses(kiss_matcher(source, target, settings)[None], *_NO_MATCHES)


def ransac17(source: np.ndarray, target: np.ndarray, seed: int) -> Hypotheses:
    """Return seventeen hypotheses of RANSAC: one from each of as many seeds."""
    seeds = range(17 * seed, 17 * (seed + 1))
    return Hypotheses(fpfh_ransac(source, target, seeds), *_NO_MATCHES)


CLASSICAL: dict[str, HypothesisGenerator] = {
    "icp": icp, "ransac": ransac, "ransac17": ransac17, "fgr": fgr, "kiss": kiss,
}  # fmt: skip
