"""Several scans onto one."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from corrmat.calibration import SURE
from corrmat.cli import main
from corrmat.data.scans import read_scan, write_ply
from corrmat.data.shapes.dataset import make_shape
from corrmat.errors import CorrmatError
from corrmat.registration import pose_graph
from corrmat.registration.pose_graph import ScanPose, register_scans, to_text
from corrmat.registration.preparation import Cloud


def transforms(count, seed=0, far=0.0):
    rng = np.random.default_rng(seed)
    result = np.stack([np.eye(4)] * count)
    result[:, :3, :3] = Rotation.random(count, rng=seed).as_matrix()
    result[:, :3, 3] = far + rng.uniform(-1, 1, (count, 3))
    return result


def off(one, two, cloud):
    moved = [cloud @ t[:3, :3].T + t[:3, 3] for t in (one, two)]
    return np.linalg.norm(moved[0] - moved[1], axis=1).max()


@pytest.fixture
def world(monkeypatch):
    """Four scans of known poses; `register` answers with the truth, noise, or nonsense."""
    rng = np.random.default_rng(1)
    poses = transforms(4, far=1e4)  # world to scan
    shape = rng.uniform(-1, 1, (200, 3))
    scans = [shape @ p[:3, :3].T + p[:3, 3] for p in poses]
    wrong, noise = {}, {"deg": 0.0}

    def answer(source, target, **options):
        i, j = (
            next(
                k
                for k, scan in enumerate(scans)
                if np.allclose(scan.mean(0), Cloud.of(cloud, "", 0).centre)
            )
            for cloud in (source, target)
        )
        transform = poses[j] @ np.linalg.inv(poses[i])
        rotvec = np.radians(noise["deg"]) * rng.standard_normal(3)
        rotation, centre = Rotation.from_rotvec(rotvec).as_matrix(), scans[j].mean(0)
        transform[:3, :3] = rotation @ transform[:3, :3]
        transform[:3, 3] = rotation @ (transform[:3, 3] - centre) + centre
        confidence = SURE
        if (i, j) in wrong:
            transform, confidence = transforms(1, seed=i + 7, far=5.0)[0], wrong[i, j]
        return SimpleNamespace(transform=transform, confidence=confidence, calibrated=True)

    monkeypatch.setattr(pose_graph, "register", answer)
    return scans, poses, wrong, noise


def test_true_registrations_give_true_poses(world):
    scans, poses, _, _ = world
    for index, pose in enumerate(register_scans(scans)):
        assert off(pose.transform, poses[3] @ np.linalg.inv(poses[index]), scans[index]) < 1e-8
        assert (pose.agree, pose.verdict) == (3, "aligned")


def test_a_wrong_registration_is_outvoted(world):
    scans, poses, wrong, _ = world
    wrong[0, 3] = 0.6  # less sure than the way round it
    pose = register_scans(scans)[0]
    assert off(pose.transform, poses[3] @ np.linalg.inv(poses[0]), scans[0]) < 1e-8
    assert (pose.agree, pose.confidence, pose.verdict) == (2, SURE, "aligned")


def test_a_scan_that_fits_nowhere_is_doubtful(world):
    scans, _, wrong, _ = world
    wrong |= {(0, 1): 0.1, (0, 2): 0.2, (0, 3): 0.1}
    first, *others = register_scans(scans)
    assert first.verdict == "doubtful: 1 of 3 registrations agree"
    assert first.confidence == 0.2
    assert [pose.verdict for pose in others] == ["aligned"] * 2


def test_a_scan_that_most_registrations_contradict_is_doubtful(world):
    """However sure the one is that gives its pose."""
    scans, _, wrong, _ = world
    wrong |= {(0, 1): 0.6, (0, 2): 0.7, (0, 3): 0.8}
    first, *others = register_scans(scans)
    assert first.verdict == "doubtful: 1 of 3 registrations agree"
    assert first.confidence < 0.5
    assert [pose.verdict for pose in others] == ["aligned"] * 2


def test_averaging_is_better_than_one_registration(world):
    scans, poses, _, noise = world
    noise["deg"] = 1.0
    errors, single = [], []
    for _ in range(20):
        result = register_scans(scans)
        one = pose_graph.register(scans[0], scans[3]).transform
        truth = poses[3] @ np.linalg.inv(poses[0])
        errors.append(off(result[0].transform, truth, scans[0]))
        single.append(off(one, truth, scans[0]))
    assert np.mean(errors) < 0.85 * np.mean(single)


def test_one_scan_is_refused():
    with pytest.raises(CorrmatError, match="two or more"):
        register_scans([np.zeros((5, 3))])


def test_the_command_moves_every_scan_onto_the_last(tmp_path, monkeypatch, capsys):
    cloud = make_shape(("test", 0))[0][:, :3].astype(float)
    poses = transforms(3)
    for name, pose, part in zip("abc", poses, (0, 1, 2), strict=True):
        points = cloud[part::3] @ pose[:3, :3].T + pose[:3, 3]
        write_ply(tmp_path / f"{name}.ply", points)
    monkeypatch.chdir(tmp_path)
    results = ["-o", "moved", "--json", "moved/out.json"]
    assert main(["register", "a.ply", "b.ply", "c.ply", *results]) == 0
    printed = capsys.readouterr().out
    assert "a.ply" in printed
    assert "b.ply" in printed
    result = json.loads((tmp_path / "moved" / "out.json").read_text())
    assert [scan["scan"] for scan in result["scans"]] == ["a.ply", "b.ply"]
    for part, scan in enumerate(result["scans"]):
        truth = poses[2] @ np.linalg.inv(poses[part])
        original = read_scan(tmp_path / scan["scan"])
        assert off(np.array(scan["transform"]), truth, original) < 0.1
        moved = read_scan(tmp_path / "moved" / scan["scan"])
        assert np.abs(moved - (original @ truth[:3, :3].T + truth[:3, 3])).max() < 0.1


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_confidence_that_is_not_fitted_to_the_model_is_marked(calibrated):
    pose = ScanPose(np.eye(4), 0.95, calibrated, 1, "aligned")
    text = to_text([Path("a.ply")], Path("b.ply"), [pose])
    assert ("not calibrated" in text) != calibrated


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.ply", "b.ply", "c.ply", "--html", "x.html"], "two scans"),
        (["a.ply", "b.ply", "c.ply", "-o", "out.ply"], "folder"),
        (["a.ply", "b.ply", "c.ply", "-o", "a.ply/moved"], "cannot write"),
        (["a.ply", "b.ply", "c.ply", "-o", "m", "--json", "m/b.ply"], "named for two results"),
        (["a.ply"], "target"),
    ],
)
def test_what_does_not_go_with_several_scans_is_said(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in "abc":
        write_ply(tmp_path / f"{name}.ply", np.random.default_rng(0).random((50, 3)))
    assert main(["register", *words]) == 2
    assert message in capsys.readouterr().err


def test_a_stray_point_does_not_widen_what_agrees():
    cloud = np.random.default_rng(0).normal(size=(500, 3))
    edges = [pose_graph._Edge(0, 1, np.eye(4), 0.9, True)]
    plain, stray = (
        pose_graph._PoseGraph([Cloud.of(points, "scan", 0)] * 2, edges)
        for points in (cloud, np.vstack([cloud, [[1e5, 0, 0]]]))
    )
    assert stray.tolerance == pytest.approx(plain.tolerance)
    np.testing.assert_allclose(stray.centres, plain.centres)  # else a lever on all poses


def test_an_error_names_the_scan_that_it_is_about():
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    broken = cloud.copy()
    broken[3] = np.nan
    with pytest.raises(CorrmatError, match="scan 2 of 3: 1 points are NaN"):
        register_scans([cloud, broken, cloud])
    with pytest.raises(CorrmatError, match="scan 1 of 2: array of shape"):
        register_scans([np.zeros(4), cloud])
