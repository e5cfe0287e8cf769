import h5py
import numpy as np
import pytest

from corrmat.data import shapes
from corrmat.data.families import FAMILIES


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_makes_different_sound_shapes(name):
    label = list(FAMILIES).index(name)
    made = [shapes.make_shape("train", label + turn * len(FAMILIES)) for turn in range(2)]
    for rows, found in made:
        assert found == label
        assert rows.shape == (2048, 6)
        assert rows.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(rows[:, :3].mean(0), 0, atol=1e-5)
        assert np.linalg.norm(rows[:, :3], axis=1).max() == pytest.approx(1, abs=1e-5)
    assert np.abs(made[0][0] - made[1][0]).max() > 0.1


def test_there_are_forty_families_and_splits_differ():
    assert len(FAMILIES) == 40
    assert not np.array_equal(shapes.make_shape("train", 0)[0], shapes.make_shape("test", 0)[0])


def test_a_shape_is_the_same_again_and_whether_few_or_many_are_made(tmp_path, monkeypatch):
    few = shapes.load("test", 5)
    monkeypatch.setattr(shapes, "SIZE", {"train": 12, "test": 6})
    monkeypatch.setattr(shapes, "SMALL", 2)
    cached = shapes.load("test", 5)
    np.testing.assert_array_equal(few.rows, cached.rows)
    assert few.names[few.labels[1]] == "bathtub"


def test_the_cache_is_written_whole_and_a_damaged_one_is_made_anew(monkeypatch, capsys):
    monkeypatch.setattr(shapes, "SIZE", {"train": 8, "test": 4})
    monkeypatch.setattr(shapes, "SMALL", 0)
    whole = shapes.load("test")
    path = next(shapes.cache_folder().glob("*.h5"))
    with h5py.File(path) as file:
        assert file.attrs["version"] == shapes.fingerprint()
    stamp = path.stat().st_mtime_ns
    shapes.load("test")
    assert path.stat().st_mtime_ns == stamp

    with h5py.File(path, "r+") as file:
        file["data"][0, 0, 0] += 1
    np.testing.assert_array_equal(shapes.load("test").rows, whole.rows)
    path.write_bytes(path.read_bytes()[:1000])
    np.testing.assert_array_equal(shapes.load("test").rows, whole.rows)
    assert [p.name for p in shapes.cache_folder().iterdir()] == [path.name]


def test_what_stops_halfway_leaves_nothing(monkeypatch, tmp_path):
    monkeypatch.setattr(shapes, "SIZE", {"train": 8, "test": 4})

    def full_disk(clouds):
        raise OSError("no space left")

    monkeypatch.setattr(shapes, "_digest", full_disk)
    with pytest.raises(OSError, match="no space left"):
        shapes.build(tmp_path / "test.h5", "test")
    assert not list(tmp_path.glob("*.h5*"))
    assert not list(tmp_path.glob("*.partial"))
