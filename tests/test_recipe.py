import pytest
import yaml
from conftest import ROOT

from corrmat import recipe
from corrmat.errors import CorrmatError
from corrmat.experiment import bands, make_datamodule, make_module
from corrmat.methods import METHODS

RECIPES = sorted((ROOT / "configs" / "exp").glob("*.yaml"))


@pytest.mark.parametrize("scale", recipe.SCALES)
@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.stem)
def test_every_recipe_builds_at_every_scale(path, scale):
    found = recipe.load(path, scale, [])
    assert found.id == path.stem
    first, second, *others = found.settings.values()
    assert list(found.paper) == list(found.settings)[:2]
    assert bool(others) == (path.stem in ("2.1", "2.4", "outliers"))
    for settings in found.settings.values():
        assert isinstance(make_module(settings), METHODS[settings.method])
        pairs = settings.data.as_dict() | {"batch_size": None}
        assert pairs == first.data.as_dict() | {"batch_size": None}
    if path.stem.startswith("3"):
        return  # PCRNet regresses a pose, PCRNet_corr cannot
    assert first.data == second.data
    for settings in found.settings.values():
        own = {k: v for k, v in settings.network.as_dict().items() if k != "outlier"}
        assert own.items() <= first.network.as_dict().items()


@pytest.mark.parametrize(
    "scale", ["smoke", *(pytest.param(s, marks=pytest.mark.slow) for s in ("laptop", "paper"))]
)
@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.stem)
def test_the_frozen_test_pairs_are_the_recipes(path, scale):
    found = recipe.load(path, scale, [])
    for settings in found.settings.values():
        made = make_datamodule(settings).checksum(bands(found.bands_deg))
        assert made == found.test_pairs


def test_a_checksum_is_only_for_the_pairs_that_it_was_made_of():
    path = ROOT / "configs" / "exp" / "1.2.yaml"
    known = recipe.load(path, "smoke", []).test_pairs
    assert known
    assert recipe.load(path, "smoke", ["--data.batch_size", "2"]).test_pairs == known
    for options in (["--seed", "1"], ["--data.keep=0.5"], ["--data.test_shapes", "7"]):
        assert recipe.load(path, "smoke", options).test_pairs is None
    assert recipe.load(path, "smoke", ["--data.data", "modelnet40"]).test_pairs is None


@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.stem)
def test_every_recipe_has_a_script_and_a_make_target(path):
    target = path.stem if path.stem == "outliers" else f"exp{path.stem}"
    script = ROOT / "reproduce" / f"{target.replace('.', '_')}.py"
    assert f'reproduce("{path.stem}")' in script.read_text()
    assert target in (ROOT / "Makefile").read_text()


def test_the_papers_settings_are_to_the_letter():
    found = recipe.load(ROOT / "configs" / "exp" / "1.2.yaml", "paper", []).settings["DCP_corr"]
    assert make_module(found).network.embed.k == 20
    assert (found.data.num_points, found.data.batch_size, found.data.keep) == (512, 16, 0.7)
    assert (found.optimizer.lr, found.optimizer.weight_decay) == (1e-3, 1e-4)
    assert found.optimizer.milestones == (25, 50, 100, 150, 200)
    assert found.trainer.max_epochs == 250
    size = sum(p.numel() for p in make_module(found).parameters())
    assert round(size / 1e6, 2) == 5.57


def test_layers_lie_over_each_other(tmp_path):
    (tmp_path / "base.yaml").write_text(
        yaml.safe_dump(
            {
                "arms": {"DCP": {"optimizer": {"lr": 0.5}}, "DCP_corr": {}},
                "data": {"num_points": 1000, "keep": 0.9},
                "scales": {"smoke": {"data": {"num_points": 100}, "optimizer": {"lr": 0.1}}},
            }
        )
    )
    path = tmp_path / "x.yaml"
    path.write_text("id: x\ntitle: t\nbase: base.yaml\ndata: {keep: 0.8}\n")
    found = recipe.load(path, "smoke", ["--network.width", "64", "--data.jitter=0.5"])
    dcp, corr = found.settings["DCP"], found.settings["DCP_corr"]
    assert (dcp.data.num_points, dcp.data.keep, dcp.data.jitter) == (100, 0.8, 0.5)
    assert (dcp.optimizer.lr, corr.optimizer.lr) == (0.5, 0.1)
    assert dcp.network.width == corr.network.width == 64
    assert recipe.load(path, "laptop", []).settings["DCP"].data.num_points == 1000
    path.write_text(path.read_text() + "paper:\nbands_deg:\nbaselines:\n")  # nothing named yet
    assert recipe.load(path, "smoke", []).paper == {}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("id: x\ntitle: t\narms: {DCP: {}}\ndata: {num_pionts: 3}\n", "num_pionts"),
        ("id: x\ntitle: t\narms: {DCP: {}}\nlearning_rate: 3\n", "unknown key 'learning_rate'"),
        ("id: x\ntitle: t\narms: {ICP: {}}\n", "unknown method 'ICP'"),
        ("id: [", "is not YAML"),
        ("- 3\n", "holds no settings"),
        ("title: t\narms: {DCP: {}}\n", "lacks 'id'"),
        ("id: x\ntitle: t\narms: [DCP]\n", "arms must be names with settings"),
        ("id: x\ntitle: t\narms: {DCP: 3}\n", "arms must be names with settings"),
        ("id: x\ntitle: t\narms: {DCP: {}}\nbands_deg: 30\n", "bands_deg must be a list"),
        ("id: x\ntitle: t\narms: {DCP: {}}\nscales: [laptop]\n", "scales must be names"),
        ("id: x\ntitle: t\n", "lacks 'arms'"),
        ("id: x\ntitle: t\nbase: nowhere.yaml\n", "no recipe .*nowhere.yaml"),
    ],
)
def test_a_bad_recipe_is_named_in_one_line(tmp_path, content, message):
    path = tmp_path / "bad.yaml"
    path.write_text(content)
    with pytest.raises(CorrmatError, match=message) as caught:
        recipe.load(path, "smoke", [])
    assert "\n" not in str(caught.value)


def test_epochs_on_the_command_line_overrule_the_recipes_steps():
    path = ROOT / "configs" / "exp" / "1.1.yaml"
    assert recipe.load(path, "laptop", []).settings["DCP"].trainer.max_steps == 2400
    trainer = recipe.load(path, "laptop", ["--trainer.max_epochs", "5"]).settings["DCP"].trainer
    assert (trainer.max_epochs, trainer.max_steps) == (5, -1)


def test_no_gpu_without_float64_is_chosen_by_itself(monkeypatch):
    import torch

    from corrmat.experiment import trainer_options

    settings = recipe.load(ROOT / "configs" / "exp" / "1.1.yaml", "laptop", []).settings["DCP"]
    assert trainer_options(settings)["accelerator"] == "auto"
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert trainer_options(settings)["accelerator"] == "cpu"
