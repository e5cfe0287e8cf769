"""docs/architecture.md's recipes of steps, each followed as a newcomer would."""

import dataclasses
import errno
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass

import lightning as L
import numpy as np
import pytest
import torch
import yaml
from conftest import ROOT
from torch import nn

from corrmat import RegistrationDataModule
from corrmat.cli import exit_code
from corrmat.data import registry
from corrmat.data.clouds import CloudSet
from corrmat.errors import CorrmatError
from corrmat.losses import CorrespondenceLoss, IterationSettings
from corrmat.methods import METHODS, DCPCorr, Method
from corrmat.module import OptimizerSettings
from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.ops.rigid import procrustes
from corrmat.training import experiment, recipe
from corrmat.training.preflight import prepare
from corrmat.types import Prediction
from corrmat.weights import load_model


class MineNetwork(nn.Module):
    """A network of somebody's own: features of single points."""

    min_points = 3

    def __init__(self, width: int = 8, broken: bool = False) -> None:
        super().__init__()
        if width > 1000:
            raise ValueError("my own limit")
        self.embed = nn.Linear(3, width)
        self.broken = broken

    def forward(self, source, target):
        if self.broken:
            raise RuntimeError("my own mistake")
        x, y = source[..., :3], target[..., :3]
        correspondence = SoftCorrespondence(self.embed(x), self.embed(y), 1.0)
        return Prediction(*procrustes(x, correspondence.soft_target(y)), correspondence)


@dataclass(frozen=True)
class SharpSettings(IterationSettings):
    sharpness: float = 2.0


class SharpLoss(CorrespondenceLoss):
    LossSettings = SharpSettings
    loss_settings: SharpSettings = SharpSettings()

    def loss(self, prediction, batch):
        return self.loss_settings.sharpness * super().loss(prediction, batch)


class MineCorr(SharpLoss, Method):
    network_type = MineNetwork
    paper_optimizer = OptimizerSettings(1e-3)


class WrongOrder(Method, CorrespondenceLoss):
    network_type = MineNetwork
    paper_optimizer = OptimizerSettings(1e-3)


def load_mine(split, count=None, root=None):
    rows = np.random.default_rng(0).normal(size=(count or 12, 64, 6)).astype(np.float32)
    rows[..., :3] /= 2 * np.abs(rows[..., :3]).max()
    rows[..., 3:] /= np.linalg.norm(rows[..., 3:], axis=-1, keepdims=True)
    return CloudSet(rows, np.zeros(len(rows), np.int64), ("mine",))


@pytest.fixture
def mine(monkeypatch, tmp_path):
    """A recipe of a method and a data set of one's own."""
    for cls in (MineCorr, WrongOrder):
        monkeypatch.setitem(METHODS, cls.__name__, cls)
    monkeypatch.setitem(registry.DATASETS, "mine", load_mine)

    def load(method="MineCorr", **network):
        content = {
            "id": "mine",
            "title": "a method of my own",
            "arms": {method: {}},
            "data": {"data": "mine", "num_points": 16, "batch_size": 2},
            "network": network,
            "loss": {"sharpness": 3.0} if method == "MineCorr" else {},
            "optimizer": {"schedule": "onecycle"},
            "trainer": {"max_steps": 4, "enable_progress_bar": False, "accelerator": "cpu"},
        }
        path = tmp_path / "mine.yaml"
        path.write_text(yaml.safe_dump(content))
        return recipe.load(path, "smoke")

    return load


def test_the_method_of_architecture_md_runs(tmp_path, monkeypatch):
    """The file and the recipe, as they stand there."""
    text = (ROOT / "docs" / "architecture.md").read_text()
    section = text[text.index("## A method of your own") :]
    for name, kind in (("mine.py", "python"), ("mine.yaml", "yaml")):
        (tmp_path / name).write_text(re.search(f"```{kind}\n(.*?)```", section, re.DOTALL)[1])
    words = ["run", "--config", "mine.yaml", "--scale", "smoke", "--logger", "none"]
    environment = {**os.environ, "CORRMAT_CACHE": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "mine.py", *words], cwd=tmp_path, env=environment, check=True)
    record = tmp_path / "results/smoke/shapes/mine/metrics.json"
    assert json.loads(record.read_text())["treatment"] == "MineCorr"


