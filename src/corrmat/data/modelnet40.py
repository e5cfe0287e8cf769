"""ModelNet40 as sampled clouds, in the official HDF5 layout (Qi et al., PointNet)."""

import hashlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import h5py
import numpy as np

from corrmat.data import download
from corrmat.data.clouds import CloudSet, cache_folder, finish_shards, log, open_shards, write_shard
from corrmat.data.normals import estimate_normals
from corrmat.errors import CorrmatError

FOLDER = "modelnet40_ply_hdf5_2048"
SOURCE = "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip"


def fetch(root: Path, mirrors: Sequence[str] = (SOURCE,)) -> Path:
    """Download and unpack the data set, unless it is already there.

    Args:
        root: folder that `FOLDER` goes into; a zip that is already there is used.
        mirrors: addresses of the zip.

    Returns:
        The data set's folder.

    Raises:
        CorrmatError: see `download.fetch` and `download.unzip`.
    """
    folder, archive = root / FOLDER, root / f"{FOLDER}.zip"
    if not folder.is_dir():
        if not archive.is_file():
            download.fetch(mirrors, archive)
        download.unzip(archive, root, FOLDER)
    for split in ("train", "test"):
        load(split, root=root)
    return folder


def load(split: str, count: int | None = None, root: Path | None = None) -> CloudSet:
    """Load a split; the HDF5 files are converted to shards in the cache folder once.

    Args:
        split: "train" or "test", as the official file lists have it.
        count: number of shapes; None for all.
        root: the folder `modelnet40_ply_hdf5_2048`, or the one that holds it.

    Raises:
        CorrmatError: a folder, list or file is missing or damaged; the message names it.
    """
    if root is None:
        raise CorrmatError(
            "data set modelnet40 needs its folder: ROOT=..., --data.root ... or --root ..."
        )
    folder = _find_folder(root)
    names = tuple(_read_lines(folder / "shape_names.txt"))
    # The official lists say "data/modelnet40_ply_hdf5_2048/<file>": only the name counts.
    files = [
        folder / PurePosixPath(line).name for line in _read_lines(folder / f"{split}_files.txt")
    ]
    for file in files:
        if not file.is_file():
            raise CorrmatError(f"{file} is missing, but {split}_files.txt names it; fetch it again")
    shards = cache_folder() / f"modelnet40-{_identity(files, names)}-{split}"
    clouds = open_shards(shards)
    if clouds is None:
        sizes = set()
        for number, file in enumerate(files):
            rows, labels = read_hdf5(file, names)
            sizes.add(rows.shape[1])
            if len(sizes) > 1:
                raise CorrmatError(
                    f"the files of {folder} differ in their number of points a cloud"
                )
            write_shard(shards, number, rows, labels)
        finish_shards(shards, names, len(files))
        clouds = open_shards(shards)
    assert clouds is not None
    return clouds.select(slice(count))


def read_hdf5(path: Path, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Read one file of the official layout: `data`, `normal`, `label`.

    Missing normals are estimated, and a warning says so.

    Returns:
        Rows (S, P, 6) float32 and labels (S,).

    Raises:
        CorrmatError: the file is cut short, lacks an array, or holds NaN points.
    """
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
    _require_finite(points, "points", path)
    if normals is None:
        log.warning("%s has no normals: estimated from neighbouring points, facing outwards", path)
        normals = np.stack([estimate_normals(c) for c in points]) if len(points) else points
    _require_finite(normals, "normals", path)
    return np.concatenate([points, normals], -1), labels


def _require_finite(array: np.ndarray, kind: str, path: Path) -> None:
    bad = np.flatnonzero(~np.isfinite(array).all((1, 2)))
    if len(bad):
        raise CorrmatError(f"{path}: shape {bad[0]} has NaN or infinite {kind}; remove or mend it")


def _identity(files: Sequence[Path], names: Sequence[str]) -> str:
    """Hash names, sizes and times of the files: a changed file makes other shards."""
    stats = [(f.resolve().as_posix(), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(repr((stats, names)).encode()).hexdigest()[:12]


def _find_folder(root: Path) -> Path:
    """Find the official folder: the root, or inside it."""
    for folder in (root, root / FOLDER):
        if (folder / "shape_names.txt").is_file():
            return folder
    raise CorrmatError(
        f"no ModelNet40 in {root} (looked for shape_names.txt and {FOLDER}/); "
        f"unpack {SOURCE} there, or take the data set shapes"
    )


def _read_lines(path: Path) -> list[str]:
    """Read the lines of an official list that are not empty."""
    if not path.is_file():
        raise CorrmatError(f"{path} is missing; fetch the data set again")
    lines = [line.strip() for line in path.read_text().splitlines() if line.strip()]
    if not lines:
        raise CorrmatError(f"{path} is empty; fetch the data set again")
    return lines
