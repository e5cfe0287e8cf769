"""Read and write point clouds and meshes in the usual file formats.

Each reader is imported on first use: together they take longer than a registration.
"""

import contextlib
import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from corrmat.errors import CorrmatError
from corrmat.files import replace_bytes

if TYPE_CHECKING:
    import plyfile
    import pypcd4.pypcd4
    import trimesh

MESHES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
CLOUDS = (".pcd", ".xyz", ".txt", ".csv", ".asc", ".pts", ".npy", ".npz", ".bin")
SAMPLES = 20_000  # points taken of a mesh's surface
_POINTS = ("points", "xyz", "pos")  # usual names of an array of points beside others
_XYZ = {"x", "y", "z"}
_NORMALS = ("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")
_MOST_COLUMNS = 32  # of an array of points: x, y, z, and whatever else was measured
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+").fullmatch
_FACES = re.compile(rb"^element (face|tristrips) +[1-9]", re.MULTILINE)


def read_scan(path: str | Path, seed: int = 0) -> np.ndarray:
    """Read the points of a file, (N, 3) float64 in its units; a mesh is sampled uniformly.

    See `read_shape`.

    Args:
        path: PLY, OBJ, STL, OFF, GLB or GLTF; PCD, XYZ, TXT, CSV, ASC, PTS, NPY, NPZ or BIN.
        seed: of the sampling of a mesh.

    Raises:
        CorrmatError: the file is missing, empty, of another format, or cut short.
    """
    shape = read_shape(Path(path))
    if isinstance(shape, np.ndarray):
        return shape
    import trimesh

    return trimesh.sample.sample_surface(shape, SAMPLES, seed=seed)[0]


def read_shape(path: Path) -> "np.ndarray | trimesh.Trimesh":
    """Read a mesh, or the points (N, 3) float64 of a file without faces.

    The meshes of a scene are merged; colours and everything else are ignored. Points with a NaN,
    pixels without a measurement, are left out.

    Raises:
        CorrmatError: see `read_scan`.
    """
    kind = path.suffix.lower()
    if path.is_dir():
        raise CorrmatError(f"{path} is a folder, not a file of points")
    if kind not in MESHES + CLOUDS:
        formats = ", ".join(name[1:] for name in MESHES + CLOUDS)
        raise CorrmatError(
            f"{path}: format {kind or 'without a suffix'} unknown; formats: {formats}"
        )
    if not path.is_file():
        is_other = path.exists()
        raise CorrmatError(
            f"{path}: {'a pipe or device, not a file' if is_other else 'no such file'}"
        )
    if not path.stat().st_size:
        raise CorrmatError(f"{path} is empty")
    readers = {".ply": _ply, ".pcd": _pcd, ".npy": _numpy, ".npz": _numpy, ".bin": _kitti}
    reader = readers.get(kind)
    reader = reader or (_scene if kind in MESHES else _text)
    try:
        points = reader(path)
        if not isinstance(points, np.ndarray):
            return points
        if points.ndim == 3 and points.shape[2] == 3:  # an organised cloud, rows of pixels
            points = points.reshape(-1, 3)
        if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind == "c":
            raise CorrmatError(
                f"{path} holds an array of {points.dtype} of shape {points.shape}, not points "
                "(N, 3)"
            )
        if len(points) <= 6 < points.shape[1]:
            raise CorrmatError(
                f"{path} holds an array of shape {points.shape}: transpose it to (N, 3)"
            )
        if points.shape[1] > _MOST_COLUMNS:
            raise CorrmatError(
                f"{path} holds an array of shape {points.shape}, not points (N, 3): a depth image "
                "has to be turned into points first"
            )
        points = np.ascontiguousarray(points[:, :3], np.float64)
    except CorrmatError:
        raise
    except Exception as error:  # readers of damaged files raise errors of every type
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise CorrmatError(f"{path} cannot be read as {kind[1:].upper()} ({reason})") from error
    points = points[~np.isnan(points).any(1)]
    if not len(points):
        damaged = f", or is cut short or no {kind[1:].upper()}" if reader is _scene else ""
        raise CorrmatError(f"{path} holds no points{damaged}")
    return points


