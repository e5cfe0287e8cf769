"""`corrmat register`: two clouds of anybody's."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_rotation, shared
from PIL import Image
from scipy.spatial.transform import Rotation

import corrmat
from corrmat import weights
from corrmat.baselines import fpfh_ransac
from corrmat.calibration import SURE, as_percent, verdict
from corrmat.cli import main
from corrmat.data.normals import estimate_normals
from corrmat.data.scan_pairs import make_object_pair, make_room_pair
from corrmat.data.scans import read_scan, write_ply
from corrmat.data.shapes.dataset import make_shape
from corrmat.errors import CorrmatError
from corrmat.methods import InvariantCorr
from corrmat.ops import rigid
from corrmat.ops.correspondence import MatchabilityCorrespondence, SoftCorrespondence
from corrmat.options import REGISTER_EPILOG
from corrmat.registration import animation, choice, example, preparation, result
from corrmat.registration import hypotheses as generation
from corrmat.registration import register as registration
from corrmat.registration.animation import registration_gif
from corrmat.registration.em_icp import em_icp
from corrmat.registration.hypotheses import (
    Hypotheses,
    NetworkHypotheses,
    rough_agreement,
    unmatched_nll,
)
from corrmat.registration.phase_correlation import PhaseCorrelation
from corrmat.registration.scene import build_scene, extent
from corrmat.registration.scoring import COARSE_POINTS, AlignmentScorer
from corrmat.registration.verification import verify
from corrmat.registration.view import registration_page
from corrmat.types import Prediction
from corrmat.weights import export_model, load_model

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


POINTS_AT_HOME = np.random.default_rng(0).normal(size=(200, 3))


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The example's two scans and their truth."""
    folder = tmp_path_factory.mktemp("pair")
    example.write_example(folder)
    truth = np.array(json.loads((folder / "truth.json").read_text())["transform"])
    return folder, read_scan(folder / "source.ply"), read_scan(folder / "target.ply"), truth


def angle_deg(a, b):
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_the_example_is_registered_within_two_degrees(pair):
    _, source, target, truth = pair
    result = corrmat.register(source, target)
    assert angle_deg(result.transform, truth) < 2
    moved, right = (source @ t[:3, :3].T + t[:3, 3] for t in (result.transform, truth))
    assert np.linalg.norm(moved - right, axis=1).max() < 0.05 * example.MILLIMETRES
    assert result.verdict == "aligned"
    assert result.transform.dtype == np.float64
    assert len(result.matches) == len(result.match_confidence) > 0
    assert result.matches[:, 0].max() < len(source)
    assert result.matches[:, 1].max() < len(target)


def test_matches_name_the_users_rows(pair):
    """Most confident matches lie near each other after the true motion."""
    _, source, target, truth = pair
    result = corrmat.register(source, target)
    sure = result.matches[np.argsort(-result.match_confidence)[:20]]
    moved = source[sure[:, 0]] @ truth[:3, :3].T + truth[:3, 3]
    off = np.linalg.norm(moved - target[sure[:, 1]], axis=1)
    assert np.median(off) < 0.2 * example.MILLIMETRES
    assert result.match_agrees.mean() > 0.9


def test_the_order_of_rows_does_not_matter_and_the_seed_decides(pair):
    _, source, target, _ = pair
    rng = np.random.default_rng(0)
    one = corrmat.register(source, target, seed=3)
    two = corrmat.register(rng.permutation(source), rng.permutation(target), seed=3)
    assert (one.transform == two.transform).all()
    assert one.confidence == two.confidence
    other = corrmat.register(source, target, seed=4)
    assert (other.transform != one.transform).any()


def test_swapped_clouds_give_the_inverse(pair):
    _, source, target, _ = pair
    there, back = corrmat.register(source, target), corrmat.register(target, source)
    assert angle_deg(there.transform @ back.transform, np.eye(4)) < 2


def test_any_unit_and_place_gives_the_same_motion(pair):
    _, source, target, truth = pair
    near = corrmat.register(source, target)
    for factor, far in ((1e-3, 0.0), (1e3, 1e7)):
        result = corrmat.register(factor * source + far, factor * target - far)
        assert angle_deg(result.transform, truth) < 2
        assert result.rmse == pytest.approx(factor * near.rmse, rel=0.2)


def test_detail_far_from_the_origin_is_not_lost(generator):
    """Millimetres at coordinates of 1e7: the moved source meets the target to float64."""
    points = make_shape(("test", 3))[0][:, :3].astype(np.float64)
    rotation = random_rotation(1, generator)[0].numpy()
    source = 1000 * points + 1e7
    target = (1000 * points) @ rotation.T - 1e7
    result = corrmat.register(source, target)
    moved = source @ result.transform[:3, :3].T + result.transform[:3, 3]
    assert np.linalg.norm(moved - target, axis=1).max() < 1e-3


@pytest.mark.parametrize("far", [1e4, 1e9])
def test_a_stray_point_far_away_changes_nothing(pair, far):
    """One of them would shift the centroid and the scale of all others."""
    _, source, target, _ = pair
    without = corrmat.register(source, target)
    stray = source.mean(0) + [0, 0, far * np.ptp(source)]
    result = corrmat.register(np.vstack([stray, source]), target)
    assert (result.transform == without.transform).all()
    assert result.verdict == "aligned"
    assert (result.matches == without.matches + [1, 0]).all()


def test_points_that_are_there_more_than_once_change_nothing(pair):
    """Copies have no distance, and made every spacing and tolerance vanish."""
    _, source, target, _ = pair
    without = corrmat.register(source, target)
    result = corrmat.register(np.repeat(source, 3, 0), np.vstack([target, target]))
    assert (result.transform == without.transform).all()
    assert result.overlap == without.overlap


