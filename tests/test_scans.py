"""Files of anybody's clouds: every format gives the same points, a damaged file one clear line."""

import io
import os
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from PIL import Image
from plyfile import PlyData, PlyElement, PlyHeaderParseError

from corrmat.data import scans
from corrmat.data.scans import CLOUDS, MESHES, read_scan, write_moved, write_ply
from corrmat.errors import CorrmatError

POINTS = np.random.default_rng(0).normal(size=(40, 3)) * 100


def write(path, points=POINTS):
    kind = path.suffix
    if kind == ".ply":
        write_ply(path, points)
    elif kind == ".pcd":
        from pypcd4 import PointCloud

        PointCloud.from_xyz_points(points.astype(np.float32)).save(path)
    elif kind == ".npy":
        np.save(path, points)
    elif kind == ".bin":
        np.pad(points, ((0, 0), (0, 1))).astype(np.float32).tofile(path)
    elif kind == ".npz":
        np.savez(path, cloud=points, label=np.arange(3))
    else:
        separator = "," if kind == ".csv" else " "
        lines = [separator.join(repr(float(value)) for value in row) for row in points]
        path.write_text("\n".join(["# a comment", *lines]) + "\n")
    return path


@pytest.mark.parametrize("kind", [".ply", *CLOUDS])
def test_every_cloud_format_gives_its_points(tmp_path, kind):
    scan = read_scan(write(tmp_path / f"cloud{kind}"))
    assert scan.dtype == np.float64
    assert np.abs(scan - POINTS).max() < (1e-4 if kind in (".pcd", ".bin") else 1e-12)


@pytest.mark.parametrize("kind", MESHES)
def test_a_mesh_is_sampled_evenly_and_by_seed(tmp_path, kind):
    path = tmp_path / f"box{kind}"
    actual = trimesh.creation.box((2, 2, 2)).export(file_type=kind[1:])
    for name, content in actual.items() if kind == ".gltf" else [(path.name, actual)]:
        name = path.name if name == "model.gltf" else name
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    scan = read_scan(path, seed=1)
    assert scan.shape == (20_000, 3)
    assert np.allclose(np.abs(scan).max(1), 1, atol=1e-6)  # all on the surface
    assert np.abs(scan.mean(0)).max() < 0.03
    assert (read_scan(path, seed=1) == scan).all()
    assert (read_scan(path, seed=2) != scan).any()


def test_parts_of_a_scene_are_merged(tmp_path):
    boxes = [trimesh.creation.box((1, 1, 1)).apply_translation((x, 0, 0)) for x in (0, 10)]
    trimesh.Scene(boxes).export(tmp_path / "scene.glb")
    scan = read_scan(tmp_path / "scene.glb")
    assert abs((scan[:, 0] > 5).mean() - 0.5) < 0.02


def test_an_xyz_file_may_name_elements_below_a_comment(tmp_path):
    (tmp_path / "a.xyz").write_text("2\nwater, in 1e-10 m\nO 0 1 2\nH 3 4 5 0.1\n")
    np.testing.assert_array_equal(read_scan(tmp_path / "a.xyz"), [[0, 1, 2], [3, 4, 5]])
    (tmp_path / "b.xyz").write_text("2\n\nO 0 1 2\nH 3 4 5\n")
    np.testing.assert_array_equal(read_scan(tmp_path / "b.xyz"), [[0, 1, 2], [3, 4, 5]])
    (tmp_path / "c.xyz").write_text("2\nz y x\n0 1 2\n3 4 5\n")
    np.testing.assert_array_equal(read_scan(tmp_path / "c.xyz"), [[2, 1, 0], [5, 4, 3]])


def test_a_sweep_of_kitti_is_read(tmp_path):
    rows = np.arange(12, dtype=np.float32).reshape(3, 4)
    (tmp_path / "0.bin").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(read_scan(tmp_path / "0.bin"), rows[:, :3])
    (tmp_path / "0.bin").write_bytes(rows.tobytes()[:-4])
    with pytest.raises(CorrmatError, match="rows of four float32"):
        read_scan(tmp_path / "0.bin")


