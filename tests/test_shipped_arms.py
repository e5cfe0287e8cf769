"""Trained arms in the package: they load, and they match what their records say."""

import json
import shutil
import sys
import types

import pytest
import safetensors.torch
import torch
from conftest import ROOT

import corrmat
from corrmat import weights
from corrmat.cli import main
from corrmat.data.datamodule import PairDataset, RegistrationDataModule
from corrmat.errors import CorrmatError
from corrmat.metrics import RegistrationMetrics
from corrmat.reporting.intervals import read_errors
from corrmat.reporting.record import read_record
from corrmat.training import experiment, recipe, shipping
from corrmat.training.preflight import prepare

PAIRS = 16  # of a test


def load(identity, scale="smoke"):
    return recipe.load(ROOT / "configs" / "exp" / f"{identity}.yaml", scale)


def test_a_recorded_arm_is_shipped_and_loads_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "shipped" / "corrmat.safetensors")
    loaded, results, runs = load("1.2"), tmp_path / "results", tmp_path / "runs"
    assert shipping.ship_arms(loaded, results, runs) == []  # no record, nothing to ship
    experiment.run(loaded, results, runs, "none")
    assert shipping.ship_arms(loaded, results, runs) == ["1.2/DCP", "1.2/DCP_corr"]
    assert weights.shipped_models() == ["1.2/DCP", "1.2/DCP_corr"]
    network = corrmat.load_model("1.2/DCP_corr")
    checkpoint = runs / loaded.place / "DCP_corr" / "best.ckpt"
    state = torch.load(checkpoint, weights_only=True)["state_dict"]
    assert all(torch.equal(v, state[f"network.{k}"]) for k, v in network.state_dict().items())
    about = weights.shipped_metadata("1.2/DCP_corr")
    assert about["record"] == "smoke/shapes/1.2"
    assert json.loads(about["network"])["width"] == 32
    with pytest.raises(CorrmatError, match="neither corrmat, 1.2/DCP, 1.2/DCP_corr"):
        corrmat.load_model("1.2/PCRNet")
    path = ROOT / "configs" / "exp" / "1.2.yaml"
    other = recipe.load(path, "smoke", {"data": {"name": "mine"}})
    for folder in (results, runs):
        shutil.copytree(folder / loaded.place, folder / other.place)
    assert shipping.ship_arms(other, results, runs) == []  # the package has weights of shapes
    monkeypatch.setattr(shipping, "_shipped_scale", lambda model: recipe.SCALES.index("laptop"))
    assert shipping.ship_arms(loaded, results, runs) == []  # weights of a larger scale are kept


SLOW = ("2.1", "2.3")  # the same network as 2.2's, half a second a pair
MODELS = [
    pytest.param(model, marks=[pytest.mark.slow] if model.startswith(SLOW) else [])
    for model in weights.shipped_models()
]


@pytest.mark.parametrize("model", MODELS)
def test_a_shipped_arm_matches_as_its_record_says(model):
    about = weights.shipped_metadata(model)
    folder = ROOT / "results" / about["record"]
    record = read_record(folder / "metrics.json")
    assert record.data == "shapes"
    settings = load(record.id, record.scale).arms[about["arm"]]
    few = settings.data.as_dict() | {"test_shapes": PAIRS}  # of which the pairs are the same
    module = RegistrationDataModule(**few, seed=settings.seed)
    dataset = module.test_dataloader().dataset
    assert isinstance(dataset, PairDataset)
    batch = dataset.__getitems__([(0, i) for i in range(PAIRS)])
    metrics = RegistrationMetrics()
    with torch.inference_mode():
        metrics.update(corrmat.load_model(model)(batch.source, batch.target), batch)
    values = metrics.per_pair()
    correct, matchable = values["num_correct"], values["num_matchable"]
    expected = read_errors(folder / "per_pair.csv")[about["arm"]]
    assert int(matchable.sum()) == expected.num_matchable[:PAIRS].sum()
    share = float(correct.sum() / matchable.sum())
    recorded = expected.num_correct[:PAIRS].sum() / expected.num_matchable[:PAIRS].sum()
    assert share == pytest.approx(recorded, abs=1e-3)


@pytest.mark.parametrize("model", ["corrmat", "1.2/DCP_corr"])
def test_an_exported_model_is_loaded_from_its_folder_and_from_the_hub(model, tmp_path, monkeypatch):
    assert main(["export", str(tmp_path / "mine"), "--model", model]) == 0
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {
        "README.md", "config.json", "model.safetensors",
    }  # fmt: skip
    assert (tmp_path / "mine" / "README.md").read_text().startswith("---\nlibrary_name: corrmat")
    original = corrmat.load_model(model).state_dict()
    asked = []

    def download(repository, filename):
        asked.append(repository)
        return str(tmp_path / "mine" / filename)

    hub = types.SimpleNamespace(hf_hub_download=download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    for place in (tmp_path / "mine", "hf:somebody/mine"):
        loaded = corrmat.load_model(place).state_dict()
        assert all(torch.equal(loaded[name], original[name]) for name in original)
    assert asked == ["somebody/mine"]


def test_what_cannot_be_exported_or_loaded_is_said(tmp_path, monkeypatch):
    with pytest.raises(CorrmatError, match="no model '1.2/DPC': neither corrmat, 1.1/"):
        weights.export_model("1.2/DPC", tmp_path)
    weights.export_model("2.1/RPMNet", tmp_path / "exported")
    with pytest.raises(CorrmatError, match="is an exported model already"):
        weights.export_model(tmp_path / "exported", tmp_path / "again")
    safetensors.torch.save_file({"x": torch.zeros(1)}, tmp_path / "model.safetensors")
    with pytest.raises(CorrmatError, match="is no model of corrmat"):
        corrmat.load_model(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(CorrmatError, match="is no model of corrmat"):
        corrmat.load_model(tmp_path)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(CorrmatError, match="pip install huggingface_hub"):
        corrmat.load_model("hf:somebody/mine")

    def unreachable(repository, filename):
        raise OSError("no network\nmore")

    hub = types.SimpleNamespace(hf_hub_download=unreachable)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    with pytest.raises(CorrmatError, match="hf:somebody/mine cannot be downloaded: no network"):
        corrmat.load_model("hf:somebody/mine")
    hub.hf_hub_download = lambda *_: (_ for _ in ()).throw(OSError())
    with pytest.raises(CorrmatError, match="hf:somebody/mine cannot be downloaded: OSError"):
        corrmat.load_model("hf:somebody/mine")


def test_weights_that_the_record_was_not_tested_with_are_not_shipped(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "shipped" / "corrmat.safetensors")
    results, runs = tmp_path / "results", tmp_path / "runs"
    loaded = load("1.2")
    experiment.run(loaded, results, runs, "none")
    arm = prepare(load("1.2").arms["DCP_corr"])
    experiment.train_or_reuse(loaded, arm, runs, "none", fresh=True)  # anew, without a record
    assert shipping.ship_arms(loaded, results, runs) == ["1.2/DCP"]


def test_a_checkpoint_is_exported_as_well(tmp_path):
    loaded = load("1.2")
    trained = experiment.train_or_reuse(loaded, prepare(loaded.arms["DCP_corr"]), tmp_path, "none")
    assert main(["export", str(tmp_path / "mine"), "--model", str(trained.checkpoint)]) == 0
    mine, theirs = (corrmat.load_model(m) for m in (tmp_path / "mine", trained.checkpoint))
    state = theirs.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in mine.state_dict().items())
    card = (tmp_path / "mine" / "README.md").read_text()
    assert "DCP_corr" in card
    assert "3DV" not in card