def write_moved(path: Path, scan: Path, transform: np.ndarray) -> str:
    """Write a scan, moved by a rigid transform, as a binary PLY with coordinates in doubles.

    A PLY file keeps its faces, its colours and whatever else it holds; its normals turn with it.
    Another mesh keeps its vertices and faces, another cloud its points, a PCD file its colours too.

    Args:
        path: to write.
        scan: the file to move, as `read_scan` takes it.
        transform: (4, 4) float64.

    Returns:
        What was written, for people: "with all that the PLY holds", "points alone" and the like.

    Raises:
        CorrmatError: there is no folder to write into, or see `read_scan`.
    """
    if scan.suffix.lower() == ".ply":
        import plyfile

        with contextlib.suppress(plyfile.PlyParseError):  # a mesh that trimesh reads all the same
            content = _ply_content(scan)
            _move_vertices(content["vertex"], transform)
            content.text, content.byte_order = False, "<"
            written = io.BytesIO()
            content.write(written)
            _replace(path, written.getbuffer())
            return "with all that the PLY holds"
    shape = read_shape(scan)
    points, faces = (
        (shape, None) if isinstance(shape, np.ndarray) else (shape.vertices, shape.faces)
    )
    colours = _pcd_colours(scan) if scan.suffix.lower() == ".pcd" else None
    write_ply(path, points @ transform[:3, :3].T + transform[:3, 3], faces, colours)
    if faces is not None:
        return "vertices and faces alone"
    return "points alone" if colours is None else "points and colours alone"


def _move_vertices(vertices: "plyfile.PlyElement", transform: np.ndarray) -> None:
    """Move the vertices of a PLY file and turn their normals; both become doubles."""
    rotation, translation = transform[:3, :3], transform[:3, 3]
    for names, shift in (("xyz", translation), *((names, 0.0) for names in _NORMALS)):
        if fields := _fields(vertices, names):
            moved = _stack(vertices, fields) @ rotation.T + shift
            for field in fields:
                vertices.ply_property(field).val_dtype = "f8"
            vertices.data = vertices.data.astype([(p.name, p.dtype()) for p in vertices.properties])
            for field, column in zip(fields, moved.T, strict=True):
                vertices[field] = column


