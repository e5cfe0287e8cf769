"""Who guesses how two clouds lie to each other: the learned network, and the classical pipelines.

All have one signature and all are refined, chosen and judged by `register` in the same way.
Lengths are in units in which a cloud's radius is about one.
"""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from corrmat.errors import CorrmatError
from corrmat.ops.consensus import consensus


class Guesses(NamedTuple):
    """Motions that may take the source onto the target, and the matches that speak for them."""

    transforms: np.ndarray  # (T, 4, 4) float64, T_target_source, best first
    matches: np.ndarray  # (K, 2) int64 rows of source and target, K may be 0
    confidence: np.ndarray  # (K,) in [0, 1]

    def support(self, transform: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
        """In [0, 1]: how much of the matches a motion explains; 1 if there are none.

        Args:
            transform: (4, 4).
            source: (N, 3 or more), as the matches count its rows.
            target: (M, 3 or more).
        """
        if not len(self.matches):
            return 1.0
        weight = np.sqrt(self.confidence)
        return float(weight @ self.explained(transform, source, target) / weight.sum())

    def explained(
        self, transform: np.ndarray, source: np.ndarray, target: np.ndarray
    ) -> np.ndarray:
        """(K,) in [0, 1]: how well a motion explains each match; arguments as for `support`."""
        x, y = source[self.matches[:, 0], :3], target[self.matches[:, 1], :3]
        off = np.linalg.norm(x @ transform[:3, :3].T + transform[:3, 3] - y, axis=1)
        return np.clip(1 - (off / _EXPLAINED) ** 2, 0, None)


Aligner = Callable[[np.ndarray, np.ndarray, int], Guesses]
"""(source (N, 6), target (M, 6), seed) -> Guesses; rows are xyz and unit normal."""

_EXPLAINED = 0.2  # a match that stays off by more says nothing for a motion
_NO_MATCHES = np.empty((0, 2), np.int64), np.empty(0)


class Learned:
    """A network's correspondence matrix, and the motions that its strongest matches agree on.

    Args:
        network: (source, target) -> Prediction with a correspondence.
        reach: how far off a match may stay.
        most: matches that are looked at.
        count: motions guessed at most.
    """

    def __init__(
        self, network: nn.Module, reach: float = 0.15, most: int = 256, count: int = 16
    ) -> None:
        self.network = network.eval()
        self.reach, self.most, self.count = reach, most, count

    @torch.no_grad()
    def __call__(self, source: np.ndarray, target: np.ndarray, seed: int) -> Guesses:
        """Guess at source (N, 6) and target (M, 6)."""
        x, y = (torch.from_numpy(np.asarray(c, np.float32)).unsqueeze(0) for c in (source, target))
        least = int(getattr(self.network, "min_points", 3))
        if min(x.shape[1], y.shape[1]) < least:
            raise CorrmatError(f"this network needs clouds of at least {least} points")
        prediction = self.network(x, y)
        alone = _motion(prediction.rotation[0], prediction.translation[0])[None]
        if prediction.correspondence is None:
            return Guesses(alone, *_NO_MATCHES)
        prob = prediction.correspondence.prob()[0, :, : y.shape[1]]
        # The strongest entries that are the most of their row or their column.
        top = (prob == prob.amax(0)) | (prob == prob.amax(1, keepdim=True))
        weight, place = (prob * top).flatten().topk(min(self.most, prob.numel()))
        weight, place = weight[weight > 0], place[weight > 0]
        i, j = place // prob.shape[1], place % prob.shape[1]
        matches = torch.stack([i, j], 1).numpy()
        generator = torch.Generator().manual_seed(seed)
        rotation, translation, _ = consensus(
            x[0, i, :3],
            y[0, j, :3],
            weight.sqrt(),
            self.reach,
            generator=generator,
            count=self.count,
        )
        found = [_motion(r, t) for r, t in zip(rotation, translation, strict=True)]
        return Guesses(np.stack([*found, *alone]), matches, weight.double().numpy())


def _motion(rotation: torch.Tensor, translation: torch.Tensor) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation.double(), translation.double()
    return transform


def icp(source: np.ndarray, target: np.ndarray, seed: int) -> Guesses:
    """As they lie, centroid on centroid: what is left to refinement alone."""
    transform = np.eye(4)
    transform[:3, 3] = target[:, :3].mean(0) - source[:, :3].mean(0)
    return Guesses(transform[None], *_NO_MATCHES)


class ClassicalSettings(NamedTuple):
    """Lengths and counts of the classical pipelines."""

    feature_radius: float
    reach: float
    mutual: bool = True  # RANSAC only: keep matches that are each other's best
    feature_neighbors: int = 100
    iterations: int = 100_000


# The best of those that benchmarks/tune_classical.py tries on validation pairs.
RANSAC = ClassicalSettings(feature_radius=0.65, reach=0.12)
FGR = ClassicalSettings(feature_radius=0.65, reach=0.05)


def ransac(
    source: np.ndarray, target: np.ndarray, seed: int, how: ClassicalSettings = RANSAC
) -> Guesses:
    """FPFH features, RANSAC over their matches (Rusu et al., ICRA 2009; Open3D)."""
    o3d, clouds, features = _features(source, target, how)
    registration = o3d.pipelines.registration
    o3d.utility.random.seed(seed)
    found = registration.registration_ransac_based_on_feature_matching(
        *clouds,
        *features,
        how.mutual,
        how.reach,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            registration.CorrespondenceCheckerBasedOnDistance(how.reach),
        ],
        registration.RANSACConvergenceCriteria(how.iterations, 0.999),
    )
    return Guesses(np.asarray(found.transformation)[None].copy(), *_NO_MATCHES)


def fgr(source: np.ndarray, target: np.ndarray, seed: int, how: ClassicalSettings = FGR) -> Guesses:
    """Fast Global Registration over FPFH features (Zhou et al., ECCV 2016; Open3D)."""
    o3d, clouds, features = _features(source, target, how)
    registration = o3d.pipelines.registration
    o3d.utility.random.seed(seed)
    option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=how.reach)
    found = registration.registration_fgr_based_on_feature_matching(*clouds, *features, option)
    return Guesses(np.asarray(found.transformation)[None].copy(), *_NO_MATCHES)


def _features(
    source: np.ndarray, target: np.ndarray, how: ClassicalSettings
) -> tuple[Any, list[Any], list[Any]]:
    try:
        o3d: Any = importlib.import_module("open3d")
    except ImportError as error:
        raise CorrmatError("ransac and fgr are Open3D's: pip install open3d") from error
    clouds, features = [], []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[:, :3].astype(float)))
        cloud.normals = o3d.utility.Vector3dVector(points[:, 3:].astype(float))
        around = o3d.geometry.KDTreeSearchParamHybrid(how.feature_radius, how.feature_neighbors)
        clouds.append(cloud)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, around))
    return o3d, clouds, features


CLASSICAL: dict[str, Aligner] = {"icp": icp, "ransac": ransac, "fgr": fgr}