def test_copies_may_differ_in_their_normals(pair):
    _, source, target, _ = pair
    clouds = [np.hstack([c, estimate_normals(c)]) for c in (source, target)]
    without = corrmat.register(*clouds)
    flipped = clouds[0] * [1, 1, 1, -1, -1, -1]
    result = corrmat.register(np.vstack([clouds[0], flipped]), clouds[1])
    assert result.overlap > 0.9 * without.overlap


def test_seeds_may_be_numpys_and_must_be_integers(pair):
    _, source, target, _ = pair
    results = [corrmat.register(source, target, seed=seed) for seed in (3, np.int64(3))]
    assert (results[0].transform == results[1].transform).all()
    with pytest.raises(TypeError):
        corrmat.register(source, target, seed=1.5)  # pyright: ignore[reportArgumentType]


def test_the_default_precision_does_not_matter(pair):
    _, source, target, _ = pair
    expected = corrmat.register(source, target)
    torch.set_default_dtype(torch.float64)
    try:
        result = corrmat.register(source, target)
    finally:
        torch.set_default_dtype(torch.float32)
    np.testing.assert_allclose(result.transform, expected.transform, atol=1e-6, rtol=1e-6)


def test_a_network_in_half_precision_gives_a_rigid_transform(pair):
    _, source, target, _ = pair
    network = load_model().to(torch.bfloat16)
    for refine in ("icp", "none"):
        transform = corrmat.register(source, target, model=network, refine=refine).transform
        assert np.isfinite(transform).all()
    rotation = corrmat.register(source, target, model=network).transform[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("model", ["icp", "corrmat"])
def test_shapes_that_have_nothing_in_common_are_not_called_aligned(pair, model):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(600, 3)) * np.std(pair[1])
    assert corrmat.register(noise, pair[2], model=model).verdict.startswith("doubtful")


def test_pixels_without_a_measurement_do_not_shrink_the_picture(pair):
    """Depth cameras give them as zeros; here there are more of them than points."""
    _, source, target, _ = pair
    source = source + [0, 0, 8000]
    pixels = np.vstack([source, np.zeros((1200, 3))])
    result = corrmat.register(pixels, target)
    scene = build_scene(result, pixels, target, 10)
    assert np.isnan(scene.aligned[len(source) :]).all()
    assert np.isfinite(scene.aligned[: len(source)]).all()


def test_a_stray_point_does_not_shrink_the_picture(pair):
    _, source, target, _ = pair
    stray = np.vstack([source, [[1e6, 0, 0]]])
    result = corrmat.register(stray, target)
    scene = build_scene(result, stray, target, 10)
    assert scene.beside < 3 * np.ptp(target, axis=0).max()
    assert np.isnan(scene.aligned).any(1).tolist() == [False] * len(source) + [True]
    low, high = extent(scene.source_at(0.5))
    assert (high - low).max() < 3 * np.ptp(target, axis=0).max()


GRID = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)
LINE = np.arange(50.0)[:, None] * np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (GRID[:2], "2 points; a rotation needs at least 3"),
        (np.vstack([GRID, [[np.nan, 0, 0]]]), "1 points are NaN or infinite, the first is row 64"),
        (np.vstack([[[np.inf, 0, 0]], GRID]), "the first is row 0"),
        (np.ones((9, 3)), "all points are equal; the rotation is not determined"),
        (np.ones((9, 3)) * 1e7 + 0.1, "all points are equal; the rotation is not determined"),
        (1e170 * GRID, "coordinates are too large"),
        (LINE, "all points lie on one line; the rotation is not determined"),
        (LINE + 1e6, "all points lie on one line; the rotation is not determined"),
        (GRID[:, :2], r"array of shape \(64, 2\)"),
        (np.vstack([GRID[:2]] * 9), "2 different points; the rotation is not determined"),
        (np.array([[0, 0, 0], [1, 0, 0], [0, 1e3, 0]]), "2 points are left without the stray ones"),
        (np.hstack([GRID, 255 * GRID]), "no unit normals .one has length 1.33e.03"),
        (np.hstack([GRID, 0 * GRID]), "no unit normals .one has length 0"),
        ([[0.0, 1.0], [2.0]], "not an array of numbers"),
        ([["one", "two", "three"]] * 9, "not an array of numbers"),
    ],
)
def test_clouds_that_determine_nothing_are_refused(cloud, message):
    with pytest.raises(CorrmatError, match=f"source: .*{message}"):
        registration.register(cloud, GRID, model="icp")
    with pytest.raises(CorrmatError, match=f"target: .*{message}"):
        registration.register(GRID, cloud, model="icp")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "nobody"}, "no model 'nobody'"),
        ({"refine": "much"}, "refine = 'much'"),
        ({"seed": -1}, "seed = -1 is not between"),
        ({"seed": 2**64}, "is not between"),
    ],
)
def test_unknown_options_are_refused(options, message):
    with pytest.raises(CorrmatError, match=message):
        registration.register(GRID, GRID, **options)


def test_small_clouds_are_registered_or_doubted():
    for cloud in (GRID[[0, 1, 4]], GRID[:5], GRID[[0, 1, 4, 16]]):
        result = registration.register(cloud, cloud + 5)
        assert np.linalg.det(result.transform[:3, :3]) == pytest.approx(1)
        moved = cloud @ result.transform[:3, :3].T + result.transform[:3, 3]
        off = np.linalg.norm(moved[:, None] - cloud - 5, axis=2).min(1)
        assert result.verdict != "aligned" or np.mean(off < 0.05) >= 0.75


def test_clouds_that_have_nothing_in_common_are_doubtful(pair):
    _, source, _, _ = pair
    plane = np.random.default_rng(0).uniform(size=(900, 3)) * [1, 1, 0.001]
    result = registration.register(source, plane)
    assert result.verdict.startswith("doubtful: ")
    assert result.match_agrees.mean() < 0.5