def test_an_xyz_file_may_begin_with_its_count_and_carry_more_columns(tmp_path):
    path = tmp_path / "cloud.xyz"
    path.write_text("2\n1 2 3 255 0 0\n4 5 6 0 255 0\n")
    assert read_scan(path).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_table_may_begin_with_the_names_of_its_columns(tmp_path):
    path = tmp_path / "cloud.csv"
    path.write_text("x,y,z\n1,2,3\n4,5,6\n", "utf-8-sig")  # as spreadsheets write it
    assert read_scan(path).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_an_empty_cell_of_a_table_keeps_its_place(tmp_path):
    (tmp_path / "table.csv").write_text("label,x,y,z,i\n,4,5,6,9\n,1,2,3,\n,0,0,1,\n")
    assert read_scan(tmp_path / "table.csv").tolist() == [[4, 5, 6], [1, 2, 3], [0, 0, 1]]


@pytest.mark.parametrize(
    "header",
    [
        "id,x,y,z",
        "label x y z",
        '"n","X","Y","Z"',
        "//N X Y Z",
        "// N X Y Z",
        "n;x;y;z",
        "# id x y z",
        "# id,x,y,z",
        "#n;x;y;z",
    ],
)
def test_the_names_of_columns_say_which_are_the_coordinates(tmp_path, header):
    separator = next((mark for mark in ",;" if mark in header), " ")
    rows = [separator.join(["7", *map(repr, map(float, row))]) for row in POINTS]
    (tmp_path / "table.csv").write_text("\n".join([header, *rows]))
    assert np.abs(read_scan(tmp_path / "table.csv") - POINTS).max() < 1e-12


def test_a_header_and_rows_of_other_lengths_are_refused(tmp_path):
    """Decimal commas, or names that have slipped: whatever is meant, it cannot be guessed."""
    (tmp_path / "table.csv").write_text("x,y,z\n1,5,2,5,3,5\n4,5,1,5,2,5\n")
    with pytest.raises(CorrmatError, match="names 3 columns, the first row has 6"):
        read_scan(tmp_path / "table.csv")
    (tmp_path / "table.csv").write_text("x,y,z\n1,2,3,\n4,5,6,\n")  # as some programs end rows
    assert read_scan(tmp_path / "table.csv").tolist() == [[1, 2, 3], [4, 5, 6]]


def test_fewer_points_than_the_first_line_says_are_a_file_cut_short(tmp_path):
    rows = [" ".join(map(str, row)) for row in POINTS]
    (tmp_path / "scan.pts").write_text("\n".join([str(len(rows)), *rows]))
    assert len(read_scan(tmp_path / "scan.pts")) == len(POINTS)
    (tmp_path / "scan.pts").write_text("\n".join([str(len(rows)), *rows[:-3]]))
    with pytest.raises(CorrmatError, match=f"cut short: {len(rows) - 3} of {len(rows)} points"):
        read_scan(tmp_path / "scan.pts")


def test_an_array_that_lies_on_its_side_is_not_three_points(tmp_path):
    np.save(tmp_path / "side.npy", POINTS.T)
    with pytest.raises(CorrmatError, match="transpose it"):
        read_scan(tmp_path / "side.npy")


def test_three_points_with_normals_are_three_points(tmp_path):
    np.save(tmp_path / "three.npy", np.hstack([POINTS[:3], POINTS[:3]]))
    assert read_scan(tmp_path / "three.npy").tolist() == POINTS[:3].tolist()


def test_an_organised_cloud_and_a_table_of_fields_are_points(tmp_path):
    np.save(tmp_path / "organised.npy", POINTS[:20].reshape(4, 5, 3))
    assert read_scan(tmp_path / "organised.npy").tolist() == POINTS[:20].tolist()
    table = np.zeros(20, [("i", "u1"), ("z", "f8"), ("y", "f8"), ("x", "f8")])
    table["x"], table["y"], table["z"] = POINTS[:20].T
    np.save(tmp_path / "table.npy", table)
    assert read_scan(tmp_path / "table.npy").tolist() == POINTS[:20].tolist()


def test_a_pipe_is_not_a_missing_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.xyz")
    with pytest.raises(CorrmatError, match="a pipe or device, not a file"):
        read_scan(tmp_path / "pipe.xyz")


@pytest.mark.parametrize("kind", [".ply", *CLOUDS])
def test_pixels_without_a_measurement_are_left_out(tmp_path, kind):
    holes = np.insert(POINTS, (0, 7, 40), np.nan, axis=0)
    scan = read_scan(write(tmp_path / f"depth{kind}", holes))
    np.testing.assert_allclose(scan, POINTS, rtol=1e-6)


