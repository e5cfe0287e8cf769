"""What the page and the animation of a registration draw: two clouds, matches, and the motion."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from corrmat.registration.preparation import is_near
from corrmat.registration.result import Registration
from corrmat.reporting.figures import principal_axes

BESIDE = 0.6  # of both clouds' largest extents: how far the source starts from the target


@dataclass(frozen=True)
class Scene:
    """A registration in the target's frame, about the target's centroid.

    Far from the origin a browser's float32 would lose the detail. Stray points, which `register`
    leaves out, are NaN: no program draws them, and they do not count for the extents.
    """

    fixed: np.ndarray  # (M, 3) the target
    aligned: np.ndarray  # (N, 3) the source where it ends
    middle: np.ndarray  # (3,) centroid of the aligned source, about which it rotates
    rotvec: np.ndarray  # (3,) rotation vector from where it ends to as it was given
    beside: float  # how far to the left it starts, so that the clouds do not hide each other
    matches: np.ndarray  # (K, 2) rows of source and target, the most confident first
    agrees: np.ndarray  # (K,) bool: whether the transform takes one end near the other

    def source_at(self, progress: float, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return rows of the source: as given, beside the target (0), to aligned (1)."""
        left = 1 - progress
        rotation = Rotation.from_rotvec(left * self.rotvec).as_matrix()
        centred = self.aligned[rows] - self.middle
        return centred @ rotation.T + self.middle - [left * self.beside, 0, 0]


def extent(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates, (3,) each, of points (N, 3) that are not NaN."""
    return np.nanmin(points, 0), np.nanmax(points, 0)


def _largest_extent(points: np.ndarray) -> float:
    low, high = extent(points)
    return float((high - low).max())


def _hide_stray_points(points: np.ndarray) -> np.ndarray:
    """Make stray points NaN: (N, 3) to (N, 3)."""
    return np.where(is_near(points, np.unique(points, axis=0))[:, None], points, np.nan)


def build_scene(
    registration: Registration,
    source: np.ndarray,
    target: np.ndarray,
    max_matches: int,
    *,
    widest: bool = False,
) -> Scene:
    """Build the scene of a registration.

    Args:
        registration: of the source onto the target.
        source: (N, 3 or more), as given to `register`.
        target: (M, 3 or more).
        max_matches: the most confident ones that are kept.
        widest: rotate the scene so that the target is as wide as it can be; else its axes are
            those of the target's frame.
    """
    source, target = (_hide_stray_points(cloud[:, :3]) for cloud in (source, target))
    axes = principal_axes(target[np.isfinite(target).all(1)]) if widest else np.eye(3)
    origin = np.nanmean(target, 0)
    rotation, translation = registration.transform[:3, :3], registration.transform[:3, 3]
    fixed = (target - origin) @ axes
    aligned = (source @ rotation.T + translation - origin) @ axes
    strongest = np.argsort(-registration.match_confidence, kind="stable")[:max_matches]
    return Scene(
        fixed,
        aligned,
        np.nanmean(aligned, 0),
        rotvec=Rotation.from_matrix(axes.T @ rotation.T @ axes).as_rotvec(),
        beside=BESIDE * (_largest_extent(fixed) + _largest_extent(aligned)),
        matches=registration.matches[strongest],
        agrees=registration.match_agrees[strongest],
    )
