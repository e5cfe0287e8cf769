"""The solids that every family of shapes is built from, each one call to trimesh."""

from collections.abc import Sequence

import numpy as np
import trimesh
from shapely.geometry import Polygon
from trimesh import Trimesh, creation

Vector = Sequence[float] | np.ndarray
SECTIONS = 16  # facets of everything round


def box(size: Vector, at: Vector = (0, 0, 0), tilt: tuple[str, float] | None = None) -> Trimesh:
    """A box of edge lengths `size` centred at `at`; tilt = (axis, degrees) about its centre."""
    mesh = creation.box(extents=size)
    if tilt is not None:
        mesh.apply_transform(_rotation(*tilt))
    return mesh.apply_translation(at)


def rod(start: Vector, end: Vector, radius: float) -> Trimesh:
    """A round bar from `start` to `end`."""
    return creation.cylinder(radius=radius, segment=np.array([start, end]), sections=SECTIONS)


def disc(radius: float, height: float, at: Vector = (0, 0, 0), axis: str = "z") -> Trimesh:
    """A cylinder centred at `at` whose axis is a coordinate axis."""
    half = height / 2 * np.eye(3)["xyz".index(axis)]
    return rod(np.subtract(at, half), np.add(at, half), radius)


def ball(radii: Vector, at: Vector = (0, 0, 0)) -> Trimesh:
    """An ellipsoid with its axes along the coordinate axes."""
    mesh = creation.icosphere(subdivisions=2)
    return mesh.apply_scale(radii).apply_translation(at)


def plate(
    outline: Sequence[Vector], depth: float, at: Vector = (0, 0, 0), facing: str = "z"
) -> Trimesh:
    """An outline in the plane, extruded by `depth` along the axis it faces.

    Facing "z" the outline's coordinates are (x, y), facing "y" they are (x, z) and facing
    "x" they are (y, z). The plate is centred on the plane.
    """
    mesh = creation.extrude_polygon(Polygon(outline), height=depth)
    mesh.apply_translation((0, 0, -depth / 2))
    columns = {"z": (0, 1, 2), "y": (0, 2, 1), "x": (2, 0, 1)}[facing]
    mesh.vertices = mesh.vertices[:, columns]
    if facing == "y":
        mesh.invert()
    return mesh.apply_translation(at)


def revolved(profile: Sequence[Vector], at: Vector = (0, 0, 0)) -> Trimesh:
    """Revolve a profile of (radius, z) points about the z axis."""
    return creation.revolve(np.asarray(profile, float), sections=SECTIONS).apply_translation(at)


def legs(
    half_x: float, half_y: float, height: float, radius: float, splay: float = 0.0
) -> list[Trimesh]:
    """Four round legs from z = 0 up to `height` at the corners (+-half_x, +-half_y)."""
    foot = 1 + splay
    return [
        rod((x * foot, y * foot, 0), (x, y, height), radius)
        for x in (-half_x, half_x)
        for y in (-half_y, half_y)
    ]


def _rotation(axis: str, degrees: float) -> np.ndarray:
    direction = np.eye(3)["xyz".index(axis)]
    return np.asarray(trimesh.transformations.rotation_matrix(np.deg2rad(degrees), direction))


def merged(parts: Sequence[Trimesh]) -> Trimesh:
    """All parts as one mesh."""
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, Trimesh)
    return mesh
