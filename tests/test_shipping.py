import json
import shutil

import pytest
import torch

from corrmat import load_model, weights
from corrmat.calibration import Scores, shipped_calibration
from corrmat.errors import CorrmatError
from corrmat.methods import InvariantCorr
from corrmat.registration import calibrate, shipping, verification_training
from corrmat.registration.verification_training import train_verification
from corrmat.weights import load_verification

FACTS = {"pairs_seen": 400, "train_seconds": 2.0, "commit": "abc", "curve": [{"loss": 1.0}]}
NETWORK = {"width": 32, "heads": 2, "layers": 1, "anchors": 8, "neighbors": 4}


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    method = InvariantCorr(NETWORK)
    content = {"state_dict": method.state_dict(), "hyper_parameters": dict(method.hparams)}
    method.on_save_checkpoint(content)
    torch.save(content, tmp_path / "last.ckpt")
    return tmp_path / "last.ckpt"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the shipped weights, few shapes and a calibration of few pairs."""
    copy = tmp_path / "package" / weights.SHIPPED.name
    copy.parent.mkdir()
    shutil.copy(weights.SHIPPED, copy)
    monkeypatch.setattr(weights, "SHIPPED", copy)
    monkeypatch.setattr(calibrate, "CALIBRATION_PAIRS", {512: 3})
    monkeypatch.setattr(calibrate, "CALIBRATION_SCANS", 2)
    monkeypatch.setattr(calibrate, "CALIBRATION_UNRELATED", 2)
    monkeypatch.setattr(calibrate, "SCAN_POINTS", 6000)
    monkeypatch.setattr("corrmat.data.shapes.dataset.SIZE", {"train": 80, "test": 10})
    monkeypatch.setattr("corrmat.data.shapes.dataset.ASSEMBLIES", {"train": 20, "test": 10})
    return copy


def test_a_checkpoint_becomes_the_weights_of_the_package(checkpoint, package, tmp_path, capsys):
    before = int(weights.shipped_metadata()["pairs"])
    shipping.ship(checkpoint, FACTS, tmp_path / "results", start="corrmat", seed=7)
    assert package.name in capsys.readouterr().out
    header = weights.shipped_metadata()
    assert header["method"] == "Invariant_corr"
    assert json.loads(header["network"]) == NETWORK
    assert int(header["pairs"]) == before + 400
    (run,) = json.loads((tmp_path / "results" / "register" / "training.json").read_text())
    assert (run["before"], run["pairs"], run["curve"]) == (before, before + 400, [{"loss": 1.0}])
    assert set(run["validation"]) == {"real", "views", "clean", "dense", "rooms"}
    calibration = shipped_calibration()
    assert [*map(len, (calibration.both, calibration.large, calibration.agreement))] == [3, 4, 2]
    assert 0 < calibration.confidence(Scores(0.5, 0.5)) < 1
    assert 0 < calibration.confidence(Scores(0.5, 0.5, 0.1, 0.3)) < 1
    trained, shipped = load_model(checkpoint).state_dict(), load_model().state_dict()
    assert trained.keys() == shipped.keys()
    assert all(torch.equal(trained[key], shipped[key]) for key in trained)


def test_a_new_calibration_keeps_the_weights(package, capsys):
    before, fitted = load_model().state_dict(), shipped_calibration()
    shipping.recalibrate()
    assert shipped_calibration() != fitted
    assert "calibrated; within 5 degrees on held-out pairs: real" in capsys.readouterr().out
    assert all(torch.equal(before[key], value) for key, value in load_model().state_dict().items())


def test_nothing_is_shipped_before_its_calibration_is_done(checkpoint, package, monkeypatch):
    before = package.read_bytes()

    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(shipping, "calibrate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        shipping.ship(checkpoint, FACTS, package.parent / "results", start="corrmat", seed=7)
    assert package.read_bytes() == before
    assert [path.name for path in package.parent.iterdir()] == [package.name]


def test_weights_that_start_from_others_have_only_their_own_pairs(
    checkpoint, package, tmp_path, monkeypatch
):
    monkeypatch.setattr(shipping, "calibrate", lambda model: ({}, {}))
    shipping.ship(checkpoint, FACTS, tmp_path / "results", start=None, seed=7)
    assert int(weights.shipped_metadata()["pairs"]) == 400
    shipping.refuse_used_seed(tmp_path / "results", 8)
    with pytest.raises(CorrmatError, match="trained with seed 7"):
        shipping.refuse_used_seed(tmp_path / "results", 7)


def test_a_shape_gives_one_held_out_pair_at_most(package, monkeypatch):
    monkeypatch.setattr("corrmat.data.shapes.dataset.SIZE", {"train": 1200, "test": 10})
    pairs = calibrate.held_out_pairs("clean", 10_000, seed=0, points=16)
    assert 100 < len(pairs) == len(set(pairs.shape.tolist()))


def test_the_calibration_finds_the_chance_that_made_the_pairs():
    generator = torch.Generator().manual_seed(0)
    agreement, support = torch.rand(2, 4000, generator=generator, dtype=torch.float64)
    logit = 6 * agreement + 3 * support - 4
    right = (torch.rand(4000, generator=generator) < torch.sigmoid(logit)).double()
    scores = torch.stack([agreement, support], 1).numpy()
    fitted = torch.tensor(calibrate._fit_logistic(scores, right.numpy()))
    torch.testing.assert_close(fitted, torch.tensor([6.0, 3.0, -4.0]), rtol=0.15, atol=0)


def test_the_verification_network_is_trained_goes_on_and_ships(package, tmp_path, monkeypatch):
    """Smoke: two steps; the second call finds the candidates made and the training done."""
    calibrated = []
    monkeypatch.setattr(verification_training, "recalibrate", lambda: calibrated.append(True))
    monkeypatch.setattr(verification_training, "BATCH_PAIRS", 1)
    options = {"runs": tmp_path / "runs", "data": "shapes", "pairs": 6, "steps": 2, "workers": 0}
    train_verification(**options)
    assert load_verification(load_model()) is None, "a trial does not ship"
    for name in ("data", "pairs", "steps"):
        monkeypatch.setattr(verification_training, name.upper(), options[name])
    train_verification(**options)
    verification = load_verification(load_model())
    assert verification is not None
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("1-0-6.pt")}
    assert len(made) == 1
    train_verification(**options)
    assert made == {path: path.stat().st_mtime_ns for path in made}
    again = load_verification(load_model())
    assert all(map(torch.equal, verification.parameters(), again.parameters()))
    assert calibrated == [True, True]
