"""Furnished rooms, in metres. Walls and floor are solid, so their outer sides are sampled, too."""

import numpy as np
import trimesh

from corrmat.data.shapes.families import FAMILIES
from corrmat.data.shapes.solids import box, merged

_WALL_M, _HEIGHT_M = 0.1, 2.5
_MIN_SHARE = 0.4  # least share of a room's surface that a part of it has
# Furniture: longest side in metres.
_SIZES = {
    "bathtub": (1.5, 1.8), "bed": (1.9, 2.2), "bench": (1.0, 1.6), "bookshelf": (1.5, 2.2),
    "chair": (0.8, 1.1), "desk": (1.1, 1.7), "dresser": (0.8, 1.3), "flower_pot": (0.3, 0.7),
    "lamp": (0.5, 1.7), "night_stand": (0.4, 0.7), "piano": (1.4, 1.7), "plant": (0.5, 1.5),
    "sofa": (1.6, 2.4), "stool": (0.4, 0.7), "table": (0.9, 2.0), "toilet": (0.6, 0.8),
    "tv_stand": (1.0, 1.8), "wardrobe": (1.6, 2.2),
}  # fmt: skip


def part_of_room(rng: np.random.Generator, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample the part of a random room nearest to a random place: 40 to 100 % of its surface.

    Args:
        rng: of the room, the place and the points.
        points: number of points.

    Returns:
        Points (points, 3) in metres and unit face normals (points, 3).
    """
    mesh, size = room(rng)
    samples, faces = trimesh.sample.sample_surface(mesh, int(points / _MIN_SHARE), seed=rng)[:2]
    place = rng.uniform(-0.5, 0.5, 2) * size
    nearest = np.argsort(np.linalg.norm(samples[:, :2] - place, axis=1))
    part = nearest[: int(points * rng.uniform(1, 1 / _MIN_SHARE))]
    chosen = rng.permutation(part)[:points]
    return samples[chosen], mesh.face_normals[faces[chosen]]


def room(rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return a room's mesh, its floor centred at the origin, and the floor's sides (2,)."""
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