def test_a_method_a_data_set_and_a_loss_setting_of_ones_own_leave_a_record(mine, tmp_path):
    record = experiment.run(mine(width=6), tmp_path / "results", tmp_path / "runs", "none")
    assert (record.data, record.treatment, record.baseline) == ("mine", "MineCorr", None)
    folder = tmp_path / "results/smoke/mine/mine"
    config = yaml.safe_load((folder / "config.yaml").read_text())["arms"]["MineCorr"]
    assert config["loss"] == {"discount": 0.5, "sharpness": 3.0}
    assert (folder / "matches.png").is_file()
    checkpoint = tmp_path / "runs/smoke/mine/mine/MineCorr/best.ckpt"
    method = MineCorr.load_from_checkpoint(checkpoint)
    assert method.network.embed.out_features == 6
    assert method.loss_settings.sharpness == 3.0
    network = load_model(checkpoint)
    assert torch.equal(network.embed.weight, method.network.embed.weight)


def test_a_mistake_inside_a_network_keeps_its_traceback(mine):
    with pytest.raises(ValueError, match="my own limit"):
        prepare(mine(width=1001).arms["MineCorr"])
    settings = mine(broken=True).arms["MineCorr"]
    with pytest.raises(RuntimeError, match="my own mistake") as caught:
        prepare(settings)
    assert caught.traceback[-1].name == "forward"
    assert not isinstance(caught.value, CorrmatError)


@pytest.mark.parametrize(
    ("error", "code"), [(OSError(errno.ENOSPC, "no space left"), 2), (FileNotFoundError(), None)]
)
def test_only_a_file_that_cannot_be_written_is_a_line(error, code, capsys):
    """A missing file may be one that a network of the user's own reads."""

    def run():
        raise error

    if code is None:
        with pytest.raises(type(error)):
            exit_code(run)
    else:
        assert exit_code(run) == code
        assert "no space left" in capsys.readouterr().err


def test_a_loss_mixin_behind_the_module_is_named(mine):
    with pytest.raises((NotImplementedError, TypeError), match="loss") as caught:
        prepare(mine("WrongOrder").arms["WrongOrder"])
    assert not isinstance(caught.value, CorrmatError)


def test_a_checkpoint_is_all_that_a_lightning_user_needs(mine, tmp_path):
    """A plain Trainer, `load_from_checkpoint`, `trainer.test`: logged and reset."""
    torch.manual_seed(0)
    data = RegistrationDataModule(data="mine", num_points=32, batch_size=4, keep=0.8)
    method = DCPCorr({"width": 16, "feedforward": 16, "edge_channels": (8, 8), "k": 4})
    trainer = L.Trainer(
        max_steps=3, logger=False, enable_progress_bar=False, accelerator="cpu",
        default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(method, data)
    path = tmp_path / "best.ckpt"
    trainer.save_checkpoint(path)
    assert torch.load(path, weights_only=True)["hyper_parameters"]["network"]["width"] == 16
    loaded = DCPCorr.load_from_checkpoint(path)
    first, second = (trainer.test(loaded, data, verbose=False)[0] for _ in range(2))
    assert first == pytest.approx(second, rel=0, abs=0, nan_ok=True)
    assert {"test/rotation_error_deg_mean", "test/match_accuracy"} <= set(first)
    assert first["test/rotation_error_deg_mean"] == pytest.approx(
        trainer.test(method, data, verbose=False)[0]["test/rotation_error_deg_mean"]
    )
    assert dataclasses.asdict(loaded.loss_settings) == {"discount": 0.5}
