"""The embedded data sets: CAD-like shapes of forty families, random assemblies, parts of rooms.

All are made on first use and cached. Shape i of a split is a pure function of (split, i).
Families take turns, so that the first n shapes are a balanced data set of their own.
"""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from corrmat.data.build import build_shards
from corrmat.data.clouds import CloudSet, cache_folder, open_shards
from corrmat.data.shapes import families
from corrmat.data.shapes.assemblies import assembly
from corrmat.data.shapes.rooms import part_of_room
from corrmat.data.shapes.solids import merged
from corrmat.errors import CorrmatError

VERSION = 1  # raise it when a shape changes; the digests of test pairs in the recipes tell
SIZE = {"train": 4000, "test": 800}
ASSEMBLIES = {"train": 8000, "test": 200}
ROOMS = {"train": 2000, "test": 200}
POINTS = 2048
NAMES = tuple(families.FAMILIES)
ASSEMBLY, ROOM = "assembly", "room"  # the one category of assemblies, and of rooms
SMALL = 200  # up to this many shapes are made on the spot instead of building the cache
_SEEDS = {ASSEMBLY: 1, ROOM: 2}  # families have none

MakeShape = Callable[[tuple[str, int]], tuple[np.ndarray, int]]
"""(split, index) -> (2048, 6) float32 points and unit face normals, and the label."""


def load(split: str, count: int | None = None, root: Path | None = None) -> CloudSet:
    """Load the first `count` shapes of a split of the forty families, all by default.

    The whole split is made once, in about a minute on two cores, and kept in the cache folder.

    Args:
        split: "train" or "test".
        count: number of shapes; None for all.
        root: not used; every data set of the registry has this argument.

    Raises:
        CorrmatError: more shapes are asked for than there are.
    """
    return _load("shapes", split, count, SIZE[split], NAMES, make_shape)


def load_assemblies(split: str, count: int | None = None, root: Path | None = None) -> CloudSet:
    """Load random assemblies; see `load`. Making them takes two minutes on two cores."""
    return _load("assemblies", split, count, ASSEMBLIES[split], (ASSEMBLY,), make_assembly)


def load_rooms(split: str, count: int | None = None, root: Path | None = None) -> CloudSet:
    """Load parts of furnished rooms; see `load`. Making them takes a minute on two cores."""
    return _load("rooms", split, count, ROOMS[split], (ROOM,), make_room)


def _load(
    name: str, split: str, count: int | None, size: int, names: tuple[str, ...], make: MakeShape
) -> CloudSet:
    """Load the first `count` of a split's shapes from the cache, which is made if it is not there.

    Args:
        name: of the data set.
        split: "train" or "test".
        count: number of shapes; None for all.
        size: number of shapes of the split.
        names: of the categories.
        make: makes one shape.
    """
    count = size if count is None else count
    if not 0 < count <= size:
        raise CorrmatError(f"the {split} split has {size} {name}, {count} were asked for")
    folder = cache_folder() / f"{name}-v{VERSION}-{split}"
    clouds = open_shards(folder)
    if clouds is None and count <= SMALL:
        rows, labels = zip(*(_make_once(make, split, i) for i in range(count)), strict=True)
        return CloudSet(np.stack(rows), np.array(labels, np.int64), names)
    if clouds is None:
        tasks = [(split, index) for index in range(size)]
        build_shards(folder, names, tasks, make, f"making {size} {split} {name} (once)")
        clouds = open_shards(folder)
    assert clouds is not None
    return clouds.select(slice(count))


@functools.lru_cache(2 * SMALL)
def _make_once(make: MakeShape, split: str, index: int) -> tuple[np.ndarray, int]:
    """Make a shape, or return it: all arms of a run ask for the same few."""
    return make((split, index))


def make_shape(task: tuple[str, int]) -> tuple[np.ndarray, int]:
    """Make one shape of a family."""
    split, index = task
    label = index % len(NAMES)
    key = np.array([tuple(SIZE).index(split), index], np.uint64)
    return sample_shape(NAMES[label], np.random.Generator(np.random.Philox(key=key))), label


def make_assembly(task: tuple[str, int]) -> tuple[np.ndarray, int]:
    """Make one random assembly."""
    return _make_only(ASSEMBLY, task)


def make_room(task: tuple[str, int]) -> tuple[np.ndarray, int]:
    """Make one part of a room."""
    return _make_only(ROOM, task)


def _make_only(category: str, task: tuple[str, int]) -> tuple[np.ndarray, int]:
    """Make one shape of a data set of a single category."""
    split, index = task
    key = np.array([_SEEDS[category] << 32 | tuple(SIZE).index(split), index], np.uint64)
    return sample_shape(category, np.random.Generator(np.random.Philox(key=key))), 0


def sample_shape(name: str, rng: np.random.Generator) -> np.ndarray:
    """Make a shape of random parts and sample it.

    Args:
        name: of a family, "assembly" or "room".
        rng: of the shape and its points.

    Returns:
        (2048, 6) float32: points and unit face normals. The points are uniform on the surface,
        centred at their mean, scaled into the unit sphere.
    """
    if name == ROOM:
        points, normals = part_of_room(rng, POINTS)
    else:
        mesh = merged(assembly(rng) if name == ASSEMBLY else families.FAMILIES[name](rng))
        points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=rng)[:2]
        normals = mesh.face_normals[faces]
    points = points - points.mean(0)
    points = points / np.linalg.norm(points, axis=1).max()
    return np.hstack([points, normals]).astype(np.float32)