def test_many_points_are_subsampled_evenly():
    cloud = np.random.default_rng(0).normal(size=(100_000, 3))
    actual = preparation.Cloud.of(cloud, "source", 0)
    assert len(actual.rows) == preparation.FULL_POINTS
    assert len(set(actual.rows.tolist())) == preparation.FULL_POINTS
    assert np.abs(actual.centre).max() < 0.03
    assert abs(np.median(actual.rows) - 50_000) < 1500  # from everywhere in the file


@pytest.mark.parametrize("several", [False, True])
def test_json_alone_goes_to_standard_output(pair, several, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scans = [str(pair[0] / f"{name}.ply") for name in ("source", "target")]
    if several:
        scans.insert(0, scans[0])
    assert main(["register", *scans, "--model", "icp", "--json", "-"]) == 0
    printed = capsys.readouterr()
    content = json.loads(printed.out)
    assert (content["model"], content["seed"]) == ("icp", 0)
    assert "confidence" in printed.err
    assert not any(tmp_path.iterdir())


def test_a_copy_of_the_shipped_weights_is_calibrated_as_they_are(pair, tmp_path):
    _, source, target, _ = pair
    export_model("corrmat", tmp_path / "copy")
    registrations = [
        corrmat.register(source, target, model=model) for model in (tmp_path / "copy", "icp")
    ]
    assert [registration.calibrated for registration in registrations] == [True, False]
    assert len(repr(registrations[0])) < 200
    assert "not to this model" not in result.to_text(registrations[0])


@pytest.mark.parametrize(("model", "said"), [("icp", 0), ("corrmat", 13)])
def test_the_animation_speaks_of_matches_where_there_are_some(pair, model, said, monkeypatch):
    titles, original = [], animation._title
    monkeypatch.setattr(animation, "_title", lambda *a: titles.append(original(*a)) or titles[-1])
    _, source, target, _ = pair
    registration_gif(corrmat.register(source, target, model=model), source, target)
    assert sum("strongest matches" in title for title in titles) == said


def test_the_command_writes_what_it_promises(pair, tmp_path, capsys):
    folder, source, target, truth = pair
    out, result, html = (tmp_path / name for name in ("aligned.ply", "T.json", "view.html"))
    gif = tmp_path / "view.gif"
    words = [str(folder / "source.ply"), str(folder / "target.ply"), "-o", str(out)]
    assert (
        main(["register", *words, "--json", str(result), "--html", str(html), "--gif", str(gif)])
        == 0
    )
    shown = capsys.readouterr().out
    for word in (
        "matrix",
        "rotation",
        "translation",
        "RMSE",
        "confidence",
        "verdict",
        "agree with",
    ):
        assert word in shown
    content = json.loads(result.read_text())
    assert {"transform", "confidence", "rmse", "verdict", "model", "seed", "seconds"} <= set(
        content
    )
    transform = np.array(content["transform"])
    assert angle_deg(transform, truth) < 2
    assert np.allclose(read_scan(out), source @ transform[:3, :3].T + transform[:3, 3])
    with Image.open(gif) as frames:
        assert frames.n_frames == 54
        first, last = (np.asarray(_frame(frames, at)) for at in (0, 53))
    assert (first != last).any()
    assert gif.stat().st_size < 1.5e6
    assert 1e6 < html.stat().st_size < 8e6
    assert "http" not in html.read_text().split("<script", 1)[0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.ply", "none.ply"], "none.ply: no such file"),
        (["a.ply", "a.ply", "-o", "none/b.ply"], "no folder none"),
        (["a.ply", "a.ply", "--html", "none/b.html"], "no folder none"),
        (["a.ply", "a.ply", "--model", "none.pth"], "no model 'none.pth'"),
        (["a.ply", "a.ply", "--model", "a.ply"], "a.ply is no checkpoint"),
        (["a.ply", "a.ply", "--model", "a.stl"], "a.stl is no checkpoint"),
        (["a.ply", "two.xyz"], "two.xyz: 2 points"),
        (["a.ply", "a.ply", "--json", "x", "--html", "./x"], "x is named for two results"),
    ],
)
def test_bad_input_is_one_line_and_code_2(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "a.ply", GRID)
    (tmp_path / "two.xyz").write_text("0 0 0\n1 1 1\n")
    (tmp_path / "a.stl").write_text("solid a\nendsolid a\n")
    assert main(["register", *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert message in said


@pytest.mark.parametrize(
    "words",
    [
        ["a.ply", "b.ply", "-o", "a.ply"],
        ["a.ply", "b.ply", "-o", "./folder/../b.ply"],
        ["a.ply", "c.ply", "b.ply", "-o", "."],
        ["c.obj", "a.ply", "c.ply", "-o", "."],
    ],
)
def test_no_scan_is_overwritten(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name in ("a.ply", "b.ply", "c.ply"):
        write_ply(tmp_path / name, GRID)
    before = {path: path.read_bytes() for path in tmp_path.glob("*.ply")}
    assert main(["register", *words, "--model", "icp"]) == 2
    assert "is one of the scans" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.glob("*.ply")} == before


@pytest.mark.parametrize(("command", "name"), [("example", "source.ply"), ("export", "README.md")])
def test_files_of_a_user_are_not_overwritten(command, name, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    assert main([command, str(tmp_path)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name]
    (tmp_path / name).unlink()
    assert main([command, str(tmp_path)]) == 0
    assert main([command, str(tmp_path)]) == (2 if command == "export" else 0)  # twice


def test_results_go_through_links_and_into_pipes(pair, tmp_path):
    folder = pair[0]
    scans = [str(folder / "source.ply"), str(folder / "target.ply"), "--model", "icp"]
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    assert main(["register", *scans, "--json", str(tmp_path / "link.json")]) == 0
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "real.json").read_text())["model"] == "icp"
    into, out_of = os.pipe()[::-1]
    assert main(["register", *scans, "--json", f"/dev/fd/{into}"]) == 0
    assert json.loads(os.read(out_of, 10_000))["model"] == "icp"
    os.mkfifo(tmp_path / "pipe")
    reader = subprocess.Popen(["cat", str(tmp_path / "pipe")], stdout=subprocess.PIPE)
    assert main(["register", *scans, "--json", str(tmp_path / "pipe")]) == 0
    assert json.loads(reader.communicate()[0])["model"] == "icp"
    assert not (tmp_path / "pipe").is_file()


def test_a_checkpoint_that_could_run_code_is_refused(tmp_path):
    """A pickle that would write a file when loaded: it is not, and one line says why."""
    path = tmp_path / "model.pth"

    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    torch.save({"state_dict": Trap()}, path)
    with pytest.raises(CorrmatError, match="no checkpoint of tensors alone"):
        load_model(path)
    assert not (tmp_path / "sprung").exists()


def test_a_model_trained_anew_is_read_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(registration, "load_model", lambda model: Path(model).read_text())
    monkeypatch.setattr(registration, "NetworkHypotheses", lambda content: content)
    path = tmp_path / "best.ckpt"
    path.write_text("first")
    assert registration._load_network(str(path)) is registration._load_network(str(path))
    path.write_text("second training")
    assert registration._load_network(str(path)) == "second training"


def test_a_folder_exported_anew_is_read_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(
        registration, "load_model", lambda model: (Path(model) / "model.safetensors").read_text()
    )
    monkeypatch.setattr(registration, "NetworkHypotheses", lambda content: content)
    (tmp_path / "model.safetensors").write_text("first")
    assert registration._load_network(str(tmp_path)) == "first"
    (tmp_path / "model.safetensors").write_text("second training")
    assert registration._load_network(str(tmp_path)) == "second training"


def test_a_checkpoint_of_another_network_names_what_does_not_fit(tmp_path):
    path = tmp_path / "model.pth"
    torch.save({"layer.weight": torch.zeros(3)}, path)
    with pytest.raises(CorrmatError, match="none of DCP, RPMNet.*layer.weight"):
        load_model(path)
    torch.save({"emb_nn.conv1.weight": torch.zeros(64, 6, 1, 1)}, path)
    with pytest.raises(CorrmatError, match="emb_nn.conv5.weight is missing"):
        load_model(path)
    torch.save({"emb_nn.conv1.weight": torch.zeros(64)}, path)
    with pytest.raises(CorrmatError, match="none of DCP, RPMNet"):
        load_model(path)
    torch.save({"method": "DCPCorr", "state_dict": {"network.a": torch.zeros(3)}}, path)
    with pytest.raises(CorrmatError, match="another version of corrmat"):
        load_model(path)


def test_the_authors_checkpoint_registers(pair):
    """DCP v1 as its authors published it, on clouds no further turned than it was trained for."""
    path = shared("reference", "dcp_v1.t7")
    points = make_shape(("test", 3))[0][:, :3].astype(np.float64)
    angle = np.radians(30)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    result = corrmat.register(points, points @ turn.T, model=path)
    assert result.model == str(path)
    assert angle_deg(result.transform[:3, :3], turn) < 2


def test_shipped_weights_are_small_and_hold_no_pickle():
    from corrmat.weights import SHIPPED

    files = list(SHIPPED.parent.glob("*.safetensors"))
    assert len(files) == 2  # of matching and of verification
    for file in files:
        content = file.read_bytes()
        assert len(content) < 8e6
        assert content[8:9] == b"{"  # safetensors: a length, then JSON


def _frame(frames, at):
    frames.seek(at)
    return frames.convert("RGB")


@pytest.mark.parametrize("model", ["ransac", "ransac17", "fgr", "kiss"])
def test_classical_pipelines_register_the_example(pair, model):
    pytest.importorskip("kiss_matcher" if model == "kiss" else "open3d")
    _, source, target, truth = pair
    result = corrmat.register(source, target, model=model)
    assert angle_deg(result.transform, truth) < 5
    seeded = [corrmat.register(source, target, model=model, seed=2**40).transform for _ in range(2)]
    np.testing.assert_allclose(*seeded, atol=1e-6)


def test_open3d_prints_no_warning_of_few_matches(capfd):
    pytest.importorskip("open3d")
    clouds = np.random.default_rng(1).standard_normal((2, 40, 3)) / 2
    fpfh_ransac(*(np.hstack([cloud, estimate_normals(cloud)]) for cloud in clouds), [0])
    assert capfd.readouterr().out == ""


def test_without_open3d_the_classical_pipelines_say_what_to_install(pair, monkeypatch):
    _, source, target, _ = pair
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(CorrmatError, match=r"Open3D.*\[baselines\]"):
        corrmat.register(source, target, model="ransac")
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)
    with pytest.raises(CorrmatError, match=r"KISS-Matcher.*\[baselines\]"):
        corrmat.register(source, target, model="kiss")


@pytest.mark.skipif(BROWSER is None, reason="no Chromium at hand")
def test_the_page_opens_in_a_browser(pair, tmp_path):
    _, source, target, _ = pair
    path = tmp_path / "view.html"
    path.write_text(registration_page(corrmat.register(source, target), source, target))
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=8000"]
    words += ["--enable-logging=stderr", "--dump-dom", path.as_uri()]
    shown = subprocess.run([BROWSER, *words], capture_output=True, text=True, timeout=120)
    assert 'aria-label="from before to after"' in shown.stdout
    assert "aligned, confidence" in shown.stdout
    assert not [line for line in shown.stderr.splitlines() if "Uncaught" in line]
    assert 'class="gl-container"' in shown.stdout


def test_a_doubtful_verdict_says_how_many_matches_agree_and_asks_for_one_unit(pair):
    _, source, target, _ = pair
    sphere = np.random.default_rng(0).normal(size=(2, 500, 3))
    sphere /= np.linalg.norm(sphere, axis=2, keepdims=True)
    said = corrmat.register(*sphere).verdict
    assert "matches agree, " in said
    assert "unit" not in said
    for clouds in ((source, 1000 * target), (1000 * source, target)):
        assert "times as large as the other" in corrmat.register(*clouds).verdict


def test_few_points_are_doubtful_however_well_they_lie():
    triangles = np.random.default_rng(100).normal(size=(2, 3, 3))
    result = corrmat.register(*triangles)
    assert result.confidence < 0.5
    assert result.verdict.startswith("doubtful: ")
    assert "a cloud has only 3 points" in result.verdict


def test_a_masked_array_is_refused(pair):
    _, source, target, _ = pair
    with pytest.raises(CorrmatError, match="a masked array"):
        corrmat.register(np.ma.masked_array(source, source > 0.5), target)


def test_the_last_title_of_an_animation_fits_into_it(pair):
    result = corrmat.register(*np.random.default_rng(0).normal(size=(2, 200, 3)))
    assert (
        animation._title(result, 1.0, 0) == f"doubtful, confidence {as_percent(result.confidence)}"
    )


@pytest.mark.parametrize(
    ("confidence", "words"),
    [
        (0.94, "aligned"),
        (0.93, "probably aligned: why"),
        (0.5, "probably aligned: why"),
        (0.49, "doubtful: why"),
    ],
)
def test_a_verdict_is_a_confidence_in_words(confidence, words):
    assert verdict(confidence, "why") == words


def test_the_help_and_the_document_name_the_confidence_of_aligned():
    assert f'"aligned" from a confidence of {SURE:.0%}'.replace("%", " %") in REGISTER_EPILOG
    document = (Path(__file__).parents[1] / "docs" / "register.md").read_text()
    assert f'`verdict`: "aligned" from {SURE} on' in document


def test_a_network_of_ones_own_registers():
    cloud = make_shape(("test", 3))[0][:200, :3].astype(float)
    network = load_model()
    named, given = (corrmat.register(cloud, cloud + 1, model=m) for m in ("corrmat", network))
    np.testing.assert_array_equal(named.transform, given.transform)
    assert given.model == "InvariantNetwork"
    method = InvariantCorr()
    method.network = network
    assert corrmat.register(cloud, cloud + 1, model=method).confidence == given.confidence
    with pytest.raises(CorrmatError, match=r"corrmat.read_scan reads a file"):
        corrmat.register("a.ply", cloud)


class Fixed(torch.nn.Module):
    """Predicts one transform, and has a part that is not a network."""

    def __init__(self, value):
        super().__init__()
        self.network = torch.nn.Linear(1, 1)
        self.frozen = torch.nn.Linear(1, 1).eval()
        self.value = value

    def forward(self, source, target):
        assert not self.training
        return Prediction(self.value * torch.eye(3)[None], torch.zeros(1, 3))


class Mirrored(torch.nn.Module):
    """Wraps the shipped network, and hands its clouds over changed."""

    def __init__(self):
        super().__init__()
        self.network = load_model()
        self.calls = 0

    def forward(self, source, target):
        self.calls += 1
        return self.network(source.flip(1), target)


def test_a_wrapper_runs_its_own_forward_and_needs_what_its_network_needs(pair):
    wrapper = Mirrored()
    assert corrmat.register(*pair[1:3], model=wrapper).model == "Mirrored"
    assert wrapper.calls == 1
    wrapper.network = load_model("1.2/DCP_corr")
    few = np.random.default_rng(0).normal(size=(5, 3))
    with pytest.raises(CorrmatError, match="needs clouds of at least"):
        corrmat.register(few, few, model=wrapper)


def test_a_network_keeps_its_mode_and_must_not_predict_nonsense():
    network = Fixed(1.0)
    assert corrmat.register(GRID, GRID, model=network).rotation_deg == pytest.approx(0, abs=1e-4)
    assert network.training
    assert network.network.training
    assert not network.frozen.training
    with pytest.raises(CorrmatError, match="has its training diverged"):
        corrmat.register(GRID, GRID, model=Fixed(np.nan))


def test_only_the_shipped_weights_have_a_calibrated_confidence(pair):
    _, source, target, _ = pair
    ways = {"model": "corrmat"}, {"model": "icp"}, {"refine": "none"}
    texts = [result.to_text(corrmat.register(source, target, **way)) for way in ways]
    assert ["not calibrated" in text for text in texts] == [False, True, True]


def test_a_printed_confidence_does_not_reach_a_verdict_that_it_has_not():
    for confidence, shown in ((0.9396, "93%"), (SURE, "94%"), (0.4961, "49%"), (1.0, "100%")):
        assert as_percent(confidence) == shown


def test_the_verification_network_registers_nothing_alone(pair):
    verification = weights.SHIPPED.with_name("verification.safetensors")
    with pytest.raises(CorrmatError, match="registers nothing alone"):
        corrmat.register(*pair[1:3], model=verification)


def test_rough_agreement_is_that_of_all_distances(generator):
    rotation = random_rotation(20, generator)
    translation, (source, target) = torch.zeros(20, 3), torch.randn(2, 40, 6, generator=generator)
    found = rough_agreement(rotation, translation, source, target)
    moved = source[:, :3].double() @ rotation.mT
    distance, nearest = torch.cdist(moved, target[:, :3].double()).min(-1)
    normals = source[:, 3:].double() @ rotation.mT
    parallel = (normals * target[nearest, 3:]).sum(-1).abs()
    expected = (parallel * (1 - (distance / 0.3) ** 2).clamp_min(0)).mean(1)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert (distance.amax(1) > 0.3).all()  # some points have none near


def test_points_that_are_near_on_one_side_are_coherent_and_scattered_ones_are_not():
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(2000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    half, scattered = sphere[sphere[:, 0] > 0], sphere[rng.permutation(2000)[:40]]
    shared = AlignmentScorer(half, sphere).alignment(np.eye(4))
    assert 0.05 < shared.coherence <= 0.25
    assert AlignmentScorer(scattered, sphere).alignment(np.eye(4)).coherence < 0.02
    same = AlignmentScorer(sphere, sphere).alignment(np.eye(4))
    assert same.coherence == 0  # all are near: there is nothing to explain
    assert same.agreement == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("shift", [0.0, 0.07])
def test_points_that_have_one_near_cost_nothing(shift):
    assert unmatched_loss(shift) == 0


@pytest.mark.parametrize("shift", [0.09, 1.0])
def test_the_unmatched_loss_is_the_cross_entropy_of_points_without_one_near(shift):
    # Moved by one, the last source point and the first target point have none; by 0.09, all.
    expected = 0.375 + 3.75 if shift < 1 else 0.8 / 4 + 1.0 / 4
    assert unmatched_loss(shift) == pytest.approx(expected / 2)


def unmatched_loss(shift):
    """Of four points in a row, one apart, under a translation along it."""
    points = np.zeros((4, 3))
    points[:, 0] = range(4)
    nll = np.array([0.1, 0.2, 0.4, 0.8]), np.array([1.0, 2.0, 4.0, 8.0])
    hypotheses = Hypotheses(np.eye(4)[None], np.empty((0, 2), int), np.empty(0), None, nll)
    transform = rigid.to_homogeneous(np.eye(3), np.array([shift, 0, 0]))
    distances = AlignmentScorer(points, points).alignment(transform).distances
    assert hypotheses._replace(unmatched_nll=None).unmatched_loss(distances) == 0
    return hypotheses.unmatched_loss(distances)


def test_only_a_network_with_matchabilities_says_which_points_have_no_match(generator):
    f_x, f_y = (torch.randn(1, n, 8, generator=generator) for n in (5, 7))
    m_x, m_y = (torch.randn(1, n, generator=generator) for n in (5, 7))
    matchable = MatchabilityCorrespondence(f_x, f_y, 1.0, m_x, m_y)
    for nll, logits in zip(unmatched_nll(matchable), (m_x, m_y), strict=True):
        torch.testing.assert_close(torch.from_numpy(nll), -(1 - logits[0].double().sigmoid()).log())
    certain = MatchabilityCorrespondence(f_x, f_y, 1.0, m_x + 50, m_y)
    assert (unmatched_nll(certain)[0] == 8).all()  # the network may be wrong
    assert unmatched_nll(SoftCorrespondence(f_x, f_y)) is None
    assert unmatched_nll(SoftCorrespondence(f_x, f_y, 1.0, m_x)) is None  # of the source alone


def test_the_candidate_of_the_largest_weighted_sum_is_chosen():
    first = choice.Measures(0.5, 0.1, 0.1, 0.5, 0.2)
    measures = [first, choice.Measures(0.6, 0.1, 0.5, 0.2, 0.1), first]
    for others, best in (
        ((0, 0, 0, 0), 1),
        ((0, -1, 0, 0), 0),
        ((0, 0, 0.5, 0), 0),
        ((0, 0, 0, 2), 0),
    ):
        weights = choice.ChoiceWeights(*others, 1.0)
        assert choice.choose(measures, weights, np.zeros_like) == best  # of equal ones, the first


def test_the_verification_network_is_asked_for_the_best_candidates_alone(monkeypatch):
    monkeypatch.setattr(choice, "VERIFIED", 2)
    measures = [choice.Measures(agreement, 0, 0, 0, 0) for agreement in (0.5, 0.6, 0.1)]
    logits, asked = np.array([1.0, -1.0, 9.0]), []

    def verified(some):
        asked.append(set(some.tolist()))
        return logits[some]

    heavy, light = choice.ChoiceWeights(0, 0, 0, 0, 1.0), choice.ChoiceWeights(0, 0, 0, 0, 0.01)
    assert choice.choose(measures, heavy, verified) == 0
    assert choice.choose(measures, light, verified) == 1
    assert choice.choose(measures[:1], heavy, verified) == 0
    assert asked == [{0, 1}] * 2  # one candidate needs no choice


def test_a_transform_that_is_nearly_an_earlier_one_is_dropped():
    def turned(angle, shift=0.0):
        rotation = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        return rigid.to_homogeneous(rotation, np.array([shift, 0, 0]))

    transforms = np.stack([turned(0), turned(3), turned(90), turned(90, 0.2), turned(92, 0.2)])
    np.testing.assert_array_equal(choice.distinct(transforms), transforms[[0, 2, 3]])
    np.testing.assert_array_equal(choice.distinct(transforms[:1]), transforms[:1])


def test_a_coarse_scorer_has_the_first_points():
    cloud = np.random.default_rng(0).normal(size=(COARSE_POINTS + 1, 3))
    scorer = AlignmentScorer(cloud, cloud[:20])
    np.testing.assert_array_equal(scorer.coarse.source, cloud[:-1])
    np.testing.assert_array_equal(scorer.coarse.target, cloud[:20])
    assert scorer.coarse.coarse is scorer.coarse


def test_half_a_turn_of_the_best_candidate_is_a_candidate_too():
    """Where the model offers a box the wrong way round, the right way is a candidate, too."""
    box = np.random.default_rng(0).uniform(-1, 1, (600, 3))
    box[np.arange(600), np.arange(600) % 3] = np.sign(box[:, 0])
    box *= 1.2, 0.8, 0.5
    truth = rigid.to_homogeneous(Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix(), np.ones(3))
    clouds = preparation.prepare_clouds(box, box @ truth[:3, :3].T + truth[:3, 3], 0)
    truth = clouds.from_original_units(truth)
    turns = choice.half_turned(truth, clouds.subsamples)
    half = turns @ np.linalg.inv(truth)
    np.testing.assert_allclose(half @ half, [np.eye(4)] * 3, atol=1e-9)
    np.testing.assert_allclose(np.trace(half, axis1=1, axis2=2), 0, atol=1e-9)
    for turn in turns:
        mistaken = Hypotheses(turn[None], np.empty((0, 2), int), np.empty(0))
        search = choice.CandidateSearch(mistaken, clouds)
        found, measures = search.find(half_turns=True)
        assert len(found) == len(measures) == 4
        assert np.linalg.norm(found - truth, axis=(1, 2)).min() < 0.01
        assert len(search.find(half_turns=False)[0]) == 1


def test_a_guess_is_one_more_candidate(pair):
    """ICP alone starts from the identity, which is too far; from the guess it arrives."""
    _, source, target, truth = pair
    size = np.ptp(source[:, :3], axis=0).max()

    def error(transform):
        offsets = source[:, :3] @ (transform - truth)[:3, :3].T + (transform - truth)[:3, 3]
        return np.linalg.norm(offsets, axis=1).mean() / size

    def about_centroid(rotvec):
        rotation, centre = Rotation.from_rotvec(rotvec).as_matrix(), source[:, :3].mean(0)
        return truth @ rigid.to_homogeneous(rotation, centre - rotation @ centre)

    guess, wrong = about_centroid([0.1, -0.1, 0.1]), about_centroid([2.0, 1.0, 0.0])
    alone = corrmat.register(source, target, model="icp").transform
    guided = corrmat.register(source, target, model="icp", init=guess).transform
    assert error(guided) < 0.02 < error(guess) < error(alone)
    misled = corrmat.register(source, target, init=wrong).transform
    assert error(misled) < 0.02, "a wrong guess does not win"
    worse = corrmat.register(source, target, model="icp", init=wrong).transform
    assert error(worse) > 0.1, "there is no other candidate"


def test_a_guess_of_dense_scans_that_is_right_wins():
    """A few steps on few points take it away, and without it another candidate wins."""
    scans = make_object_pair(5, 20_000, "val")
    truth = rigid.to_homogeneous(scans.rotation, scans.translation)
    alone = corrmat.register(scans.source, scans.target).transform
    guided = corrmat.register(scans.source, scans.target, init=truth).transform
    assert angle_deg(guided[:3, :3], scans.rotation) < 1
    assert angle_deg(alone[:3, :3], scans.rotation) > 5


@pytest.mark.parametrize(
    ("init", "message"),
    [
        (np.eye(3), r"but \(3, 3\)"),
        (np.diag([1.0, 1, -1, 1]), "scales, shears or mirrors"),
        (np.diag([2.0, 2, 2, 1]), "scales, shears or mirrors"),
        (np.full((4, 4), np.nan), "finite"),
        ("a.txt", "init is no matrix"),
    ],
)
def test_a_guess_that_is_not_rigid_is_refused(init, message):
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    with pytest.raises(CorrmatError, match=message):
        corrmat.register(cloud, cloud, init=init)


def test_points_are_taken_as_tensors_too():
    points = np.random.default_rng(0).normal(size=(50, 3))
    tensor = torch.tensor(points, dtype=torch.bfloat16, requires_grad=True)
    expected = corrmat.register(tensor.detach().double().numpy(), points).transform
    np.testing.assert_array_equal(corrmat.register(tensor, points).transform, expected)


def test_a_registration_moves_points():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    rotation = Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix()
    result = corrmat.register(points, points @ rotation.T + 5)
    np.testing.assert_allclose(result.apply(points), points @ rotation.T + 5, atol=1e-5)


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.ones((3, 50)), "transpose it"),
        (np.full((50, 3), np.nan), "leave them out"),
        (np.ones((50, 3), complex), "complex"),
        ((POINTS_AT_HOME + 5e6).astype(np.float32), "have steps of 0.5, too coarse"),
    ],
)
def test_a_cloud_that_cannot_be_used_says_what_to_do(cloud, message):
    with pytest.raises(CorrmatError, match=message):
        corrmat.register(POINTS_AT_HOME, cloud)


