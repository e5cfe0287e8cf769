import h5py
import numpy as np
import pytest
from conftest import shared
from scipy.spatial.transform import Rotation

from corrmat.data import modelnet40, normals
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.errors import CorrmatError


@pytest.fixture
def root(tmp_path):
    """Two tiny files a split, in the official layout."""
    folder = tmp_path / modelnet40.FOLDER
    folder.mkdir()
    (folder / "shape_names.txt").write_text("airplane\nbathtub\n")
    rng = np.random.default_rng(0)
    for split in ("train", "test"):
        names = [f"ply_data_{split}{i}.h5" for i in range(2)]
        (folder / f"{split}_files.txt").write_text(
            "".join(f"data/{modelnet40.FOLDER}/{n}\n" for n in names)
        )
        for name in names:
            with h5py.File(folder / name, "w") as file:
                file["data"] = rng.uniform(-0.5, 0.5, (6, 64, 3)).astype(np.float32)
                file["normal"] = np.ones((6, 64, 3), np.float32) / np.sqrt(np.float32(3))
                file["label"] = (np.arange(6) % 2).astype(np.uint8)[:, None]
    return tmp_path


def module(root, **options):
    return RegistrationDataModule("modelnet40", root=str(root), num_points=16, **options)


def test_files_are_read_in_order_from_the_folder_or_its_parent(root):
    clouds = modelnet40.load("train", root=root)
    assert len(clouds) == 12
    assert clouds.names == ("airplane", "bathtub")
    again = modelnet40.load("train", root=root / modelnet40.FOLDER)
    np.testing.assert_array_equal(clouds.rows[:], again.rows[:])


def test_categories_and_counts_filter(root):
    data = module(root, categories=["bathtub"], test_shapes=4, train_shapes=5)
    assert len(data.clouds("test")) == 4
    assert set(data.clouds("test").labels) == {1}
    assert len(data.clouds("train")) + len(data.clouds("val")) == 5


def test_the_real_part_is_read_by_the_same_code():
    data = RegistrationDataModule("modelnet40", root=str(shared("data")))
    assert (len(data.clouds("train")), len(data.clouds("val")), len(data.clouds("test"))) == (
        659,
        73,
        150,
    )
    only = RegistrationDataModule("modelnet40", root=str(shared("data")), categories=["bathtub"])
    assert len(only.clouds("test")) == 50


def damage(root, kind):
    folder = root / modelnet40.FOLDER
    file = folder / "ply_data_train1.h5"
    if kind == "no root":
        return root / "elsewhere"
    if kind == "cut short":
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    elif kind == "missing file":
        file.unlink()
    elif kind == "empty list":
        (folder / "train_files.txt").write_text("\n")
    elif kind == "no list":
        (folder / "train_files.txt").unlink()
    else:
        with h5py.File(file, "r+") as opened:
            if kind == "nan":
                opened["data"][3, 7, 1] = np.nan
            elif kind == "label":
                opened["label"][2] = 9
            elif kind == "no points":
                del opened["data"]
    return root


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("no root", "no ModelNet40 in .*elsewhere.*unpack https"),
        ("cut short", r"ply_data_train1\.h5 is not readable HDF5 \(cut short\?\)"),
        ("missing file", r"ply_data_train1\.h5 is missing, but train_files\.txt names it"),
        ("empty list", r"train_files\.txt is empty"),
        ("no list", r"train_files\.txt is missing"),
        ("nan", r"ply_data_train1\.h5: shape 3 has NaN or infinite points"),
        ("label", r"ply_data_train1\.h5: labels do not fit"),
        ("no points", r"ply_data_train1\.h5 lacks an array"),
    ],
)
def test_damage_is_named_in_one_line(root, kind, message):
    with pytest.raises(CorrmatError, match=message) as caught:
        module(damage(root, kind)).train_dataloader()
    assert "\n" not in str(caught.value)


def test_clouds_without_normals_get_estimated_ones_and_it_is_said(root, caplog):
    with h5py.File(root / modelnet40.FOLDER / "ply_data_train1.h5", "r+") as opened:
        del opened["normal"]
    clouds = modelnet40.load("train", root=root)
    assert "ply_data_train1.h5 has no normals: estimated" in caplog.text
    np.testing.assert_allclose(np.linalg.norm(clouds.rows[:][..., 3:], axis=-1), 1, atol=1e-4)


def test_estimated_normals_are_right_outward_and_turn_with_the_cloud():
    rng = np.random.default_rng(0)
    sphere = rng.standard_normal((1000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    estimate = normals.estimate_normals(5 + 0.1 * sphere)
    assert (estimate * sphere).sum(1).min() > 0.95
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    np.testing.assert_allclose(
        normals.estimate_normals(sphere @ turn.T), estimate @ turn.T, atol=2e-3
    )


@pytest.mark.parametrize(
    "cloud", [np.zeros((6, 3)), np.eye(3)[:1], np.outer(np.arange(9), [1, 2, 3])]
)
def test_estimated_normals_of_degenerate_clouds_are_units(cloud):
    estimate = normals.estimate_normals(cloud.astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(estimate, axis=1), 1, atol=1e-5)


def test_what_does_not_fit_the_data_is_named(root):
    with pytest.raises(
        CorrmatError, match="unknown category 'airplan'; categories: airplane, bathtub"
    ):
        module(root, categories=["airplan"]).test_dataloader()
    with pytest.raises(
        CorrmatError, match="have 64 points, but identical pairs of num_points = 65 need 65"
    ):
        RegistrationDataModule("modelnet40", root=str(root), num_points=65).test_dataloader()
    with pytest.raises(CorrmatError, match="needs its folder: ROOT="):
        RegistrationDataModule("modelnet40").test_dataloader()
