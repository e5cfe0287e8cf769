"""Refinement and scoring of a transform by how well it aligns two clouds."""

import functools

import numpy as np
import small_gicp
from scipy.spatial import KDTree


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
            small_gicp.estimate_normals_covariances(cloud, num_neighbors=min(12, cloud.size()))
        return clouds[0], clouds[1], small_gicp.KdTree(clouds[1])

    @functools.cached_property
    def _normals(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals of source (N, 3) and target (M, 3), of any sign."""
        source, target, _ = self._clouds
        return np.asarray(source.normals())[:, :3], np.asarray(target.normals())[:, :3]

    def refine(self, transform: np.ndarray) -> np.ndarray:
        """Refine a transform (4, 4) by generalised ICP (Segal et al., RSS 2009)."""
        source, target, tree = self._clouds
        result = small_gicp.align(
            target,
            source,
            tree,
            transform,
            registration_type="GICP",
            max_correspondence_distance=self.max_distance,
            max_iterations=30,
        )
        return np.asarray(result.T_target_source)

    def agreement(self, transform: np.ndarray) -> float:
        """Score in [0, 1] how much of either cloud lies on the other, surface along surface.

        A point counts the less the farther away the nearest point of the other cloud is, and the
        more the two normals differ, whose sign is unknown.
        """
        normals, target_normals = self._normals
        moved = normals @ transform[:3, :3].T
        (distance, index), (back_distance, back_index) = self._nearest(transform)
        scores = [
            np.clip(1 - (d / self.max_distance) ** 2, 0, None) @ np.abs((a * b).sum(1)) / len(d)
            for d, a, b in (
                (distance, moved, target_normals[index]),
                (back_distance, target_normals, moved[back_index]),
            )
        ]
        return float(np.mean(scores))

    def overlap_and_rmse(self, transform: np.ndarray) -> tuple[float, float]:
        """Compute the share of source points with a target point near, and their RMS distance.

        The RMS distance is NaN without any such point.
        """
        (to_target, _), _ = self._nearest(transform)
        near = to_target[to_target < self.max_distance]
        rmse = float(np.sqrt(np.mean(near**2))) if len(near) else np.nan
        return len(near) / len(to_target), rmse

    def _nearest(self, transform: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Find the nearest target point of every source point, and the other way round.

        Returns:
            Distances and indices: (N,) each for the source, (M,) each for the target.
        """
        rotation, translation = transform[:3, :3], transform[:3, 3]
        moved = self.source @ rotation.T + translation
        back = (self.target - translation) @ rotation
        found = self._trees[1].query(moved), self._trees[0].query(back)
        return [(np.asarray(distance), np.asarray(index)) for distance, index in found]