def test_a_comment_may_be_in_any_encoding(tmp_path):
    (tmp_path / "latin.xyz").write_bytes("# Körper\n1 2 3\n4 5 6\n".encode("latin-1"))
    assert read_scan(tmp_path / "latin.xyz").tolist() == [[1, 2, 3], [4, 5, 6]]
    write_ply(tmp_path / "latin.ply", POINTS)
    content = (tmp_path / "latin.ply").read_bytes()
    for encoding in ("latin-1", "utf-8"):
        comment = "ply\ncomment Körper".encode(encoding)
        (tmp_path / "latin.ply").write_bytes(content.replace(b"ply", comment, 1))
        assert (read_scan(tmp_path / "latin.ply") == POINTS).all()


def test_a_binary_ply_is_mapped_into_memory(tmp_path):
    """Row by row plyfile takes ten seconds for a million points."""
    write_ply(tmp_path / "large.ply", POINTS)
    vertices = scans._ply_content(tmp_path / "large.ply")["vertex"]
    assert isinstance(vertices.data, np.memmap)


def test_points_of_a_ply_with_edges_are_points(tmp_path):
    write_ply(tmp_path / "lines.ply", POINTS)
    header, _, body = (tmp_path / "lines.ply").read_bytes().partition(b"end_header\n")
    edges = b"element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    (tmp_path / "lines.ply").write_bytes(header + edges + body + np.array([0, 1], "<i4").tobytes())
    assert (read_scan(tmp_path / "lines.ply") == POINTS).all()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("quoted.csv", 'id,x,y,z,name\n1,1,2,3,"a, b"\n2,4,5,6,"c"\n'),
        ("labels.xyz", "2\nwater\nC1 1 2 3\nH2 4 5 6\n"),
    ],
)
def test_words_beside_the_coordinates_are_skipped(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    np.testing.assert_array_equal(read_scan(tmp_path / name), [[1, 2, 3], [4, 5, 6]])


def test_textures_are_not_read(tmp_path, monkeypatch):
    """Those of a photograph take more memory than its mesh."""
    box = trimesh.creation.box((2, 2, 2))
    uv = np.zeros((len(box.vertices), 2))
    box.visual = trimesh.visual.TextureVisuals(uv, image=Image.new("RGB", (4, 4)))
    box.export(tmp_path / "box.glb")
    opened = []
    monkeypatch.setattr(Image, "open", opened.append)
    assert np.allclose(np.abs(read_scan(tmp_path / "box.glb")).max(1), 1, atol=1e-6)
    assert opened == []


def test_a_ply_keeps_millimetres_at_ten_thousand_kilometres(tmp_path):
    far = POINTS + 1e7
    write_ply(tmp_path / "far.ply", far)
    assert (read_scan(tmp_path / "far.ply") == far).all()


def _bytes_of(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.ply", None, "no such file"),
        ("cloud.docx", b"x", "format .docx unknown"),
        ("cloud", b"x", "without a suffix"),
        ("empty.ply", b"", "is empty"),
        ("empty.xyz", b"\n\n", "holds no points"),
        ("words.txt", b"one two three\n", "the header names one, two, three"),
        ("words.xyz", b"1 2 3\none two 3\n", "cannot be read as XYZ"),
        ("header.csv", b"x,y,z\n", "holds no points"),
        ("german.csv", b"x;y;z\n1,5;2,5;3,5\n", "need a decimal point"),
        ("holz.csv", b"x;y;z;class\n1,5;2,5;3,5;Holz\n", "need a decimal point"),
        ("complex.npy", _bytes_of(np.ones((9, 3), complex)), "complex128"),
        ("side.npy", _bytes_of(np.ones((4, 40))), "transpose it"),
        ("depth.npy", _bytes_of(np.ones((48, 64))), "a depth image has to be turned into points"),
        ("cut.csv", b"x,y,z\n1,2,3\n4", "row 2 holds 1 number"),
        ("foot.csv", b"1,2,3\n4,5,6\n2 points exported", "row 3 holds 1 number"),
        ("german.txt", b"1,5 2,5 3,5\n2,0 1,0 0,5\n", "need a decimal point"),
        ("short.txt", b"1 2 3\n4 5\n", "row 2 holds 2 numbers"),
        ("words.csv", b"x,y\nz,u\n", "the header names x, y, but not x, y and z"),
        ("names.csv", b"id,px,py,pz\n7,1,2,3\n", "the header names id, px, py, pz"),
        ("short.csv", b"x,y,z\n1,2\n", "row 1 holds 2 numbers"),
        ("hole.csv", b"x,y,z,i\n4,,6,9\n", "a coordinate of row 1 is empty"),
        ("noise.npy", b"\x93NUMPY nonsense", "cannot be read as NPY"),
        ("noise.stl", b"solid nothing", "holds no points, or is cut short or no STL"),
        ("noise.pcd", b"VERSION .7\n", "cannot be read as PCD"),
        ("noise.glb", b"glTF....", "cannot be read as GLB"),
    ],
)
def test_bad_files_are_one_clear_error(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CorrmatError, match=message) as caught:
        read_scan(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [".ply", ".pcd", ".npy", ".npz", ".glb"])
