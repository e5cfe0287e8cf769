"""Estimation of normals for clouds without them."""

import numpy as np
import small_gicp

NEIGHBORS = 20


def estimate_normals(points: np.ndarray) -> np.ndarray:
    """Estimate unit normals from the principal axes of each point's neighbourhood.

    They face away from the cloud's centroid. That is wrong inside a concave shape, but the
    choice is the same for every pose of the cloud, which is what features need.

    Args:
        points: (P, 3), any units.

    Returns:
        (P, 3) float32; the direction from the centroid if the neighbours do not span a plane.
    """
    centred = points.astype(np.float64) - points.mean(0, dtype=np.float64)
    cloud = small_gicp.PointCloud(centred)
    small_gicp.estimate_normals(cloud, num_neighbors=min(NEIGHBORS, len(points)))
    normals = np.asarray(cloud.normals())[:, :3].copy()
    undefined = ~(np.linalg.norm(normals, axis=1) > 0.5)
    normals[undefined] = centred[undefined]
    normals *= np.where((normals * centred).sum(1) < 0, -1.0, 1.0)[:, None]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])  # for a point in the centroid itself
    return np.where(length > 0, normals / np.maximum(length, 1e-300), up).astype(np.float32)
