"""`DATA=folder`: meshes made here, in each of the three layouts."""

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import ROOT

from corrmat.cli import main
from corrmat.data import build, folder
from corrmat.errors import CorrmatError


def write_meshes(root, names):
    for number, name in enumerate(names):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1, 1 + number / 10, 2)).export(path)


@pytest.fixture
def modelnet(tmp_path):
    """ModelNet40's OFF layout, with a broken mesh in it."""
    root = tmp_path / "meshes"
    for category, split, count in (
        ("chair", "train", 6),
        ("sofa", "train", 5),
        ("chair", "test", 4),
    ):
        write_meshes(root, [f"{category}/{split}/{category}_{i:04d}.off" for i in range(count)])
    (root / "sofa/train/sofa_9999.off").write_text("OFF\n3 1 0\n0 0")
    return root


def test_modelnets_layout_says_category_and_split(modelnet, caplog):
    with caplog.at_level(logging.WARNING, "corrmat"):
        train = folder.load("train", root=modelnet)
    test = folder.load("test", root=modelnet)
    assert (len(train), len(test), train.names) == (11, 4, ("chair", "sofa"))
    assert np.bincount(train.labels).tolist() == [6, 5]
    assert "1 of 12 files were skipped" in caplog.text
    assert "sofa_9999.off" in caplog.text
    points = train.rows[np.arange(11)]
    assert points.shape == (11, 2048, 6)
    assert np.abs(points[..., :3].mean(1)).max() < 1e-5
    np.testing.assert_allclose(np.linalg.norm(points[..., :3], axis=2).max(1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(points[..., 3:], axis=2), 1, atol=1e-5)


def test_shapenets_layout_and_a_flat_folder_are_split_by_a_hash(tmp_path):
    shapenet = tmp_path / "shapenet"
    write_meshes(shapenet, [f"03001627/{i:04d}/models/model.obj" for i in range(20)])
    flat = tmp_path / "flat"
    write_meshes(flat, [f"{i}.ply" for i in range(20)])
    for root, name in ((shapenet, "03001627"), (flat, "flat")):
        names, splits = folder.find_shapes(root)
        assert names == (name,)
        paths = [file.relative for files in splits.values() for file in files]
        assert sorted(set(paths)) == sorted(paths)
        assert len(paths) == 20
        assert 0 < len(splits["test"]) < len(splits["train"])


def test_a_folder_called_train_may_hold_trains(tmp_path):
    write_meshes(tmp_path, [f"{c}/{i}.off" for c in ("bus", "car", "train") for i in range(20)])
    names, splits = folder.find_shapes(tmp_path)
    assert names == ("bus", "car", "train")
    assert len(splits["train"]) + len(splits["test"]) == 60


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_a_handful_of_shapes_is_enough_for_both_splits(tmp_path, count):
    for first in range(30):
        paths = [Path(f"{first + i}.ply") for i in range(count)]
        assert set(folder._split_by_hash(paths)) == {"train", "test"}


def test_files_in_neither_split_are_left_out_with_a_word(tmp_path, caplog):
    write_meshes(tmp_path, ["chair/train/a.off", "chair/test/b.off", "chair/val/c.off", "d.off"])
    with caplog.at_level("WARNING", "corrmat"):
        assert len(folder.load("train", root=tmp_path)) == 1
    assert "2 files lie in no folder train or test, as chair/val/c.off: left out" in caplog.text


def test_an_interrupted_build_continues_with_the_next_shard(modelnet, monkeypatch, tmp_path):
    monkeypatch.setattr(build, "SHARD", 4)
    write, numbers = build.write_shard, []

    def interrupt_at_the_second(place, number, *rest):
        if len(numbers) == 1:
            numbers.append(None)
            raise KeyboardInterrupt
        numbers.append(number)
        write(place, number, *rest)

    monkeypatch.setattr(build, "write_shard", interrupt_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        folder.load("train", root=modelnet)
    clouds = folder.load("train", root=modelnet)
    assert numbers == [0, None, 1, 2]
    assert len(clouds) == 11


@pytest.mark.parametrize(
    ("files", "message"),
    [({}, "holds no shape"), ({"train/a.off": "nothing", "train/b.off": ""}, "could be read")],
)
def test_a_folder_without_a_shape_is_said_in_one_line(files, message, tmp_path):
    root = tmp_path / "empty"
    root.mkdir()
    for name, text in files.items():
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text(text)
    for _ in range(2):  # the second time from the cache
        with pytest.raises(CorrmatError, match=message) as caught:
            folder.load("train", root=root)
        assert "\n" not in str(caught.value)


def test_a_run_on_a_folder_leaves_its_record_under_its_name(modelnet, tmp_path, monkeypatch):
    """What `make exp3.2 DATA=folder ROOT=meshes NAME=boxes SCALE=smoke` calls."""
    monkeypatch.chdir(tmp_path)
    words = ["run", "--config", str(ROOT / "configs/exp/3.2.yaml"), "--scale", "smoke"]
    words += ["--data.data", "folder", "--data.root", str(modelnet), "--data.name", "boxes"]
    words += ["--data.test_shapes", "4", "--logger", "none", "--trainer.max_steps", "2"]
    assert main(words) == 0
    record = json.loads((tmp_path / "results/smoke/boxes/3.2/metrics.json").read_text())
    assert (record["data"], record["arms"]["PCRNet"]["pairs"]) == ("boxes", 4)
    assert str(modelnet) not in (tmp_path / "results/smoke/boxes/3.2/config.yaml").read_text()


def test_a_file_name_need_not_be_utf8(tmp_path):
    name = os.fsdecode(b"box\xe9.npy")
    for path in (tmp_path / name, tmp_path / "b.npy"):
        np.save(path, np.random.default_rng(0).normal(size=(2048, 3)))
    found = sum(folder.find_shapes(tmp_path)[1].values(), [])
    assert sorted(Path(file.path).name for file in found) == ["b.npy", name]
    assert all(not isinstance(folder.sample_shape(file), str) for file in found)