def write_ply(
    path: Path,
    points: np.ndarray,
    faces: np.ndarray | None = None,
    colours: np.ndarray | None = None,
) -> None:
    """Write points (N, 3) as a binary PLY of doubles, which keep detail far from the origin.

    Args:
        path: to write.
        points: (N, 3).
        faces: (F, 3) rows of points, if they are the vertices of a mesh.
        colours: (N, 3) uint8, red, green and blue.

    Raises:
        CorrmatError: there is no such folder.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
    ]
    vertices = np.empty(
        len(points), [("xyz", "<f8", 3), ("rgb", "u1", 0 if colours is None else 3)]
    )
    vertices["xyz"] = points
    if colours is not None:
        header += [f"property uchar {name}" for name in ("red", "green", "blue")]
        vertices["rgb"] = colours
    body = vertices.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("corners", "u1"), ("rows", "<i4", 3)])
        triangles["corners"], triangles["rows"] = 3, faces
        body += triangles.tobytes()
    _replace(path, "\n".join([*header, "end_header\n"]).encode() + body)


def _replace(path: Path, content: bytes | memoryview) -> None:
    """Write a file into a folder that exists."""
    if not path.parent.is_dir():
        raise CorrmatError(f"no folder {path.parent} to write {path.name} into")
    replace_bytes(path, content)


def _scene(path: Path) -> "np.ndarray | trimesh.Trimesh":
    """Merge the meshes of a file that have an area, or return its points if there is none."""
    import trimesh

    loaded = trimesh.load(path, skip_materials=True)
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    meshes = [
        trimesh.Trimesh(part.vertices, part.faces, process=False)  # without colours and textures
        for part in parts
        if isinstance(part, trimesh.Trimesh) and len(part.faces) and part.area > 0
    ]
    if meshes:
        merged = trimesh.util.concatenate(meshes)
        assert isinstance(merged, trimesh.Trimesh)
        return merged
    clouds = (trimesh.PointCloud, trimesh.Trimesh)
    points = [np.asarray(part.vertices) for part in parts if isinstance(part, clouds)]
    return np.concatenate([p.reshape(-1, 3) for p in points]) if points else np.empty((0, 3))


def _ply(path: Path) -> "np.ndarray | trimesh.Trimesh":
    """Return the vertices of a PLY file without faces; read one with faces as a mesh."""
    with path.open("rb") as file:
        header = _header(file, b"end_header")
    if _FACES.search(header):
        return _scene(path)
    vertices = _ply_content(path)["vertex"]
    fields = _fields(vertices, "xyz")
    if not fields:
        raise CorrmatError(f"{path}: its vertices have no x, y and z")
    return _stack(vertices, fields)


def _ply_content(path: Path) -> "plyfile.PlyData":
    """Read a PLY file; its header may have comments in any encoding, and blanks at line ends.

    plyfile maps a binary file into memory, but goes through anything else row by row.
    """
    import plyfile

    with path.open("rb") as file:
        header = _header(file, b"end_header")
        clean = re.sub(rb"[ \t]+\n", b"\n", header).decode("ascii", "replace")
        clean = clean.encode("ascii", "replace")
        if clean == header:
            return plyfile.PlyData.read(str(path))
        return plyfile.PlyData.read(io.BytesIO(clean + file.read()))


def _header(file: BinaryIO, last: bytes) -> bytes:
    """Read the header of a file, up to the line that begins with `last`, which is included."""
    header = b""
    for line in file:
        header += line
        if line.startswith(last):
            break
    return header


def _fields(vertices: "plyfile.PlyElement", names: Iterable[str]) -> list[str]:
    """Find the properties of these names, in lower or upper case; none if one is missing."""
    present = {p.name.lower(): p.name for p in vertices.properties}
    return [present[name] for name in names] if present.keys() >= set(names) else []


def _stack(vertices: "plyfile.PlyElement", fields: Sequence[str]) -> np.ndarray:
    """Put three properties of the vertices side by side: (N, 3) float64."""
    return np.stack([np.asarray(vertices[field], np.float64) for field in fields], 1)


def _open_pcd(path: Path) -> "pypcd4.pypcd4.PointCloud":
    """Read a PCD file. The reader wants the header of version 0.7; older ones are rewritten."""
    from pypcd4.pypcd4 import PointCloud

    with path.open("rb") as file:
        header = _header(file, b"DATA")
        current = _as_pcd_7(header)
        if current == header:
            return PointCloud.from_path(path)
        content = io.BytesIO(current + file.read())
    return PointCloud.from_fileobj(io.BufferedReader(content))


def _as_pcd_7(header: bytes) -> bytes:
    """Bring the header of a PCD file to version 0.7: other names, and a count where it lacks."""
    header = re.sub(rb"^VERSION[ \t]+0?\.[56]\b", b"VERSION 0.7", header, flags=re.MULTILINE)
    header = re.sub(rb"^COLUMNS\b", b"FIELDS", header, flags=re.MULTILINE)
    fields = re.search(rb"^FIELDS (.*)$", header, re.MULTILINE)
    if fields and not re.search(rb"^COUNT\b", header, re.MULTILINE):
        counts = b" 1" * len(fields[1].split())
        header = header.replace(b"\nWIDTH", b"\nCOUNT" + counts + b"\nWIDTH", 1)
    return header


def _pcd(path: Path) -> np.ndarray:
    """Read the points of a PCD file."""
    cloud = _open_pcd(path)
    points = cloud.numpy(("x", "y", "z"))
    if len(points) != cloud.metadata.points:
        raise CorrmatError(f"{path} is cut short: {len(points)} of {cloud.metadata.points} points")
    return points


def _pcd_colours(path: Path) -> np.ndarray | None:
    """Read the colours (N, 3) of a PCD file's points as `read_shape` reads them; None without."""
    from pypcd4.pypcd4 import PointCloud

    cloud = _open_pcd(path)
    name = next((name for name in ("rgb", "rgba") if name in cloud.fields), None)
    if name is None:
        return None
    measured = ~np.isnan(cloud.numpy(("x", "y", "z"))).any(1)
    return PointCloud.decode_rgb(np.ascontiguousarray(cloud.pc_data[name]))[measured]


