"""Read and write point clouds and meshes in the usual file formats.

Each reader is imported on first use: together they take longer than a registration.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from corrmat.errors import CorrmatError
from corrmat.files import replace_bytes

if TYPE_CHECKING:
    import trimesh

MESHES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
CLOUDS = (".pcd", ".xyz", ".txt", ".csv", ".npy", ".npz")
SAMPLES = 20_000  # points taken of a mesh's surface
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+").fullmatch


def read_scan(path: str | Path, seed: int = 0) -> np.ndarray:
    """Read the points of a file, (N, 3) float64 in its units; a mesh is sampled uniformly.

    Parts of a scene are merged; colours and everything else are ignored.

    Args:
        path: PLY, OBJ, STL, OFF, GLB or GLTF; PCD, XYZ, TXT, CSV, NPY or NPZ.
        seed: of the sampling of a mesh.

    Raises:
        CorrmatError: the file is missing, empty, of another format, or cut short.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in MESHES + CLOUDS:
        formats = ", ".join(name[1:] for name in MESHES + CLOUDS)
        raise CorrmatError(
            f"{path}: format {kind or 'without a suffix'} unknown; formats: {formats}"
        )
    if not path.is_file():
        raise CorrmatError(f"{path}: no such file")
    if not path.stat().st_size:
        raise CorrmatError(f"{path} is empty")
    reader = {".ply": _ply, ".pcd": _pcd, ".npy": _numpy, ".npz": _numpy}.get(kind)
    reader = reader or (_scene if kind in MESHES else _text)
    try:
        points = reader(path, seed)
        if points.ndim != 2 or points.shape[1] < 3:
            raise CorrmatError(f"{path} holds an array of shape {points.shape}, not points (N, 3)")
        if len(points) == 3 and points.shape[1] > 6:
            raise CorrmatError(
                f"{path} holds an array of shape {points.shape}: transpose it to (N, 3)"
            )
        points = np.ascontiguousarray(points[:, :3], np.float64)
    except CorrmatError:
        raise
    except Exception as error:  # readers of damaged files raise errors of every type
        raise _unreadable(path, error) from error
    if not len(points):
        raise CorrmatError(f"{path} holds no points")
    return points


def write_ply(path: Path, points: np.ndarray) -> None:
    """Write points (N, 3) as a binary PLY of doubles, which keep detail far from the origin.

    Raises:
        CorrmatError: there is no such folder.
    """
    if not path.parent.is_dir():
        raise CorrmatError(f"no folder {path.parent} to write {path.name} into")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        "end_header\n",
    ]
    replace_bytes(path, "\n".join(header).encode() + points.astype("<f8").tobytes())


def read_mesh(path: Path) -> "trimesh.Trimesh | None":
    """Read a mesh file as one mesh; None if it holds points without faces.

    Raises:
        CorrmatError: the file cannot be read.
    """
    try:
        return _merge_meshes(_load_parts(path))
    except Exception as error:  # readers of damaged files raise errors of every type
        raise _unreadable(path, error) from error


def _load_parts(path: Path) -> list[object]:
    """Load a file with trimesh and return the parts of its scene."""
    import trimesh

    loaded = trimesh.load(path)
    return list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]


def _merge_meshes(parts: list[object]) -> "trimesh.Trimesh | None":
    """Merge the meshes with an area among the parts of a scene; None if there is none."""
    import trimesh

    meshes = [p for p in parts if isinstance(p, trimesh.Trimesh) and len(p.faces) and p.area > 0]
    if not meshes:
        return None
    merged = trimesh.util.concatenate(meshes)
    assert isinstance(merged, trimesh.Trimesh)
    return merged


def _unreadable(path: Path, error: Exception) -> CorrmatError:
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    return CorrmatError(f"{path} cannot be read as {path.suffix[1:].upper()} ({reason})")


def _scene(path: Path, seed: int) -> np.ndarray:
    """Sample the meshes of a file, or return its points if it has no faces."""
    import trimesh

    parts = _load_parts(path)
    mesh = _merge_meshes(parts)
    if mesh is not None:
        return trimesh.sample.sample_surface(mesh, SAMPLES, seed=seed)[0]
    clouds = (trimesh.PointCloud, trimesh.Trimesh)
    points = [np.asarray(p.vertices) for p in parts if isinstance(p, clouds)]
    return np.concatenate([p.reshape(-1, 3) for p in points]) if points else np.empty((0, 3))


def _ply(path: Path, seed: int) -> np.ndarray:
    """Return the vertices of a PLY file without faces; sample one with faces as a mesh."""
    from plyfile import PlyData

    content = PlyData.read(path)
    names = [element.name for element in content.elements if element.count]
    if "vertex" not in names or len(names) > 1:
        return _scene(path, seed)
    vertices = content["vertex"]
    return np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], 1)


def _pcd(path: Path, seed: int) -> np.ndarray:
    """Read the points of a PCD file; pixels without a measurement, which are NaN, are left out."""
    from pypcd4.pypcd4 import PointCloud

    points = PointCloud.from_path(path).numpy(("x", "y", "z"))
    return points[~np.isnan(points).any(1)]


def _numpy(path: Path, seed: int) -> np.ndarray:
    """Read the array of an NPY file, or the only array of points of an NPZ file."""
    content = np.load(path, allow_pickle=False)
    if isinstance(content, np.ndarray):
        return content
    with content:
        names = [n for n in content.files if content[n].ndim == 2 and content[n].shape[1] >= 3]
        if len(names) != 1:
            raise CorrmatError(
                f"{path} holds {len(names)} arrays of points (N, 3), not one: {content.files}"
            )
        return content[names[0]]


def _text(path: Path, seed: int) -> np.ndarray:
    """Read the columns x, y and z of a text file, by its header or else the first three.

    Comments are skipped.
    """
    lines = [
        line
        for line in path.read_text("utf-8-sig").splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if lines and len(lines[-1].split()) > 1 and all(map(_DECIMAL_COMMA, lines[-1].split())):
        raise CorrmatError(f"{path}: numbers like 1,5 need a decimal point")
    rows = [_cells(line) for line in lines]
    if rows and len(rows[0]) == 1 and rows[0][0].isdigit():  # the number of points, in XYZ files
        rows = rows[1:]
    columns = [0, 1, 2]
    if len(rows) > 1 and not any(map(_is_number, rows[0])):  # a header
        names = [word.strip("\"'/").lower() for word in rows[0]]
        if not {"x", "y", "z"} <= set(names):
            raise CorrmatError(
                f"{path}: the header names {', '.join(names)}, but not x, y and z; rename them, or "
                "delete the header if the first three columns are meant"
            )
        columns = [names.index(axis) for axis in "xyz"]
        rows = rows[1:]
    for number, row in enumerate(rows, 1):
        if len(row) <= max(columns):
            count = max(columns) + 1
            raise CorrmatError(f"{path}: row {number} holds {len(row)} numbers, not {count}")
        if not all(row[c] for c in columns):
            raise CorrmatError(f"{path}: a coordinate of row {number} is empty")
    return np.array([[row[c] for c in columns] for row in rows], np.float64).reshape(-1, 3)


def _cells(line: str) -> list[str]:
    """Split a line at its commas, or else at its white space; an empty cell keeps its place."""
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def _is_number(word: str) -> bool:
    """Tell whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
