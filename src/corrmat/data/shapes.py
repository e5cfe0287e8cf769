"""The embedded data set: parametric CAD-like shapes, made here and cached.

Shape i of a split is a pure function of (split, i), and families take turns, so that the
first n shapes are a balanced data set of their own.
"""

import hashlib
import os
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np
import platformdirs
import trimesh
from rich.progress import track

from corrmat.data import families, solids
from corrmat.data.clouds import CloudSet, read_hdf5
from corrmat.errors import CorrmatError

SIZE = {"train": 4000, "test": 800}
POINTS = 2048
NAMES = tuple(families.FAMILIES)
SMALL = 200  # so few shapes are made on the spot instead of building and caching all


def load(split: str, count: int | None = None) -> CloudSet:
    """The first `count` shapes of a split, "train" or "test"; all of them by default.

    The whole set is made once (about a minute on two cores) and kept in `cache_folder()`.

    Raises:
        CorrmatError: more shapes are asked for than there are.
    """
    size = SIZE[split]
    count = size if count is None else count
    if not 0 < count <= size:
        raise CorrmatError(f"the {split} split has {size} shapes, {count} were asked for")
    path = cache_folder() / f"shapes-{split}-{fingerprint()}.h5"
    if not path.is_file() and count <= SMALL:
        return _collect(map(_task, _tasks(split, count)))
    if not _intact(path):
        build(path, split)
    return read_hdf5(path, NAMES).take(slice(count))


def cache_folder() -> Path:
    """`$CORRMAT_CACHE`, or the user's cache folder."""
    return Path(os.environ.get("CORRMAT_CACHE") or platformdirs.user_cache_dir("corrmat"))


def fingerprint() -> str:
    """Version of the data set: a digest of the code that makes it."""
    sources = (Path(str(module.__file__)) for module in (families, solids))
    text = b"".join(path.read_bytes() for path in (*sources, Path(__file__)))
    return hashlib.sha256(text.replace(b"\r\n", b"\n")).hexdigest()[:12]


def build(path: Path, split: str) -> None:
    """Make all shapes of a split on all cores and write them to `path` at one stroke."""
    size = SIZE[split]
    # Workers import no torch and inherit no threads, so "spawn" is safe and cheap here.
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        made = pool.map(_task, _tasks(split, size), chunksize=50)
        clouds = _collect(track(made, f"making {size} {split} shapes (once)", total=size))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        with h5py.File(partial, "w") as file:
            file["data"], file["normal"], file["label"] = (
                clouds.points,
                clouds.normals,
                clouds.labels,
            )
            file.attrs["version"] = fingerprint()
            file.attrs["sha256"] = _digest(clouds)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def make_shape(split: str, index: int) -> tuple[np.ndarray, int]:
    """One shape: (2048, 6) float32 points and unit face normals, and its label.

    Points are uniform on the surface, centred at their mean, scaled into the unit sphere.
    """
    key = np.array([tuple(SIZE).index(split), index], np.uint64)
    rng = np.random.Generator(np.random.Philox(key=key))
    label = index % len(NAMES)
    mesh = trimesh.util.concatenate(families.FAMILIES[NAMES[label]](rng))
    assert isinstance(mesh, trimesh.Trimesh)
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=rng)[:2]
    points = points - points.mean(0)
    points = points / np.linalg.norm(points, axis=1).max()
    return np.hstack([points, mesh.face_normals[faces]]).astype(np.float32), label


def _tasks(split: str, count: int) -> list[tuple[str, int]]:
    return [(split, index) for index in range(count)]


def _task(task: tuple[str, int]) -> tuple[np.ndarray, int]:
    return make_shape(*task)


def _collect(made: Iterable[tuple[np.ndarray, int]]) -> CloudSet:
    rows, labels = zip(*made, strict=True)
    return CloudSet(np.stack(rows), np.array(labels, np.int64), NAMES)


def _digest(clouds: CloudSet) -> str:
    digest = hashlib.sha256()
    for array in (clouds.rows, clouds.labels):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _intact(path: Path) -> bool:
    """Whether a cache file is there and holds what was written; a damaged one is made anew."""
    if not path.is_file():
        return False
    try:
        with h5py.File(path) as file:
            expected = file.attrs["sha256"]
        return expected == _digest(read_hdf5(path, NAMES))
    except (OSError, KeyError, CorrmatError):
        return False