def _numpy(path: Path) -> np.ndarray:
    """Read the array of an NPY file, or that of an NPZ file which holds the points."""
    content = np.load(path, allow_pickle=False)
    if isinstance(content, np.ndarray):
        fields = content.dtype.names or ()
        is_table = _XYZ.issubset(fields)
        return np.stack([content[axis].ravel() for axis in "xyz"], 1) if is_table else content
    with content:
        names = [n for n in content.files if content[n].ndim == 2 and content[n].shape[1] >= 3]
        names = [name for name in names if name.lower() in _POINTS] or names
        if len(names) != 1:
            raise CorrmatError(
                f"{path} holds {len(names)} arrays of points (N, 3), not one: {content.files}"
            )
        return content[names[0]]


def _kitti(path: Path) -> np.ndarray:
    """Read a sweep as the KITTI data set has it: float32 rows of x, y, z and reflectance."""
    if path.stat().st_size % 16:
        raise CorrmatError(f"{path} does not hold rows of four float32 numbers, as KITTI's BIN do")
    return np.fromfile(path, "<f4").reshape(-1, 4)


def _text(path: Path) -> np.ndarray:
    """Read the columns x, y and z of a text file, by its header or else the first three.

    A header may be a comment, as np.savetxt writes it. Other comments are skipped. XYZ files of
    chemistry have the number of rows, a line of text, and the element before the coordinates.
    """
    lines = [line.strip() for line in path.read_text("utf-8-sig", "replace").splitlines()]
    comments = [line for line in lines if line.startswith("#")]
    lines = [line for line in lines if line and not line.startswith("#")]
    if not lines:
        return np.empty((0, 3))
    last = re.split(r"[;\s]+", lines[-1])
    if sum(_DECIMAL_COMMA(cell) is not None for cell in last) > 2:
        raise CorrmatError(f"{path}: numbers like 1,5 need a decimal point")
    count = int(lines.pop(0)) if lines[0].isdigit() else 0  # of points, in PTS and XYZ files
    if count and len(lines) == count + 1 and not _XYZ.issubset(lines[0].lower().split()):
        del lines[0]
    sample = "".join(lines[1:2] or lines)  # a row, below the header if there is one
    separator = next((mark for mark in ";," if mark in sample), None)
    columns = [0, 1, 2]
    first = _cells(lines[0].lstrip("/ "), separator) if lines else []
    if count and len(first) > 3 and not _is_number(first[0]) and all(map(_is_number, first[1:4])):
        columns = [1, 2, 3]
    elif lines and not any(map(_is_number, first)):  # a header
        names = [word.lower() for word in first]
        if not _XYZ.issubset(names):
            raise CorrmatError(
                f"{path}: the header names {', '.join(names)}, but not x, y and z; rename them, or "
                "delete the header if the first three columns are meant"
            )
        columns = [names.index(axis) for axis in "xyz"]
        del lines[0]
        cells = _cells(lines[0], separator) if lines else names
        if len(cells) != len(names) and any(cells[len(names) :]):
            raise CorrmatError(
                f"{path}: the header names {len(names)} columns, the first row has {len(cells)}"
            )
    for comment in comments:
        names = re.split(r"[;,\s]+", comment.lstrip("# ").lower())
        if _XYZ.issubset(names) and len(names) == len(first):
            columns = [names.index(axis) for axis in "xyz"]
    if not lines:
        return np.empty((0, 3))
    if len(lines) < count:
        raise CorrmatError(f"{path} is cut short: {len(lines)} of {count} points")
    try:
        return np.loadtxt(lines, np.float64, comments=None, delimiter=separator, usecols=columns,
                          ndmin=2, quotechar='"')  # fmt: skip
    except ValueError:
        _check_rows(path, lines, separator, columns)
        raise


def _check_rows(path: Path, lines: list[str], separator: str | None, columns: list[int]) -> None:
    """Say which row of a table lacks a coordinate.

    Raises:
        CorrmatError: one does.
    """
    for number, line in enumerate(lines, 1):
        row = _cells(line, separator)
        if len(row) <= max(columns):
            count = max(columns) + 1
            raise CorrmatError(f"{path}: row {number} holds {len(row)} numbers, not {count}")
        if not all(row[c] for c in columns):
            raise CorrmatError(f"{path}: a coordinate of row {number} is empty")


def _cells(line: str, separator: str | None) -> list[str]:
    """Split a line at its separator outside of quotes, or else at its white space."""
    cells = line.split() if separator is None else next(csv.reader([line], delimiter=separator))
    return [cell.strip().strip("\"'") for cell in cells]


def _is_number(word: str) -> bool:
    """Tell whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
