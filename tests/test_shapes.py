import subprocess
import sys

import numpy as np
import pytest

from corrmat.data import build, clouds, registry
from corrmat.data.shapes import dataset as shapes
from corrmat.data.shapes.families import FAMILIES
from corrmat.data.shapes.rooms import part_of_room
from corrmat.errors import CorrmatError


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_makes_different_sound_shapes(name):
    label = list(FAMILIES).index(name)
    shapes_made = [shapes.make_shape(("train", label + turn * len(FAMILIES))) for turn in range(2)]
    for rows, family in shapes_made:
        assert family == label
        assert rows.shape == (2048, 6)
        assert rows.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(rows[:, :3].mean(0), 0, atol=1e-5)
        assert np.linalg.norm(rows[:, :3], axis=1).max() == pytest.approx(1, abs=1e-5)
    assert np.abs(shapes_made[0][0] - shapes_made[1][0]).max() > 0.1


def test_there_are_forty_families_and_splits_differ():
    assert len(FAMILIES) == 40
    assert not np.array_equal(shapes.make_shape(("train", 0))[0], shapes.make_shape(("test", 0))[0])


def test_a_shape_is_the_same_again_and_whether_few_or_many_are_made(monkeypatch):
    few = shapes.load("test", 5)
    monkeypatch.setattr(shapes, "SIZE", {"train": 12, "test": 6})
    monkeypatch.setattr(shapes, "SMALL", 2)
    cached = shapes.load("test", 5)
    np.testing.assert_array_equal(few.rows, cached.rows[:])
    assert few.names[few.labels[1]] == "bathtub"


def test_the_cache_is_written_whole_and_a_damaged_shard_is_made_again(monkeypatch):
    monkeypatch.setattr(shapes, "SIZE", {"train": 8, "test": 4})
    monkeypatch.setattr(shapes, "SMALL", 0)
    monkeypatch.setattr(build, "SHARD", 3)
    whole = shapes.load("test").rows[:]
    first, second = sorted(clouds.cache_folder().glob("*/shard-*.npy"))
    stamps = [path.stat().st_mtime_ns for path in (first, second)]
    shapes.load("test")
    assert [path.stat().st_mtime_ns for path in (first, second)] == stamps

    content = bytearray(second.read_bytes())
    content[-1] ^= 1
    second.write_bytes(content)
    np.testing.assert_array_equal(shapes.load("test").rows[:], whole)
    assert first.stat().st_mtime_ns == stamps[0]
    second.write_bytes(second.read_bytes()[:1000])
    np.testing.assert_array_equal(shapes.load("test").rows[:], whole)
    (index,) = clouds.cache_folder().glob("*/index.json")
    index.write_text(index.read_text()[:20])
    np.testing.assert_array_equal(shapes.load("test").rows[:], whole)


def test_what_stops_halfway_leaves_whole_shards_and_goes_on(monkeypatch):
    monkeypatch.setattr(shapes, "SIZE", {"train": 8, "test": 4})
    monkeypatch.setattr(shapes, "SMALL", 0)
    monkeypatch.setattr(build, "SHARD", 2)
    original, written = build.write_shard, []

    def interrupted(folder, number, *rest):
        if number == 1 and not written:
            written.append(number)
            raise KeyboardInterrupt
        original(folder, number, *rest)

    monkeypatch.setattr(build, "write_shard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        shapes.load("test")
    (first,) = clouds.cache_folder().glob("*/shard-*.npy")
    stamp = first.stat().st_mtime_ns
    assert not list(clouds.cache_folder().glob("*/*.partial"))
    rows = shapes.load("test").rows[:]
    assert first.stat().st_mtime_ns == stamp
    np.testing.assert_array_equal(rows[3], shapes.make_shape(("test", 3))[0])


SCRIPT = """
from corrmat import RegistrationDataModule
from corrmat.data.shapes import dataset
dataset.SIZE, dataset.SMALL = {"train": 12, "test": 6}, 0
print(len(RegistrationDataModule(data="shapes", num_points=64).train_dataloader().dataset))
"""


@pytest.mark.parametrize("way", ["script", "python -c"])
def test_a_plain_script_makes_the_shapes_without_a_main_guard(way, tmp_path):
    """Its worker processes must not run the script again."""
    (tmp_path / "script.py").write_text(SCRIPT)
    words = ["script.py"] if way == "script" else ["-c", SCRIPT]
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "11"


@pytest.mark.parametrize("make", [shapes.make_assembly, shapes.make_room])
def test_assemblies_and_rooms_are_sound_differ_and_are_the_same_again(make):
    made = [make((split, index))[0] for split in ("train", "test") for index in (0, 1)]
    for rows in made:
        assert rows.shape == (2048, 6)
        np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 1, atol=1e-5)
        assert np.linalg.norm(rows[:, :3], axis=1).max() == pytest.approx(1, abs=1e-5)
    assert len({rows.tobytes() for rows in made}) == 4
    np.testing.assert_array_equal(made[1], make(("train", 1))[0])


@pytest.mark.parametrize("small", [0, 200])
def test_data_sets_are_joined(small, monkeypatch):
    monkeypatch.setattr(shapes, "SMALL", small)
    monkeypatch.setattr(shapes, "SIZE", {"train": 8, "test": 4})
    monkeypatch.setattr(shapes, "ASSEMBLIES", {"train": 6, "test": 2})
    both = registry.load_clouds("shapes+assemblies", "test", 4)
    assert [both.names[label] for label in both.labels] == [
        "airplane", "bathtub", "assembly", "assembly",
    ]  # fmt: skip
    np.testing.assert_array_equal(both.rows[3], registry.load_clouds("assemblies", "test").rows[1])
    np.testing.assert_array_equal(both.select(slice(1, 2)).rows[0], shapes.load("test").rows[1])
    assert len(registry.load_clouds("shapes+assemblies", "train")) == 14
    with pytest.raises(CorrmatError, match="unknown data set 'shops'"):
        registry.load_clouds("shapes+shops", "train")


def test_parts_of_a_room_differ_in_size():
    extents = [
        np.ptp(part_of_room(np.random.default_rng(seed), 500)[0], axis=0)[:2].max()
        for seed in range(6)
    ]
    assert max(extents) > 1.3 * min(extents)
    assert max(extents) < 7.5  # metres: the longest room, and its walls


def test_rooms_are_a_data_set():
    rooms = registry.load_clouds("rooms", "test", 2)
    assert [rooms.names[label] for label in rooms.labels] == ["room", "room"]
    np.testing.assert_array_equal(rooms.rows[1], shapes.make_room(("test", 1))[0])