def test_a_file_cut_short_is_an_error_not_fewer_points(tmp_path, kind):
    path = tmp_path / f"whole{kind}"
    if kind == ".glb":
        trimesh.creation.box().export(path)
    else:
        write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.7 * len(whole))])
    with pytest.raises(CorrmatError, match=f"cannot be read as {kind[1:].upper()}"):
        read_scan(path)


@pytest.mark.parametrize(
    ("version", "fields", "count"),
    [(".5", "FIELDS", ""), (".5", "COLUMNS", "COUNT 1 1 1\n"), ("0.6", "FIELDS", "COUNT 1 1 1\n")],
)
def test_a_pcd_of_an_older_version_is_read(tmp_path, version, fields, count):
    """PCL's own bunny is of version .5, which has no viewpoint."""
    header = f"# .PCD v{version}\nVERSION {version}\n{fields} x y z\nSIZE 4 4 4\nTYPE F F F\n"
    rows = "\n".join(map("{} {} {}".format, *POINTS.T))
    header += f"{count}WIDTH {len(POINTS)}\nHEIGHT 1\nPOINTS {len(POINTS)}\nDATA ascii\n"
    (tmp_path / "old.pcd").write_text(header + rows)
    np.testing.assert_allclose(read_scan(tmp_path / "old.pcd"), POINTS, atol=1e-5)


def test_a_pcd_of_text_cut_short_is_an_error(tmp_path):
    fields = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1"
    size = "WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA ascii"
    rows = "0 0 0\n1 0 0\n0 1 0\n"
    (tmp_path / "cut.pcd").write_text(f"VERSION .7\n{fields}\n{size}\n{rows}")
    with pytest.raises(CorrmatError, match="is cut short: 3 of 4 points"):
        read_scan(tmp_path / "cut.pcd")


def test_an_array_of_words_is_not_points(tmp_path):
    np.save(tmp_path / "words.npy", np.full((4, 3), "abc"))
    with pytest.raises(CorrmatError, match="cannot be read as NPY"):
        read_scan(tmp_path / "words.npy")


def test_arrays_that_could_run_code_are_refused(tmp_path):
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(CorrmatError, match="cannot be read as NPY"):
        read_scan(tmp_path / "objects.npy")


def test_an_npz_with_two_clouds_is_ambiguous(tmp_path):
    np.savez(tmp_path / "two.npz", a=POINTS, b=POINTS)
    with pytest.raises(CorrmatError, match="2 arrays of points"):
        read_scan(tmp_path / "two.npz")


def test_an_npz_with_points_and_normals_has_points(tmp_path):
    np.savez(tmp_path / "cloud.npz", normals=POINTS[::-1], points=POINTS)
    assert (read_scan(tmp_path / "cloud.npz") == POINTS).all()


def test_an_npz_names_its_points_in_any_case(tmp_path):
    np.savez(tmp_path / "cloud.npz", Normals=POINTS[::-1], Points=POINTS)
    assert (read_scan(tmp_path / "cloud.npz") == POINTS).all()


def test_quoted_numbers_are_numbers(tmp_path):
    (tmp_path / "table.csv").write_text('"a","x","y","z"\n"7","1.5","2","3"\n"7","4","5","6"\n')
    assert read_scan(tmp_path / "table.csv").tolist() == [[1.5, 2, 3], [4, 5, 6]]
    (tmp_path / "bare.csv").write_text('"1.5","2","3"\n"4","5","6"\n')
    assert read_scan(tmp_path / "bare.csv").tolist() == [[1.5, 2, 3], [4, 5, 6]]


def test_a_ply_may_name_its_axes_in_capitals(tmp_path):
    write_ply(tmp_path / "cloud.ply", POINTS)
    content = (tmp_path / "cloud.ply").read_bytes()
    for axis in (b"x", b"y", b"z"):
        content = content.replace(b"double " + axis, b"double " + axis.upper(), 1)
    (tmp_path / "cloud.ply").write_bytes(content)
    assert (read_scan(tmp_path / "cloud.ply") == POINTS).all()


