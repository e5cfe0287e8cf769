"""Refinement and scoring of a transform by how well it aligns two clouds."""

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import small_gicp
from scipy.spatial import KDTree

from corrmat.data.normals import NEIGHBORS
from corrmat.ops import rigid
from corrmat.registration.phase_correlation import PhaseCorrelation
from corrmat.types import MATCH_DISTANCE

COARSE_POINTS = 400  # of each cloud, to refine many transforms a little
LEVELS = 2048, 6_000, 20_000  # points of each cloud, to select a transform and to refine it
_TOO_SMALL = 10  # points, for small_gicp
_SAME = 0.02  # of `max_distance`: points that lie nearer than this are one point
_SHARED = 0.1  # share of the source's points that are the target's, too
# Least mean square of what surfaces resist of a motion that they hold: by the target's normals,
# whose noise resists a little, and by the product of both clouds' (benchmarks/free_motions.py).
_HELD, _HELD_BY_BOTH = 0.01, 0.001
_MAIN = 0.7  # least length of the shift, or the turn, in a free motion of length one


class Alignment(NamedTuple):
    """How well two clouds lie on each other; agreement and coherence are means over the clouds.

    agreement: in [0, 1]. A point counts the more, the nearer the nearest point of the other cloud
        is and the more parallel their normals are, whose signs are unknown.
    coherence: in [0, 0.25], the variance of "has a near point in the other cloud" that a linear
        function of the position explains. Two scans of one thing share a region, so that under
        the true transform the near points lie on one side; under a wrong one they are scattered.
    distances: (N,) and (M,), from each source point to the nearest target point, and the other way
        round; infinite beyond what counts as near.
    """

    agreement: float
    coherence: float
    distances: tuple[np.ndarray, np.ndarray]


class Overlap(NamedTuple):
    """How a source lies on a target."""

    share: float  # of the source's points that have a target point near
    rmse: float  # root mean square distance of these; NaN without any
    slides_along: np.ndarray | None  # (3,), a direction in which the target does not hold it
    turns_about: np.ndarray | None  # (3,), the axis of a turn that the target does not hold


