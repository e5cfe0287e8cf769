"""Pairs of fragments of procedural rooms, as indoor scans come: in metres, overlapping in part."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from corrmat.data.pairs import STREAM, Split
from corrmat.data.shapes.families import FAMILIES
from corrmat.data.shapes.solids import box, merged

NOISE_M = 0.005  # standard deviation of every coordinate
OVERLAP = (0.3, 0.7)  # share of the source's area that the target shows too
_WALL_M, _HEIGHT_M = 0.1, 2.5
_SAMPLES_PER_POINT = 8  # samples of the whole room for each point of a fragment
# Furniture: longest side in metres.
_SIZES = {
    "bathtub": (1.5, 1.8), "bed": (1.9, 2.2), "bench": (1.0, 1.6), "bookshelf": (1.5, 2.2),
    "chair": (0.8, 1.1), "desk": (1.1, 1.7), "dresser": (0.8, 1.3), "flower_pot": (0.3, 0.7),
    "lamp": (0.5, 1.7), "night_stand": (0.4, 0.7), "piano": (1.4, 1.7), "plant": (0.5, 1.5),
    "sofa": (1.6, 2.4), "stool": (0.4, 0.7), "table": (0.9, 2.0), "toilet": (0.6, 0.8),
    "tv_stand": (1.0, 1.8), "wardrobe": (1.6, 2.2),
}  # fmt: skip


class RoomPair(NamedTuple):
    """Two fragments of a room and their truth."""

    source: np.ndarray  # (N, 3), metres
    target: np.ndarray  # (N, 3)
    rotation: np.ndarray  # (3, 3), takes source onto target
    translation: np.ndarray  # (3,)
    overlap: float  # share of the source that the target shows too


def make_room_pair(index: int, points: int, split: Split) -> RoomPair:
    """Make the fragments of one room: a pure function of index and split.

    Each shows what lies within a radius of a place in the room. They share no point.

    Args:
        index: of the room.
        points: of each fragment.
        split: "test", or "val" to choose settings on.
    """
    key = np.array([7, STREAM[split] << 32 | index], np.uint64)
    rng = np.random.Generator(np.random.Philox(key=key))
    room, size = _room(rng)
    samples = trimesh.sample.sample_surface(room, _SAMPLES_PER_POINT * points, seed=rng)[0]
    halves = samples[::2], samples[1::2]
    while True:  # until the fragments overlap as they should
        radius = rng.uniform(0.3, 0.5) * np.linalg.norm(size)
        places = rng.uniform(-0.5, 0.5, (2, 2)) * size
        inside = [
            np.linalg.norm(half[:, :2] - place, axis=1) < radius
            for half, place in zip(halves, places, strict=True)
        ]
        shared = np.linalg.norm(halves[0][:, :2] - places[1], axis=1) < radius
        overlap = float(shared[inside[0]].mean()) if inside[0].any() else 0.0
        if OVERLAP[0] < overlap < OVERLAP[1] and min(map(np.sum, inside)) >= points:
            break
    source, target = (
        rng.permutation(half[chosen])[:points] + NOISE_M * rng.standard_normal((points, 3))
        for half, chosen in zip(halves, inside, strict=True)
    )
    pose = Rotation.random(rng=rng).as_matrix()
    shift = rng.uniform(-2, 2, 3)
    # Each fragment lies in the frame of its own scanner.
    frame = Rotation.random(rng=rng).as_matrix()
    return RoomPair(source @ frame.T, target @ pose.T + shift, pose @ frame.T, shift, overlap)


def _room(rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return a room's mesh, its floor centred at the origin, and the floor's size (2,)."""
    x, y = size = rng.uniform([3.5, 3.0], [7.0, 6.0])
    parts = [box((x, y, _WALL_M), (0, 0, -_WALL_M / 2))]
    walls = [box((_WALL_M, y, _HEIGHT_M), (side * x / 2, 0, _HEIGHT_M / 2)) for side in (-1, 1)] + [
        box((x, _WALL_M, _HEIGHT_M), (0, side * y / 2, _HEIGHT_M / 2)) for side in (-1, 1)
    ]
    parts += [walls[i] for i in rng.permutation(4)[: rng.integers(2, 5)]]
    for name in rng.choice(list(_SIZES), rng.integers(5, 11)):
        thing = merged(FAMILIES[str(name)](rng))
        thing.apply_scale(rng.uniform(*_SIZES[str(name)]) / thing.extents.max())
        thing.apply_transform(
            trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * np.pi), (0, 0, 1))
        )
        low, high = thing.bounds
        free = np.maximum(size - (high - low)[:2], 0) / 2
        at = rng.uniform(-free, free)
        if rng.random() < 0.6:  # against a wall
            side = rng.integers(2)
            at[side] = free[side] * rng.choice([-1, 1])
        thing.apply_translation([*(at - (low + high)[:2] / 2), -low[2]])
        parts.append(thing)
    return merged(parts), size