TURN = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])
TURN[:3, 3] = 5e6, -1, 2
COLOURS = "red", "green", "blue"


@pytest.mark.parametrize("normal", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")])
def test_a_moved_ply_keeps_all_that_it_holds(normal, tmp_path):
    vertices = np.zeros(40, [*((n, "f4") for n in ("x", "y", "z", *normal)), ("red", "u1")])
    for name, column in zip("xyz", POINTS.T, strict=True):
        vertices[name] = column
    vertices[normal[2]], vertices["red"] = 1, np.arange(40)
    faces = np.array([([0, 1, 2],), ([3, 4, 5, 6],)], [("vertex_indices", "O")])
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=True, comments=["TextureFile a.png"]).write(tmp_path / "scan.ply")

    write_moved(tmp_path / "moved.ply", tmp_path / "scan.ply", TURN)
    moved = PlyData.read(tmp_path / "moved.ply")
    points = np.stack([moved["vertex"][axis] for axis in "xyz"], 1)
    expected = POINTS.astype(np.float32) @ TURN[:3, :3].T + TURN[:3, 3]
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, expected, rtol=1e-13)
    normals = np.stack([moved["vertex"][name] for name in normal], 1)
    np.testing.assert_allclose(normals, np.tile(TURN[:3, 2], (40, 1)), rtol=1e-12)
    assert (moved["vertex"]["red"] == np.arange(40)).all()
    assert [row.tolist() for row in moved["face"]["vertex_indices"]] == [[0, 1, 2], [3, 4, 5, 6]]
    assert moved.comments == ["TextureFile a.png"]


def test_a_moved_pcd_keeps_its_colours(tmp_path):
    from pypcd4 import PointCloud

    points, colours = POINTS.astype(np.float32), np.arange(120, dtype=np.uint8).reshape(40, 3)
    packed = PointCloud.encode_rgb(colours).reshape(-1, 1)
    points[3] = np.nan  # a pixel without a measurement
    PointCloud.from_xyzrgb_points(np.hstack([points, packed])).save(tmp_path / "scan.pcd")
    assert write_moved(tmp_path / "moved.ply", tmp_path / "scan.pcd", TURN) == (
        "points and colours alone"
    )
    vertices = PlyData.read(tmp_path / "moved.ply")["vertex"]
    moved, rgb = (np.stack([vertices[n] for n in names], 1) for names in ("xyz", COLOURS))
    kept = np.arange(40) != 3
    np.testing.assert_allclose(moved, points[kept] @ TURN[:3, :3].T + TURN[:3, 3], rtol=1e-12)
    np.testing.assert_array_equal(rgb, colours[kept])


def test_a_ply_that_plyfile_refuses_is_moved_as_its_mesh(tmp_path, monkeypatch):
    trimesh.creation.box((2, 4, 6)).export(tmp_path / "box.ply", encoding="ascii")
    text = (tmp_path / "box.ply").read_text()
    (tmp_path / "box.ply").write_text(text.replace("ascii 1.0", "ascii 1.0  ", 1))
    for refuses in (False, True):
        with monkeypatch.context() as patch:
            if refuses:
                error = PlyHeaderParseError("a header that only others read")
                patch.setattr(PlyData, "read", Mock(side_effect=error))
            write_moved(tmp_path / "moved.ply", tmp_path / "box.ply", TURN)
        assert trimesh.load(tmp_path / "moved.ply").volume == pytest.approx(48)


def test_a_moved_mesh_keeps_its_faces_and_a_cloud_its_points(tmp_path):
    box = trimesh.creation.box((2, 4, 6))
    box.export(tmp_path / "box.stl")
    write_moved(tmp_path / "box.ply", tmp_path / "box.stl", TURN)
    moved = trimesh.load(tmp_path / "box.ply")
    assert len(moved.faces) == 12
    assert moved.volume == pytest.approx(48)
    write_moved(tmp_path / "cloud.ply", write(tmp_path / "cloud.xyz"), TURN)
    expected = POINTS @ TURN[:3, :3].T + TURN[:3, 3]
    np.testing.assert_allclose(read_scan(tmp_path / "cloud.ply"), expected, rtol=1e-15)


def test_writing_into_no_folder_says_so(tmp_path):
    with pytest.raises(CorrmatError, match="no folder"):
        write_ply(tmp_path / "none" / "cloud.ply", POINTS)
