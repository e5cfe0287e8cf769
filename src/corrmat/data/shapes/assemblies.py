"""Random assemblies of solids, for training only: shapes that belong to no family.

An assembly grows part by part. Each new part is a solid of random kind and size that touches an
earlier one; some are repeated in a row or in a circle, or mirrored, as the parts of things are.
"""

from collections.abc import Callable

import numpy as np
import trimesh
from trimesh import Trimesh, transformations

from corrmat.data.shapes.solids import ball, box, disc, merged, plate, revolved, rod

Rng = np.random.Generator


def assembly(rng: Rng) -> list[Trimesh]:
    """Return the parts of a random assembly, in any unit."""
    parts = [_solid(rng)]
    for _ in range(rng.integers(1, 7)):
        part = _solid(rng)
        part.apply_scale(np.exp(rng.uniform(np.log(0.2), 0)))
        neighbor = parts[rng.integers(len(parts))]
        part.apply_translation(_surface_point(neighbor, rng) - _surface_point(part, rng))
        parts += _copies(part, rng)
    return parts


def _solid(rng: Rng) -> Trimesh:
    """Return a solid of random kind and proportions, its longest side one, turned."""
    solid = _SOLIDS[rng.integers(len(_SOLIDS))](rng)
    solid.apply_translation(-solid.bounds.mean(0))
    solid.apply_scale(1 / solid.extents.max())
    if rng.random() < 0.7:  # upright or lying, as most parts are
        axis = np.eye(4)[[*rng.permutation(3), 3]]
        axis[:3, 0] *= np.linalg.det(axis[:3, :3])
        solid.apply_transform(axis)
    else:
        solid.apply_transform(transformations.random_rotation_matrix(rng.random(3)))
    return solid


def _copies(part: Trimesh, rng: Rng) -> list[Trimesh]:
    """Return the part alone, in a row, in a circle about the z axis, or with its mirror image."""
    kind, transforms = rng.random(), [np.eye(4)]
    if kind < 0.2:
        step = rng.uniform(0.1, 0.4) * np.eye(3)[rng.integers(3)]
        transforms = [
            transformations.translation_matrix(i * step) for i in range(rng.integers(2, 5))
        ]
    elif kind < 0.35:
        count = rng.integers(2, 7)
        transforms = [
            transformations.rotation_matrix(2 * np.pi * i / count, (0, 0, 1)) for i in range(count)
        ]
    elif kind < 0.65:
        mirror = np.eye(4)
        mirror[(axis := rng.integers(2)), axis] = -1
        transforms.append(mirror)
    return [part.copy().apply_transform(transform) for transform in transforms]


def _surface_point(mesh: Trimesh, rng: Rng) -> np.ndarray:
    """Draw a point (3,) of a mesh's surface."""
    return trimesh.sample.sample_surface(mesh, 1, seed=rng)[0][0]


def _box(rng: Rng) -> Trimesh:
    return box(rng.uniform(0.1, 1, 3))


def _disc(rng: Rng) -> Trimesh:
    return disc(rng.uniform(0.2, 0.5), rng.uniform(0.03, 0.8))


def _bar(rng: Rng) -> Trimesh:
    return rod((0, 0, 0), (0, 0, 1), rng.uniform(0.02, 0.12))


def _ball(rng: Rng) -> Trimesh:
    return ball(rng.uniform(0.2, 0.5, 3))


def _plate(rng: Rng) -> Trimesh:
    """A plate whose outline is a star-shaped polygon, convex or not."""
    corners = int(rng.integers(3, 9))
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) / corners
    radius = rng.uniform(0.4, 1, (corners, 1))
    outline = radius * np.column_stack([np.cos(angle), np.sin(angle)]) * (1, rng.uniform(0.3, 1))
    return plate(list(outline), rng.uniform(0.03, 0.4))


def _lathe(rng: Rng) -> Trimesh:
    """A vase, cone, wheel or the like: a random profile, revolved."""
    height = np.linspace(0, rng.uniform(0.5, 2), int(rng.integers(3, 7)))
    radius = rng.uniform(0.1, 0.6, len(height))
    return revolved([(0, height[0]), *zip(radius, height, strict=True), (0, height[-1])])


def _shell(rng: Rng) -> Trimesh:
    """A box without a lid."""
    x, y, z = rng.uniform(0.3, 1, 3)
    wall = 0.05
    sides = [
        box((x, y, wall)),
        *(box((wall, y, z), (s * x / 2, 0, z / 2)) for s in (-1, 1)),
        *(box((x, wall, z), (0, s * y / 2, z / 2)) for s in (-1, 1)),
    ]
    return merged(sides)


def _bent(rng: Rng) -> Trimesh:
    """A bar bent into an arc or a ring."""
    count, arc = 10, rng.uniform(0.5, 2) * np.pi
    angle = np.linspace(0, arc, count)
    path = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(0, 0.5) * angle])
    radius = rng.uniform(0.05, 0.2)
    bars = [rod(start, end, radius) for start, end in zip(path, path[1:], strict=False)]
    return merged(bars)


_SOLIDS: list[Callable[[Rng], Trimesh]] = [
    _box, _box, _plate, _plate, _disc, _bar, _ball, _lathe, _shell, _bent,
]  # fmt: skip
