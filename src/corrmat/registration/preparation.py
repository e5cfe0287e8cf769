"""A user's clouds become those that the model sees: checked, centred, scaled and subsampled."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from corrmat.data.normals import estimate_normals
from corrmat.errors import CorrmatError
from corrmat.registration.scoring import LEVELS, AlignmentScorer, scorers_of_levels

MODEL_POINTS = 1024  # points of each cloud for the model
FULL_POINTS = LEVELS[-1]  # at most, to refine the best of its hypotheses
MEDIAN = 0.6  # median distance from the centroid after scaling: a radius of about one
NORMAL_TOLERANCE = 0.01  # by which the length of a given normal may differ from one
RIGID_TOLERANCE = 0.01  # by which the rotation of a given transform may differ from one
FAR = 30.0  # median distances from the middle: a point beyond is a stray one and left out
COARSE = 0.05  # median distances: a cloud whose coordinates have larger steps is damaged
_LINE = 1e-6  # a cloud that is thinner, relative to its length, is a line


class Cloud:
    """At most `FULL_POINTS` points of a user's cloud, in canonical order, and their centroid.

    They are ordered by a hash of coordinates and seed, so that the first n are a random subsample
    that does not depend on the order of the user's rows.
    """

    def __init__(self, rows: np.ndarray, values: np.ndarray) -> None:
        self.rows, self.values = rows, values
        self.centre = values[:, :3].mean(0)
        self.centred = values[:, :3] - self.centre
        self.median = float(np.median(np.linalg.norm(self.centred, axis=1)))

    @classmethod
    def of(cls, cloud: "np.ndarray | Cloud", name: str, seed: int) -> "Cloud":
        """Check a cloud and bring it into canonical order, if that has not been done yet.

        Raises:
            CorrmatError: see `register`; the message begins with the name.
        """
        if isinstance(cloud, Cloud):
            return cloud
        if isinstance(cloud, str | Path):
            raise CorrmatError(f"{name}: points are needed; corrmat.read_scan reads a file")
        if isinstance(cloud, np.ma.MaskedArray):
            raise CorrmatError(f"{name}: a masked array; pass the rows that count, or fill it")
        detach = getattr(cloud, "detach", None)  # a tensor of torch, maybe on a GPU
        if detach is not None:
            cloud = detach().cpu().double().numpy()
        try:
            given = np.asarray(cloud)
            if np.iscomplexobj(given):
                raise TypeError("complex numbers")
            values = given.astype(np.float64, copy=False)
        except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError is torch's
            raise CorrmatError(f"{name}: not an array of numbers ({error})") from error
        if values.ndim != 2 or values.shape[1] not in (3, 6):
            wide = values.ndim == 2 and values.shape[0] in (3, 6)
            remedy = "; transpose it" if wide else ""
            raise CorrmatError(
                f"{name}: array of shape {values.shape}, not (N, 3) or (N, 6){remedy}"
            )
        if len(values) < 3:
            raise CorrmatError(f"{name}: {len(values)} points; a rotation needs at least 3")
        bad = np.flatnonzero(~np.isfinite(values).all(1))
        if len(bad):
            raise CorrmatError(
                f"{name}: {len(bad)} points are NaN or infinite, the first is row {bad[0]}; leave "
                "them out: points[np.isfinite(points).all(1)]"
            )
        lengths = np.linalg.norm(values[:, 3:], axis=1)
        if values.shape[1] > 3 and np.abs(lengths - 1).max() > NORMAL_TOLERANCE:
            worst = lengths[np.abs(lengths - 1).argmax()]
            raise CorrmatError(
                f"{name}: columns 4 to 6 are no unit normals (one has length {worst:.3g}); pass "
                "the points alone, (N, 3), and normals are estimated"
            )
        # A point that is there more than once counts once: its copies would shrink the spacing.
        rows = np.unique(_hash(values, seed), return_index=True)[1]
        if values.shape[1] > 3:  # copies may differ in their normals
            first = np.unique(_hash(values[rows, :3], seed), return_index=True)[1]
            rows = rows[np.sort(first)]
        rows = rows[:FULL_POINTS]
        if len(rows) < 3:
            many = f"{len(rows)} different points" if len(rows) > 1 else "all points are equal"
            raise CorrmatError(f"{name}: {many}; the rotation is not determined")
        rows = rows[is_near(values[rows, :3], values[rows, :3], name)]
        if len(rows) < 3:
            raise CorrmatError(f"{name}: {len(rows)} points are left without the stray ones")
        checked = cls(rows, values[rows])
        length, breadth, _ = np.linalg.svd(checked.centred, compute_uv=False)[:3]
        noise = 1e-12 * np.abs(checked.values[:, :3]).max() * np.sqrt(len(rows))
        if length <= noise:
            raise CorrmatError(f"{name}: all points are equal; the rotation is not determined")
        if breadth <= max(_LINE * length, noise):
            raise CorrmatError(
                f"{name}: all points lie on one line; the rotation is not determined"
            )
        step = float(np.spacing(np.abs(checked.values[:, :3]).max().astype(np.float32)))
        if step > COARSE * checked.median and _is_float32(checked.values[:, :3]):
            raise CorrmatError(
                f"{name}: so far from the origin its float32 coordinates have steps of {step:.2g}, "
                "too coarse for its size; export doubles, or subtract an offset before"
            )
        return checked

    def points(self, scale: float, count: int) -> np.ndarray:
        """Return the first points, (n, 3), centred and scaled."""
        return self.centred[:count] * scale

    def with_normals(self, scale: float, count: int) -> np.ndarray:
        """Return the first points with normals, (n, 6); missing normals are estimated from them."""
        points = self.points(scale, count)
        given = self.values[:count, 3:]
        return np.hstack([points, given if given.shape[1] else estimate_normals(points)])


class PreparedClouds(NamedTuple):
    """Two clouds as the model and the choice among its hypotheses see them."""

    source: Cloud
    target: Cloud
    scale: float  # from the user's units to those in which a cloud's radius is about one
    subsamples: tuple[np.ndarray, np.ndarray]  # (N, 6) and (M, 6), for the model
    scorers: list[AlignmentScorer]  # of more and more points; the first of each are the model's
    seed: int  # of the subsamples, and of random draws

    def to_original_units(self, transform: np.ndarray) -> np.ndarray:
        """Convert a transform (4, 4) of the prepared clouds to the user's coordinates."""
        converted = transform.copy()
        moved = transform[:3, :3] @ self.source.centre
        converted[:3, 3] = self.target.centre + transform[:3, 3] / self.scale - moved
        return converted

    def from_original_units(self, transform: np.ndarray) -> np.ndarray:
        """Convert a transform (4, 4) of the user's coordinates to the prepared clouds."""
        converted = transform.copy()
        moved = transform[:3, :3] @ self.source.centre + transform[:3, 3]
        converted[:3, 3] = self.scale * (moved - self.target.centre)
        return converted


