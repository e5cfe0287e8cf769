"""What a depth camera sees of a cloud: its visible points, and its noise."""

import numpy as np
from scipy.spatial import ConvexHull

_RADIUS = 100.0  # of the flipping sphere, in distances of the farthest point


def visible_points(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Find the points (K,) int64, ascending, that a camera sees (Katz et al., SIGGRAPH 2007).

    A point is visible if, after all have been flipped outwards through a sphere about the camera,
    it lies on their convex hull with the camera.

    Args:
        points: (P, 3), not all in one plane with the camera.
        camera: (3,) its position, outside of the cloud.
    """
    ray = points.astype(np.float64) - camera
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    flipped = ray * (2 * _RADIUS * distance.max() / distance - 1)
    hull = ConvexHull(np.vstack([flipped, np.zeros((1, 3))]))
    return np.sort(hull.vertices[hull.vertices < len(points)]).astype(np.int64)


def depth_noise(points: np.ndarray, camera: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Move noise onto the rays of a camera, growing with the square of the distance.

    Stereo and structured light err so (Khoshelham & Elberink, Sensors 2012).

    Args:
        points: (N, 3).
        camera: (3,) its position.
        noise: (N, 3), whose first column is used; at the distance of the origin it is not scaled.

    Returns:
        (N, 3) offsets.
    """
    ray = points - camera
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    return noise[:, :1] * (distance / np.linalg.norm(camera)) ** 2 * ray / distance
