"""The learning-rate sweep, and that the recipes train at the rates that it chose."""

import json
import math

import pytest
from conftest import ROOT

from corrmat.errors import CorrmatError, DivergedError
from corrmat.reporting import documents
from corrmat.training import rates, recipe
from corrmat.training.runs import TrainedArm

SWEPT = sorted((ROOT / "results" / "rates").glob("*/*/*.json"))


def load(identity, scale):
    return recipe.load(ROOT / "configs" / "exp" / f"{identity}.yaml", scale)


def test_every_arm_is_trained_at_the_same_three_factors_and_the_best_is_chosen(tmp_path):
    swept = rates.sweep(load("1.2", "smoke"), tmp_path / "results", tmp_path / "runs")
    record = json.loads((tmp_path / "results/rates/smoke/shapes/1.2.json").read_text())
    assert list(record["arms"]) == ["DCP", "DCP_corr"]
    for arm, results in swept.items():
        assert [rate.lr for rate in results] == [0.00067, 0.002, 0.006]
        assert len({rate.rotation_error_deg_mean for rate in results}) > 1  # the rate was used
        best = min(results, key=lambda rate: rate.rotation_error_deg_mean)
        assert record["arms"][arm]["chosen"] == best.lr


def test_a_sweep_validates_at_its_end_whatever_a_step_is(tmp_path):
    trainer = {"accumulate_grad_batches": 2, "max_steps": 60}
    overrides = {"trainer": trainer, "data": {"batch_size": 6}}
    loaded = recipe.load(ROOT / "configs" / "exp" / "1.2.yaml", "smoke", overrides)
    swept = rates.sweep(loaded, tmp_path / "results", tmp_path / "runs")
    assert {rate.pairs_seen for results in swept.values() for rate in results} == {3 * 2 * 6}


def test_an_arm_at_a_steady_rate_keeps_the_papers(tmp_path):
    with pytest.raises(CorrmatError, match="no arm with a rate to choose"):
        rates.sweep(load("1.2", "paper"), tmp_path, tmp_path)


@pytest.mark.parametrize("path", SWEPT, ids=lambda path: path.stem)
@pytest.mark.parametrize("scale", ["laptop", "overnight"])
def test_the_recipes_train_at_the_chosen_rates(path, scale):
    arms = load(path.stem, scale).arms
    for arm, result in json.loads(path.read_text())["arms"].items():
        assert arms[arm].optimizer.lr == pytest.approx(result["chosen"], rel=0.02)


def test_there_is_a_sweep_of_every_family():
    assert {"1.2", "1.3", "2.2", "3.2", "outliers"} <= {path.stem for path in SWEPT}


def rate(lr, error):
    return rates.RateResult(lr, error, 1.0, 100, None)


def test_a_rate_that_diverged_is_not_chosen():
    assert rates.chosen([rate(1.0, None), rate(2.0, 5.0), rate(3.0, 9.0)]) == 2.0
    assert rates.chosen([rate(1.0, None), rate(2.0, None)]) is None


def test_a_rate_that_diverges_does_not_end_the_sweep(tmp_path, monkeypatch):
    def diverge_at_the_highest(recipe, arm, *others, **options):
        if arm.name.endswith("-0.006"):
            raise DivergedError("the loss is nan")
        curve = [{"rotation_error_deg_mean": arm.settings.optimizer.lr, "loss": math.nan}]
        return TrainedArm(tmp_path, 48, 1.0, None, curve)

    monkeypatch.setattr(rates, "train_or_reuse", diverge_at_the_highest)
    rates.sweep(load("1.2", "smoke"), tmp_path / "results", tmp_path / "runs")
    text = (tmp_path / "results/rates/smoke/shapes/1.2.json").read_text()
    assert "NaN" not in text
    arm = json.loads(text)["arms"]["DCP_corr"]
    assert arm["chosen"] == 0.00067
    assert [each["rotation_error_deg_mean"] for each in arm["rates"]] == [0.00067, 0.002, None]
    assert "0.006: diverged" in documents.rates_table(tmp_path / "results")


def test_an_arm_that_diverges_at_every_rate_costs_no_other_its_record(tmp_path, monkeypatch):
    def diverge(recipe, arm, *others, **options):
        if arm.name.startswith("DCP_corr"):
            raise DivergedError("the loss is nan")
        curve = [{"rotation_error_deg_mean": 1.0, "loss": 1.0}]
        return TrainedArm(tmp_path, 48, 1.0, None, curve)

    monkeypatch.setattr(rates, "train_or_reuse", diverge)
    with pytest.raises(CorrmatError, match="DCP_corr: training diverged at every rate: 0.00067"):
        rates.sweep(load("1.2", "smoke"), tmp_path / "results", tmp_path / "runs")
    arms = json.loads((tmp_path / "results/rates/smoke/shapes/1.2.json").read_text())["arms"]
    assert arms["DCP"]["chosen"] == 0.00067
    assert arms["DCP_corr"]["chosen"] is None
    assert "diverged" in documents.rates_table(tmp_path / "results")


def test_a_budget_in_epochs_has_no_twentieth(tmp_path):
    overrides = {"trainer": {"max_epochs": 20}}
    loaded = recipe.load(ROOT / "configs" / "exp" / "1.2.yaml", "smoke", overrides)
    with pytest.raises(CorrmatError, match="no --trainer.max_steps"):
        rates.sweep(loaded, tmp_path, tmp_path)
