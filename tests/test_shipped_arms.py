"""Trained arms in the package: they load, and they match what their records say."""

import json

import pytest
import torch
from conftest import ROOT

import corrmat
from corrmat import weights
from corrmat.data.datamodule import PairDataset
from corrmat.errors import CorrmatError
from corrmat.metrics import RegistrationMetrics
from corrmat.reporting.intervals import read_errors
from corrmat.reporting.record import read_record
from corrmat.training import experiment, recipe, shipping
from corrmat.training.preflight import prepare

PAIRS = 100  # of a test


def load(identity, scale="smoke"):
    return recipe.load(ROOT / "configs" / "exp" / f"{identity}.yaml", scale)


def test_a_recorded_arm_is_shipped_and_loads_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "shipped" / "corrmat.safetensors")
    loaded, results, runs = load("1.2"), tmp_path / "results", tmp_path / "runs"
    assert shipping.ship(loaded, results, runs) == []  # no record, nothing to ship
    experiment.run(loaded, results, runs, "none")
    assert shipping.ship(loaded, results, runs) == ["1.2/DCP", "1.2/DCP_corr"]
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


@pytest.mark.parametrize("model", weights.shipped_models())
def test_a_shipped_arm_matches_as_its_record_says(model):
    about = weights.shipped_metadata(model)
    folder = ROOT / "results" / about["record"]
    record = read_record(folder / "metrics.json")
    assert record.data == "shapes"
    arm = prepare(load(record.id, record.scale).arms[about["arm"]])
    dataset = arm.datamodule.test_dataloader().dataset
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
