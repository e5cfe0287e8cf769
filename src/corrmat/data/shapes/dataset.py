"""The embedded data set: parametric CAD-like shapes, made on first use and cached.

Shape i of a split is a pure function of (split, i). Families take turns, so that the first n
shapes are a balanced data set of their own.
"""

from pathlib import Path

import numpy as np
import trimesh

from corrmat.data.build import build_shards
from corrmat.data.clouds import CloudSet, cache_folder, open_shards
from corrmat.data.shapes import families
from corrmat.errors import CorrmatError

VERSION = 1  # raise it when a shape changes; the digests of test pairs in the recipes tell
SIZE = {"train": 4000, "test": 800}
POINTS = 2048
NAMES = tuple(families.FAMILIES)
SMALL = 200  # up to this many shapes are made on the spot instead of building the cache


def load(split: str, count: int | None = None, root: Path | None = None) -> CloudSet:
    """Load the first `count` shapes of a split, all by default.

    The whole split is made once, in about a minute on two cores, and kept in the cache folder.

    Args:
        split: "train" or "test".
        count: number of shapes; None for all.
        root: not used; every data set of the registry has this argument.

    Raises:
        CorrmatError: more shapes are asked for than there are.
    """
    size = SIZE[split]
    count = size if count is None else count
    if not 0 < count <= size:
        raise CorrmatError(f"the {split} split has {size} shapes, {count} were asked for")
    folder = cache_folder() / f"shapes-v{VERSION}-{split}"
    clouds = open_shards(folder)
    if clouds is None and count <= SMALL:
        shapes = [make_shape((split, index)) for index in range(count)]
        rows, labels = zip(*shapes, strict=True)
        return CloudSet(np.stack(rows), np.array(labels, np.int64), NAMES)
    if clouds is None:
        tasks = [(split, index) for index in range(size)]
        build_shards(folder, NAMES, tasks, make_shape, f"making {size} {split} shapes (once)")
        clouds = open_shards(folder)
    assert clouds is not None
    return clouds.select(slice(count))


def make_shape(task: tuple[str, int]) -> tuple[np.ndarray, int]:
    """Make one shape.

    Points are uniform on the surface, centred at their mean, scaled into the unit sphere.

    Args:
        task: split and index.

    Returns:
        (2048, 6) float32 points and unit face normals, and the label.
    """
    split, index = task
    key = np.array([tuple(SIZE).index(split), index], np.uint64)
    rng = np.random.Generator(np.random.Philox(key=key))
    label = index % len(NAMES)
    mesh = trimesh.util.concatenate(families.FAMILIES[NAMES[label]](rng))
    assert isinstance(mesh, trimesh.Trimesh)
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=rng)[:2]
    points = points - points.mean(0)
    points = points / np.linalg.norm(points, axis=1).max()
    return np.hstack([points, mesh.face_normals[faces]]).astype(np.float32), label
