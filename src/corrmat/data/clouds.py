"""A set of clean clouds, and the HDF5 layout in which they are kept (ModelNet40's official one)."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from corrmat.data.normals import estimate
from corrmat.errors import CorrmatError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CloudSet:
    """S clean clouds of P points each, centred, in the unit sphere. Nobody writes into them."""

    rows: np.ndarray  # (S, P, 6) float32: xyz and unit normal of every point
    labels: np.ndarray  # (S,) int64, index into names
    names: tuple[str, ...]  # categories

    @property
    def points(self) -> np.ndarray:
        """(S, P, 3) coordinates."""
        return self.rows[..., :3]

    @property
    def normals(self) -> np.ndarray:
        """(S, P, 3) unit normals."""
        return self.rows[..., 3:]

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, index: np.ndarray | slice) -> "CloudSet":
        """The shapes at these positions."""
        return CloudSet(self.rows[index], self.labels[index], self.names)

    def only(self, categories: Sequence[str]) -> "CloudSet":
        """The shapes of these categories.

        Raises:
            CorrmatError: a category is unknown, or no shape is left.
        """
        for name in categories:
            if name not in self.names:
                raise CorrmatError(f"unknown category {name!r}; known: {', '.join(self.names)}")
        wanted = [self.names.index(name) for name in categories]
        kept = self.take(np.flatnonzero(np.isin(self.labels, wanted)))
        if not len(kept):
            raise CorrmatError(f"no shape of {', '.join(categories)} in this data set")
        return kept


def read_hdf5(path: Path, names: tuple[str, ...]) -> CloudSet:
    """Read one file of the official layout: `data`, `normal`, `label`.

    A file without `normal` gets estimated ones, and a warning says so.

    Raises:
        CorrmatError: the file is missing, cut short, lacks an array, or holds NaN points.
    """
    if not path.is_file():
        raise CorrmatError(f"{path} is missing; fetch the data set again")
    try:
        with h5py.File(path) as file:
            points = np.asarray(file["data"], np.float32)
            normals = np.asarray(file["normal"], np.float32) if "normal" in file else None
            labels = np.asarray(file["label"], np.int64).reshape(-1)
    except KeyError as error:
        raise CorrmatError(f"{path} lacks an array of the official layout: {error}") from error
    except OSError as error:
        raise CorrmatError(
            f"{path} is not readable HDF5 (cut short?), fetch it again: {error}"
        ) from error
    shapes = points.shape, points.shape if normals is None else normals.shape
    if points.ndim != 3 or points.shape[2] != 3 or shapes[0] != shapes[1]:
        raise CorrmatError(
            f"{path}: data {shapes[0]} and normal {shapes[1]} are not both (S, P, 3)"
        )
    if len(labels) != len(points) or (
        len(labels) and not 0 <= labels.min() <= labels.max() < len(names)
    ):
        raise CorrmatError(f"{path}: labels do not fit {len(points)} shapes of {len(names)} names")
    _all_finite(points, "points", path)
    if normals is None:
        log.warning("%s has no normals: estimated from neighbouring points, facing outwards", path)
        normals = np.stack([estimate(cloud) for cloud in points]) if len(points) else points
    _all_finite(normals, "normals", path)
    return CloudSet(np.concatenate([points, normals], -1), labels, names)


def _all_finite(array: np.ndarray, kind: str, path: Path) -> None:
    bad = np.flatnonzero(~np.isfinite(array).all((1, 2)))
    if len(bad):
        raise CorrmatError(f"{path}: shape {bad[0]} has NaN or infinite {kind}; remove or mend it")


def concatenate(parts: Sequence[CloudSet]) -> CloudSet:
    """Several sets of the same categories as one.

    Raises:
        CorrmatError: they differ in their number of points.
    """
    if len({part.rows.shape[1] for part in parts}) > 1:
        raise CorrmatError("the files of this data set differ in their number of points a cloud")
    return CloudSet(
        np.concatenate([part.rows for part in parts]),
        np.concatenate([part.labels for part in parts]),
        parts[0].names,
    )