class AlignmentScorer:
    """Refines transforms of one cloud onto another, and scores how well the two agree.

    Args:
        source: (N, 3), of a radius of about one.
        target: (M, 3).
    """

    def __init__(self, source: np.ndarray, target: np.ndarray) -> None:
        self.source, self.target = source, target
        self._trees = KDTree(source), KDTree(target)
        spacings = [np.median(tree.query(tree.data, 2)[0][:, 1]) for tree in self._trees]
        # Points of one surface, sampled twice, lie about as far apart as neighbours do.
        self.max_distance = float(np.clip(2 * np.mean(spacings), 0.01, 0.2))

    @functools.cached_property
    def _clouds(self) -> tuple[small_gicp.PointCloud, small_gicp.PointCloud, small_gicp.KdTree]:
        """Source, target and the target's KD-tree, for small_gicp."""
        clouds = [small_gicp.PointCloud(points) for points in (self.source, self.target)]
        for cloud in clouds:
            neighbors = min(NEIGHBORS, cloud.size())
            small_gicp.estimate_normals_covariances(cloud, num_neighbors=neighbors)
        return clouds[0], clouds[1], small_gicp.KdTree(clouds[1])

    @functools.cached_property
    def normals(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals of source (N, 3) and target (M, 3), of any sign."""
        source, target, _ = self._clouds
        return np.asarray(source.normals())[:, :3], np.asarray(target.normals())[:, :3]

    @functools.cached_property
    def phase_correlation(self) -> PhaseCorrelation:
        """Phase correlation of the two clouds."""
        source, target = map(np.hstack, zip((self.source, self.target), self.normals, strict=True))
        return PhaseCorrelation(source, target)

    @functools.cached_property
    def coarse(self) -> "AlignmentScorer":
        """Scorer of the first `COARSE_POINTS` of each cloud."""
        if max(len(self.source), len(self.target)) <= COARSE_POINTS:
            return self
        return AlignmentScorer(self.source[:COARSE_POINTS], self.target[:COARSE_POINTS])

    def refine(self, transform: np.ndarray, iterations: int = 30) -> np.ndarray:
        """Refine a transform (4, 4) by generalised ICP (Segal et al., RSS 2009).

        Clouds of ten points or fewer keep it: their covariances say nothing, and small_gicp warns.
        """
        if min(len(self.source), len(self.target)) <= _TOO_SMALL:
            return transform
        source, target, tree = self._clouds
        result = small_gicp.align(
            target,
            source,
            tree,
            transform,
            registration_type="GICP",
            max_correspondence_distance=self.max_distance,
            max_iterations=iterations,
        )
        return np.asarray(result.T_target_source)

    def shares_points(self, transform: np.ndarray) -> bool:
        """Tell whether a transform puts a tenth of the source's points on target points."""
        distance, _ = self._nearest_target(transform)
        return bool(np.mean(distance < _SAME * self.max_distance) > _SHARED)

    def alignment(self, transform: np.ndarray) -> Alignment:
        """Measure how well a transform (4, 4) puts the clouds on each other."""
        normals, target_normals = self.normals
        moved = normals @ transform[:3, :3].T
        (distance, index), (back_distance, back_index) = self._nearest(transform)
        sides = (
            (distance, moved, target_normals[index], self._axes[0]),
            (back_distance, target_normals, moved[back_index], self._axes[1]),
        )
        agreements, coherences = [], []
        for d, a, b, axes in sides:
            closeness = np.clip(1 - (d / self.max_distance) ** 2, 0, None)
            agreements.append(closeness @ np.abs((a * b).sum(1)) / len(d))
            near = d < self.max_distance
            coherences.append(np.square((near - near.mean()) @ axes).sum() / len(d))
        agreement, coherence = float(np.mean(agreements)), float(np.mean(coherences))
        return Alignment(agreement, coherence, (distance, back_distance))

    @functools.cached_property
    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal bases (N, 3) and (M, 3) of the linear functions of a point's position."""
        centred = [cloud - cloud.mean(0) for cloud in (self.source, self.target)]
        source, target = (np.linalg.svd(c, full_matrices=False)[0] for c in centred)
        return source, target

    def overlap(self, transform: np.ndarray) -> Overlap:
        """Compute how the source lies on the target under a transform (4, 4)."""
        distance, index = self._nearest_target(transform)
        near = distance < self.max_distance
        rmse = float(np.sqrt(np.mean(distance[near] ** 2))) if near.any() else np.nan
        slides_along, turns_about = self._free_motions(transform, near, index[near])
        return Overlap(float(near.mean()), rmse, slides_along, turns_about)

    def _free_motions(
        self, transform: np.ndarray, near: np.ndarray, nearest: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Find the motions that the target's surfaces leave to the aligned source.

        A surface resists a point's motion along its normal. The mean square of what it resists is
        a quadratic form of turn and shift, whose eigenvectors of small values are free motions
        (Gelfand et al., "Geometrically Stable Sampling for the ICP Algorithm", 3DIM 2003). Noisy
        normals seem to resist every motion. But the noise of source and target is independent: the
        mean product of what their normals resist is without it, and has to be small, too.

        Args:
            transform: (4, 4).
            near: (N,) bool, the K source points that have a target point near.
            nearest: (K,) those target points.

        Returns:
            The direction of a free shift, and the axis of a free turn: unit vectors (3,), whose
            largest component is positive. None without such a motion, or with fewer than ten
            aligned points.
        """
        if len(nearest) < _TOO_SMALL:
            return None, None
        points = rigid.move(transform, self.source[near])
        arms = points - points.mean(0)
        arms /= np.sqrt(np.square(arms).sum(1).mean())
        normals = self.normals[1][nearest]
        others = self.normals[0][near] @ transform[:3, :3].T
        others *= np.sign((normals * others).sum(1, keepdims=True))
        resisted, by_source = (np.hstack([np.cross(arms, n), n]) for n in (normals, others))
        values, motions = np.linalg.eigh(resisted.T @ resisted / len(arms))
        free = motions[:, values < _HELD]
        products = free.T @ (resisted.T @ by_source / len(arms)) @ free
        values, mixed = np.linalg.eigh((products + products.T) / 2)
        turns, shifts = np.split(free @ mixed[:, values < _HELD_BY_BOTH], 2)
        return _main_direction(shifts), _main_direction(turns)

    def _nearest(self, transform: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Find the nearest target point of every source point, and the other way round.

        Returns:
            Distances and indices: (N,) each for the source, (M,) each for the target. Where no
            point is near, the distance is infinite and the index is of any point.
        """
        source, target = self._trees
        back = (target.data - transform[:3, 3]) @ transform[:3, :3]
        return [self._nearest_target(transform), self._query(source, back)]

    def _nearest_target(self, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the nearest target point of every source point alone; see `_nearest`."""
        source, target = self._trees
        return self._query(target, rigid.move(transform, source.data))

    def _query(self, tree: KDTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the nearest point of a tree to each of `points`; see `_nearest`."""
        farthest = max(self.max_distance, MATCH_DISTANCE)
        distance, index = tree.query(points, distance_upper_bound=farthest)
        return np.asarray(distance), np.minimum(index, tree.n - 1)


def _main_direction(parts: np.ndarray) -> np.ndarray | None:
    """Return the direction of the shift, or of the turn, that free motions mostly are.

    Args:
        parts: (3, F), the shifts, or the turns, of F orthonormal motions.

    Returns:
        A unit vector (3,), whose largest component is positive; None if no motion is mostly that.
    """
    directions, lengths, _ = np.linalg.svd(parts)
    if not len(lengths) or lengths[0] < _MAIN:
        return None
    direction = directions[:, 0]
    return direction * np.sign(direction[np.abs(direction).argmax()])


def scorers_of_levels(source: np.ndarray, target: np.ndarray) -> list[AlignmentScorer]:
    """Return scorers of the first points of two clouds, coarse to fine; see `LEVELS`.

    Args:
        source: (N, 3), in random order.
        target: (M, 3), the same.

    Returns:
        One for each level, up to the first that has all points.
    """
    most = max(len(source), len(target))
    levels = [LEVELS[0], *(level for fewer, level in itertools.pairwise(LEVELS) if most > fewer)]
    return [AlignmentScorer(source[:level], target[:level]) for level in levels]


def refine_coarse_to_fine(transform: np.ndarray, scorers: Sequence[AlignmentScorer]) -> np.ndarray:
    """Refine a transform (4, 4) by generalised ICP on more and more points.

    Few points lie far apart, and draw a transform from far; many are exact.
    """
    for scorer in scorers:
        transform = scorer.refine(transform)
    return transform