def profile(rng, low, high, count):
    """Points of an L, extruded along z, with the noise of a scanner."""
    u = rng.uniform(-2, 1.5, count)
    points = np.stack([np.maximum(u, 0), np.maximum(-u, 0), rng.uniform(low, high, count)], 1)
    return points + rng.normal(0, 0.004, (count, 3))


@pytest.mark.parametrize("count", [1000, 3000])
def test_a_profile_that_may_slide_along_itself_is_doubtful(count):
    """Two thirds overlap; all of it agrees after a shift by the last third, too."""
    rng = np.random.default_rng(0)
    rotation = Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix()
    source, target = profile(rng, 0, 3, count), profile(rng, 1, 4, count)
    result = corrmat.register(source, target @ rotation.T + 1.0)
    axis = rotation[:, 2] * np.sign(rotation[np.abs(rotation[:, 2]).argmax(), 2])
    np.testing.assert_allclose(result.slides_along, axis, atol=0.1)
    assert result.verdict.startswith("doubtful: ")
    assert "sliding along (" in result.verdict
    ended = [np.hstack([rng.uniform(0, 1, (count // 3, 2)), np.full((count // 3, 1), 3.0)])]
    held = corrmat.register(np.vstack([source, *ended]), np.vstack([source, *ended]) @ rotation.T)
    assert held.slides_along is None
    assert held.verdict == "aligned"


@pytest.mark.parametrize("count", [800, 3000])
def test_a_solid_of_revolution_fits_after_any_turn_about_its_axis(count):
    rng = np.random.default_rng(0)
    rotation = Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix()

    def cone():
        height, angle = 1 - np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
        radius = (1 - height) / 2
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)
        return points + rng.normal(0, 0.003, (count, 3))

    found = corrmat.register(cone(), cone() @ rotation.T)
    axis = rotation[:, 2] * np.sign(rotation[np.abs(rotation[:, 2]).argmax(), 2])
    np.testing.assert_allclose(found.turns_about, axis, atol=0.05)
    assert found.slides_along is None
    assert not found.verdict.startswith("doubtful")
    assert "after any turn about (" in result.to_text(found)
    assert json.loads(result.to_json(found, "a", "b"))["turns_about"] == found.turns_about.tolist()
    with_handle = [rng.normal([0.6, 0, 0.3], 0.05, (count // 10, 3))]
    source, target = (np.vstack([cone(), *with_handle]) for _ in range(2))
    assert corrmat.register(source, target @ rotation.T).turns_about is None


def test_a_fragment_of_a_room_that_lies_right_stays_there():
    """EM-ICP alone slides it along its walls."""
    room = make_room_pair(12, 20_000, "val")
    clouds = preparation.prepare_clouds(room.source, room.target, 0)
    assert [len(scorer.source) for scorer in clouds.scorers] == [*preparation.LEVELS]
    hypotheses = NetworkHypotheses(load_model())(*clouds.subsamples, 0)
    right = clouds.from_original_units(rigid.to_homogeneous(room.rotation, room.translation))
    slid = em_icp(right, *clouds.subsamples, hypotheses.prob)
    assert moved_m(room, clouds.to_original_units(slid)) > 0.1
    refined = choice.CandidateSearch(hypotheses, clouds).refine_chosen(right)
    assert moved_m(room, clouds.to_original_units(refined)) < 0.01


def test_the_choice_is_by_agreement_coherence_unmatched_loss_and_support(pair):
    """Of the truth and a half turn, put first, the truth wins, and by each measure's own weight."""
    _, source, target, truth = pair
    clouds = preparation.prepare_clouds(source, target, 0)
    hypotheses = NetworkHypotheses(load_model())(*clouds.subsamples, 0)
    prepared = clouds.from_original_units(truth)
    np.testing.assert_allclose(clouds.to_original_units(prepared), truth, atol=1e-9)
    transforms = np.stack([prepared] * 2)
    transforms[0, :3, :3] @= np.diag([-1.0, -1.0, 1.0])
    search = choice.CandidateSearch(hypotheses, clouds)
    wrong, right = measures = search.measure(transforms)
    better = np.sign([1.0, *choice.CHOICE_WEIGHTS[:-1]]) * np.subtract(right, wrong)
    assert (better[[0, 2, 3]] > 0).all()
    assert choice.choose(measures, choice.CHOICE_WEIGHTS, np.zeros_like) == 1
    wrongly, rightly = search.verify(transforms)
    assert rightly > wrongly
    assert not verify(transforms, hypotheses._replace(verification=None), clouds.subsamples).any()


def test_more_matches_say_what_the_strongest_do_not(monkeypatch):
    """Where two scans share little, the strongest matches may all be wrong."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(700, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    source = np.hstack([normals * (0.6, 0.8, 1.0), normals])
    truth = rigid.to_homogeneous(Rotation.random(rng=rng).as_matrix(), np.array([0.2, 0.1, 0.0]))
    target = np.hstack([rigid.move(truth, source[:, :3]), source[:, 3:] @ truth[:3, :3].T])
    prob = torch.zeros(700, 700)
    prob[range(256), rng.permutation(256)] = 0.9
    prob[range(256, 700), range(256, 700)] = 0.5

    def nearest():
        found = generation.from_many_matches(prob, source, target, 0)
        return np.linalg.norm(found - truth, axis=(1, 2)).min()

    assert nearest() < 0.05
    monkeypatch.setattr(generation, "_MANY", 256)
    assert nearest() > 0.3


def registered(room):
    return corrmat.register(room.source, room.target).transform


def moved_m(room, transform):
    """How far a transform takes the source of two fragments from its true place, in metres."""
    off = transform - rigid.to_homogeneous(room.rotation, room.translation)
    return np.linalg.norm(room.source @ off[:3, :3].T + off[:3, 3], axis=1).mean()


def test_a_room_whose_matches_are_wrong_is_registered_by_phase_correlation(monkeypatch):
    """Without it, this fragment comes out metres away."""
    room = make_room_pair(208, 20_000, "val")
    assert moved_m(room, registered(room)) < 0.02
    monkeypatch.setattr(choice.CandidateSearch, "phase_correlation", None)
    assert moved_m(room, registered(room)) > 1


def test_large_clouds_that_have_nothing_in_common_are_doubtful():
    rooms = [make_room_pair(index, 20_000, "val") for index in (0, 1)]
    thing = make_object_pair(0, 20_000, "val")
    for other in (rooms[1], thing):
        assert corrmat.register(rooms[0].source, other.target).verdict.startswith("doubtful")


def test_a_small_scan_of_a_large_one_is_judged_as_small_clouds_are():
    """The curve of large clouds calls such a pair "probably aligned" at best."""
    scans = make_object_pair(0, 20_000, "val")
    large, small = (corrmat.register(scans.source[:n], scans.target) for n in (None, 300))
    assert large.verdict == small.verdict == "aligned"
    assert None not in large.scores
    assert small.scores.coherence is small.scores.correlation is None
    for found in (large, small):
        assert angle_deg(found.transform[:3, :3], scans.rotation) < 1


def test_the_chosen_candidate_of_a_room_is_shifted_before_it_is_refined(monkeypatch):
    """As it is, generalised ICP takes it along a wall."""
    room = make_room_pair(418, 20_000, "val")
    assert moved_m(room, registered(room)) < 0.02
    monkeypatch.setattr(PhaseCorrelation, "shifted", lambda self, transform: transform)
    assert moved_m(room, registered(room)) > 0.1