def prepare_clouds(
    source: np.ndarray | Cloud, target: np.ndarray | Cloud, seed: int
) -> PreparedClouds:
    """Check, centre, scale and subsample two clouds; see `register`."""
    x, y = Cloud.of(source, "source", seed), Cloud.of(target, "target", seed)
    scale = 2 * MEDIAN / (x.median + y.median)
    subsamples = x.with_normals(scale, MODEL_POINTS), y.with_normals(scale, MODEL_POINTS)
    scorers = scorers_of_levels(x.points(scale, FULL_POINTS), y.points(scale, FULL_POINTS))
    return PreparedClouds(x, y, scale, subsamples, scorers, seed)


def as_rigid(transform: np.ndarray) -> np.ndarray:
    """Check a rigid transform (4, 4) that somebody gives, and make its rotation exact.

    Raises:
        CorrmatError: it is none.
    """
    try:
        given = np.array(transform, np.float64)
    except (TypeError, ValueError) as error:
        raise CorrmatError(f"init is no matrix: {error}") from error
    if given.shape != (4, 4) or not np.isfinite(given).all():
        raise CorrmatError(f"init is no matrix of 4 x 4 finite numbers, but {given.shape}")
    left, stretch, right = np.linalg.svd(given[:3, :3])
    rotates = np.abs(stretch - 1).max() < RIGID_TOLERANCE and np.linalg.det(left @ right) > 0
    if not rotates or (given[3] != (0, 0, 0, 1)).any():
        raise CorrmatError("init does not only rotate and shift: it scales, shears or mirrors")
    given[:3, :3] = left @ right
    return given


def is_near(points: np.ndarray, different: np.ndarray, name: str = "cloud") -> np.ndarray:
    """Tell which points are no stray ones: (N,) bool.

    Args:
        points: (N, 3).
        different: (M, 3) the same, each once: copies would move the middle.
        name: of the cloud, for the error.

    Raises:
        CorrmatError: coordinates are too large, or too small, to be squared.
    """
    middle = np.median(different, axis=0)
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(points - middle, axis=1)
        typical = np.median(np.linalg.norm(different - middle, axis=1))
    if not 0 < typical < np.inf:
        size = "small" if typical == 0 else "large"
        raise CorrmatError(f"{name}: coordinates are too {size} to compute distances")
    return distance <= FAR * typical


def _is_float32(values: np.ndarray) -> bool:
    """Tell whether numbers were stored in single precision."""
    return bool((values == values.astype(np.float32)).all())


def _hash(values: np.ndarray, seed: int) -> np.ndarray:
    """Hash every row to 64 bits by the finaliser of splitmix64 (Steele et al., 2014)."""
    state = np.full(len(values), seed, np.uint64)
    for column in np.ascontiguousarray((values + 0.0).T).view(np.uint64):  # + 0.0: no minus zero
        state = state * np.uint64(0x9E3779B97F4A7C15) ^ column
        state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return state
