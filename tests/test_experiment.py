"""Smoke training of every experiment, and what a run promises besides its numbers."""

import csv
import dataclasses
import io
import json
import math
import os
import re
import signal
import socket

import pytest
import torch
from conftest import ROOT, shared
from rich.console import Console

from corrmat import console, experiment, page, recipe
from corrmat.errors import CorrmatError
from corrmat.metrics import rotation_error_deg
from corrmat.module import RegistrationModule

IDS = [path.stem for path in sorted((ROOT / "configs" / "exp").glob("*.yaml"))]


def load(identity, *options, arms=None):
    path = ROOT / "configs" / "exp" / f"{identity}.yaml"
    return recipe.load(path, "smoke", ["--trainer.enable_progress_bar", "false", *options], arms)


def train(name, settings, folder, **how):
    return experiment.train(experiment.prepare(name, settings), folder, **how)


def read_wandb(path):
    """Records of an offline run: wandb keeps them in LevelDB's log format."""
    from wandb.proto.wandb_internal_pb2 import Record

    content, at, part = path.read_bytes(), 7, b""
    while at + 7 <= len(content):
        left = 32768 - at % 32768
        if left < 7:  # no header fits into the rest of a block
            at += left
            continue
        size, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        part += content[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # whole, or the last of several
            yield Record.FromString(part)
            part = b""


def numbers(record):
    """Everything but what a clock says."""
    if isinstance(record, dict):
        return {k: numbers(v) for k, v in record.items() if k != "train_seconds"}
    return [numbers(v) for v in record] if isinstance(record, list) else repr(record)


@pytest.mark.parametrize("identity", IDS)
def test_smoke_run_leaves_a_whole_record(identity, tmp_path, capsys):
    found = load(identity)
    experiment.run(found, tmp_path / "results", tmp_path / "runs")
    folder = tmp_path / "results" / "smoke" / "shapes" / identity
    assert {p.name for p in folder.iterdir()} == {
        "metrics.json",
        "config.yaml",
        "per_pair.csv",
        "curves.png",
        "matches.png",
        "views.json",
    }
    record = json.loads((folder / "metrics.json").read_text())
    assert list(record["arms"]) == list(found.settings)
    assert record["test_pairs"] == found.test_pairs
    bands = max(1, len(found.bands_deg) - 1)
    for arm in record["arms"].values():
        assert arm["pairs"] == 8 * bands
        assert arm["pairs_seen"] == 32
        assert [point["pairs_seen"] for point in arm["curve"]] == [16, 32]
        assert len(arm.get("bands", [])) == (bands if bands > 1 else 0)
        assert [part["outliers"] for part in arm.get("sweep", [])] == list(found.sweep_outliers)
        assert 0 < arm["rotation_error_deg_mean"] < 180
    rows = list(csv.DictReader((folder / "per_pair.csv").open()))
    tested = [*found.settings, *found.baselines]
    assert len(rows) == len(tested) * 8 * bands
    assert list(dict.fromkeys(row["arm"] for row in rows)) == tested
    assert list(record["baselines"]) == list(found.baselines)
    views = json.loads((folder / "views.json").read_text())
    assert [view["rank"] for view in views] == ["easiest", "median", "hardest"]
    errors = [view["rotation_error_deg"] for view in views]
    assert errors == sorted(errors)
    assert all(len(view["steps"][-1]["matched"]) == len(view["source"]) for view in views)
    for picture in ("curves.png", "matches.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")
    assert "correct matches, %" in capsys.readouterr().out
    assert not list((tmp_path / "results").rglob("*.partial"))


def test_the_same_command_gives_the_same_numbers_bit_for_bit(tmp_path):
    records = [experiment.run(load("1.2"), tmp_path / f"{i}", tmp_path / "runs") for i in range(2)]
    assert numbers(records[0]) == numbers(records[1])
    other = experiment.run(load("1.2", "--seed", "1"), tmp_path / "2", tmp_path / "runs")
    assert numbers(other) != numbers(records[0])


def test_test_pairs_that_are_not_the_recipes_are_named(tmp_path, capsys):
    found = dataclasses.replace(load("3.3", arms=["PCRNet_corr"]), test_pairs="others")
    experiment.run(found, tmp_path / "results", tmp_path / "runs", "none")
    assert "are not the recipe's (others)" in capsys.readouterr().out


def test_per_pair_transforms_score_to_the_metrics_of_the_record(tmp_path):
    """Predict once, score many: the CSV alone gives the record's numbers again."""
    found = load("1.1")
    record = experiment.run(found, tmp_path / "results", tmp_path / "runs")
    rows = list(csv.DictReader((tmp_path / "results/smoke/shapes/1.1/per_pair.csv").open()))
    pairs = experiment.make_datamodule(found.settings["DCP"]).test_dataloader().dataset
    truth = pairs.__getitems__([(0, i) for i in range(len(pairs))])
    for arm, scores in record["arms"].items():
        own = [row for row in rows if row["arm"] == arm]
        mean = sum(float(row["rotation_error_deg"]) for row in own) / len(own)
        assert mean == pytest.approx(scores["rotation_error_deg_mean"], rel=1e-4)
        right, total = (sum(int(row[k]) for row in own) for k in ("right", "rows"))
        assert right / total == pytest.approx(scores["match_accuracy"])
        transform = torch.tensor([[float(v) for v in row["transform"].split()] for row in own])
        error = rotation_error_deg(transform[:, :9].view(-1, 3, 3), truth.rotation)
        stated = torch.tensor([float(row["rotation_error_deg"]) for row in own])
        torch.testing.assert_close(error.float(), stated, rtol=1e-3, atol=1e-2)
        off = (transform[:, 9:] - truth.translation).norm(dim=1)
        stated = torch.tensor([float(row["translation_error"]) for row in own])
        torch.testing.assert_close(off, stated, rtol=1e-3, atol=1e-4)


def test_experiment_1_4_takes_the_networks_of_1_1(tmp_path, capsys):
    first = experiment.run(load("1.1"), tmp_path / "results", tmp_path / "runs")
    capsys.readouterr()
    again = experiment.run(load("1.4"), tmp_path / "results", tmp_path / "runs")
    assert capsys.readouterr().out.count("trained already: ") == 2
    for arm in first["arms"]:
        assert again["arms"][arm]["curve"] == first["arms"][arm]["curve"]
    alone = experiment.run(load("1.4"), tmp_path / "other", tmp_path / "other_runs")
    assert numbers(alone) == numbers(again)
    capsys.readouterr()
    experiment.run(load("1.4", "--optimizer.lr", "1e-4"), tmp_path / "results", tmp_path / "runs")
    assert "trained already" not in capsys.readouterr().out  # other settings: not the same network


def test_the_real_part_runs_by_the_same_command(tmp_path):
    found = load("1.2", "--data.data", "modelnet40", "--data.root", str(shared("data")))
    record = experiment.run(found, tmp_path / "results", tmp_path / "runs")
    assert record["data"] == "modelnet40"
    config = (tmp_path / "results/smoke/modelnet40/1.2/config.yaml").read_text()
    assert str(shared("data")) not in config


def press_ctrl_c(during, step, patch):
    """Ctrl-C in the middle of a training or validation step."""
    original = getattr(RegistrationModule, during)

    def interrupted(self, batch, batch_index):
        found = original(self, batch, batch_index)
        if self.global_step == step and batch_index != 1:
            patch.undo()
            os.kill(os.getpid(), signal.SIGINT)
        return found

    patch.setattr(RegistrationModule, during, interrupted)


@pytest.mark.parametrize(
    ("during", "step", "workers"),
    [
        ("training_step", 5, 0),
        ("training_step", 8, 0),  # the last batch of an epoch
        ("training_step", 13, 0),
        ("training_step", 13, 2),
        ("validation_step", 12, 0),
    ],
)
def test_ctrl_c_and_the_same_command_end_as_if_nothing_had_been(
    during, step, workers, tmp_path, capsys
):
    options = ["--trainer.max_steps", "20", "--data.num_workers", str(workers)]
    settings, folder = load("1.1", *options).settings["DCP_corr"], tmp_path / "DCP_corr"
    whole = train("DCP_corr", settings, tmp_path / "whole")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stopped:  # noqa: PT012
        press_ctrl_c(during, step, patch)
        train("DCP_corr", settings, folder)
    assert stopped.value.code == 1
    assert "the same command goes on from there" in capsys.readouterr().out
    assert not (folder / "trained.json").exists()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Lightning leaves it ignored
    trained = train("DCP_corr", settings, folder)
    assert "going on from" in capsys.readouterr().out
    assert trained.pairs_seen == whole.pairs_seen == 80
    assert trained.curve == whole.curve
    for name in ("best.ckpt", "last.ckpt"):
        weights = [
            torch.load(t / name, weights_only=True)["state_dict"]
            for t in (tmp_path / "whole", folder)
        ]
        assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])


def test_ctrl_c_in_the_last_step_stops_the_run_with_its_arm_trained(tmp_path, capsys):
    settings, folder = load("1.1").settings["DCP"], tmp_path / "DCP"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):  # noqa: PT012
        press_ctrl_c("training_step", 7, patch)
        train("DCP", settings, folder)
    assert "stopping after this step" in capsys.readouterr().out
    assert json.loads((folder / "trained.json").read_text())["pairs_seen"] == 32


def test_a_network_that_the_paper_knows_nothing_of_leaves_a_record(tmp_path):
    """Without a matrix to be looked at, and without a figure of the paper's to follow."""
    options = ["--trainer.enable_progress_bar", "false"]
    found = recipe.load(ROOT / "configs" / "weights.yaml", "smoke", options)
    experiment.run(found, tmp_path / "results", tmp_path / "runs")
    folder = tmp_path / "results" / "smoke" / "shapes" / found.id
    assert (folder / "curves.png").is_file()
    assert not (folder / "matches.png").exists()
    assert "Invariant_corr" in page.build(tmp_path / "results")


def test_other_settings_do_not_go_on_from_an_old_checkpoint(tmp_path, capsys):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        press_ctrl_c("training_step", 5, patch)
        train("DCP", load("1.1").settings["DCP"], tmp_path / "DCP")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    capsys.readouterr()
    settings = load("1.1", "--optimizer.lr", "1e-4").settings["DCP"]
    train("DCP", settings, tmp_path / "DCP")
    assert "going on" not in capsys.readouterr().out


def test_an_arm_that_was_finished_is_not_trained_again_before_its_record(tmp_path, capsys):
    """Ctrl-C in the second arm costs nothing of the first; a recorded run starts anew."""
    found = load("1.1")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        original = experiment.train

        def second_is_stopped(arm, *rest, **named):
            if arm.name == "DCP_corr":
                press_ctrl_c("training_step", 3, patch)
            return original(arm, *rest, **named)

        patch.setattr(experiment, "train", second_is_stopped)
        experiment.run(found, tmp_path / "results", tmp_path / "runs")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    assert not (tmp_path / "results").exists()
    capsys.readouterr()
    record = experiment.run(found, tmp_path / "results", tmp_path / "runs")
    shown = capsys.readouterr().out
    assert shown.count("trained already") == shown.count("going on from") == 1
    again = experiment.run(found, tmp_path / "results", tmp_path / "runs")
    assert "trained already" not in capsys.readouterr().out
    assert numbers(again) == numbers(record)


def test_the_last_step_is_validated_wherever_it_falls(tmp_path):
    settings = load("1.1", "--trainer.max_steps", "6").settings["DCP"]
    trained = train("DCP", settings, tmp_path / "DCP")
    assert [point["pairs_seen"] for point in trained.curve] == [16, 24]


def test_nothing_is_deleted_or_trained_when_the_test_split_cannot_be_read(tmp_path):
    found = load("1.1")
    experiment.run(found, tmp_path / "results", tmp_path / "runs")
    best = tmp_path / "runs/smoke/shapes/1.1/DCP/best.ckpt"
    before = best.stat().st_mtime_ns
    for bad in (
        ["--data.test_shapes", "801"],
        ["--trainer.accelerator", "warp"],
        ["--seed", "-1"],
        ["--network.k", "0"],
        ["--network.width", "-4"],
        ["--trainer.max_steps", "-1", "--trainer.max_epochs", "-1"],
        ["--trainer.max_steps", "-1", "--trainer.max_time", "00:00:01:00"],
        ["--trainer.accumulate_grad_batches", "0"],
        ["--trainer.accumulate_grad_batches", "3"],  # validated after 4 batches
        ["--trainer.accumulate_grad_batches", "2"],  # the same, counted over epochs of 9
        ["--trainer.max_steps", "0"],
        ["--trainer.max_steps", "10"],  # of which a cycle rises in one
        ["--trainer.limit_test_batches", "0"],
        ["--trainer.val_check_interval", "10", "--trainer.check_val_every_n_epoch", "1"],
        ["--trainer.devices", "5"],  # of 4 held-out shapes
        ["--trainer.precision", "16-mixed"],  # cannot clip
    ):
        with pytest.raises(CorrmatError):
            experiment.run(load("1.1", *bad), tmp_path / "results", tmp_path / "runs")
        assert best.stat().st_mtime_ns == before


@pytest.mark.parametrize("option", ["iterations", "test_iterations"])
def test_a_network_without_an_iteration_is_refused_before_training(option, tmp_path):
    with pytest.raises(CorrmatError, match="no network of these"):
        experiment.run(load("2.1", f"--network.{option}", "0"), tmp_path / "r", tmp_path / "runs")
    assert not list(tmp_path.rglob("*.ckpt"))


def test_a_loss_that_is_no_number_stops_the_run_and_leaves_no_record(tmp_path, monkeypatch):
    original = RegistrationModule.training_step

    def poisoned(self, batch, batch_index):
        if self.global_step == 6:
            batch.source = batch.source * torch.nan
        return original(self, batch, batch_index)

    monkeypatch.setattr(RegistrationModule, "training_step", poisoned)
    with pytest.raises(CorrmatError) as stopped:
        experiment.run(load("1.1"), tmp_path / "results", tmp_path / "runs")
    shapes = r"shapes \[\d+, \d+, \d+, \d+\]"
    assert re.match(
        rf"the loss is nan at step 6 \(epoch 0, batch 6, {shapes}\)", str(stopped.value)
    )
    last = tmp_path / "runs/smoke/shapes/1.1/DCP/last.ckpt"
    assert str(stopped.value).endswith(f"seed 0; last good checkpoint: {last}")
    assert torch.load(last, weights_only=True)["global_step"] == 4
    assert not (tmp_path / "results").exists()


@pytest.fixture
def no_network(monkeypatch):
    """wandb as users have it, and an error for whoever connects to another machine."""
    monkeypatch.delenv("WANDB_MODE")

    def blocked(self, address):
        if self.family != socket.AF_UNIX and address[0] not in ("127.0.0.1", "localhost", "::1"):
            raise AssertionError(f"network touched: {address}")
        return original(self, address)

    original = socket.socket.connect
    monkeypatch.setattr(socket.socket, "connect", blocked)


def test_wandb_holds_config_curves_table_pictures_and_clouds_offline(tmp_path, no_network):
    found = load("1.2")
    experiment.run(found, tmp_path / "results", tmp_path / "runs", logger="wandb")
    runs = tmp_path / "runs" / "smoke" / "shapes" / "1.2"
    read = {}
    for path in runs.glob("**/offline-run-*/*.wandb"):
        records = list(read_wandb(path))
        run = next(record.run for record in records if record.HasField("run"))
        assert run.run_group == "smoke/shapes/1.2"
        read[run.job_type] = path.parent, records, run
    assert set(read) == {"DCP", "DCP_corr", "record"}

    def history(job):
        items = [item for r in read[job][1] if r.HasField("history") for item in r.history.item]
        return {item.key or "/".join(item.nested_key): item.value_json for item in items}

    for job in ("DCP", "DCP_corr"):
        assert {"train/loss", "val/rotation_error_deg_mean"} <= set(history(job))
        config = {item.key: json.loads(item.value_json) for item in read[job][2].config.update}
        assert config["network"]["width"] == 32
        assert config["data"]["keep"] == 0.7
    logged = {name: json.loads(value) for name, value in history("record").items()}
    kinds = {"table": "table-file", "curves": "image-file", "pair/hardest": "object3D-file"}
    for name, kind in kinds.items():
        assert logged[f"{name}/_type"] == kind
        path = read["record"][0] / "files" / logged[f"{name}/path"]
        assert path.stat().st_size > 100
    content = json.loads((read["record"][0] / "files" / logged["table/path"]).read_text())
    assert "DCP_corr" in content["columns"]
    steps = list(csv.DictReader((runs / "DCP" / "csv" / "version_0" / "metrics.csv").open()))
    assert any(row["val/match_accuracy"] for row in steps)


@pytest.mark.parametrize(("logger", "there"), [("csv", {"csv"}), ("none", set())])
def test_loggers_can_be_left_out(logger, there, tmp_path, no_network):
    train("DCP", load("1.1").settings["DCP"], tmp_path / "DCP", logger=logger)
    assert {name for name in ("csv", "wandb") if (tmp_path / "DCP" / name).exists()} == there


def test_a_board_shows_every_arm(tmp_path):
    text = io.StringIO()
    console.listen(0)
    board = console.Board(Console(file=text, force_terminal=True, width=120))
    settings = load("1.1").settings["DCP_corr"]
    with board:
        train("DCP_corr", settings, tmp_path / "run", board=board)
    shown = text.getvalue()
    for word in ("arm", "pairs/s", "time left", "DCP_corr", "8/8", "rotation error", "done in 0:0"):
        assert word in shown
    assert board.rows["DCP_corr"]["rotation error"].endswith("°")


def test_a_board_of_a_run_that_ends_by_the_clock_knows_no_time_left(tmp_path):
    console.listen(0)
    board = console.Board(Console(file=io.StringIO(), force_terminal=True))
    endless = ["--trainer.max_steps", "-1", "--trainer.max_time", "00:00:00:02"]
    found = load("1.1", "--optimizer.schedule", "step", *endless)
    with board:
        train("DCP", found.settings["DCP"], tmp_path / "run", board=board)
    assert int(board.rows["DCP"]["step"]) > 0


def test_a_board_that_nobody_watches_draws_nothing(tmp_path):
    text = io.StringIO()
    with console.Board(Console(file=text)) as board:
        board.update("DCP", step="1/2")
    assert not board.watched
    assert text.getvalue() == ""


@pytest.mark.parametrize("arm", ["1.1 DCP", "2.2 RPMNet_corr", "3.2 PCRNet"])
def test_a_machine_that_is_fast_in_bfloat16_trains_in_it(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "default_precision", lambda accelerator: "bf16-mixed")
    seen = []
    original = RegistrationModule.training_step

    def noted(self, batch, batch_index):
        seen.append((self.trainer.precision, torch.is_autocast_enabled("cpu")))
        return original(self, batch, batch_index)

    monkeypatch.setattr(RegistrationModule, "training_step", noted)
    identity, name = arm.split()
    found = load(identity, arms=[name])
    assert found.settings[name].trainer.gradient_clip_val
    ready = experiment.prepare(name, found.settings[name])
    trained = experiment.train(ready, tmp_path / name)
    assert set(seen) == {("bf16-mixed", True)}
    assert math.isfinite(trained.curve[-1]["loss"])
    (pairs,) = experiment.score(experiment.trained_module(ready, trained.checkpoint), ready)
    assert pairs["rotation_error_deg"].isfinite().all()


@pytest.mark.parametrize(
    ("devices", "count", "one"),
    [(4, 4, 1), ("auto", 0, 1), (-1, 0, 1), ("3", 3, 1), ([3, 1], 2, [3]), ("2,5", 2, [2])],
)
def test_a_test_runs_on_the_first_device_that_is_named(devices, count, one):
    assert experiment._devices(devices) == count
    assert experiment._first(devices) == one


def test_checkpoints_reload_to_the_same_network(tmp_path):
    settings = load("1.1").settings["DCP_corr"]
    trained = train("DCP_corr", settings, tmp_path / "run")
    arm = experiment.prepare("DCP_corr", settings)
    first, again = (
        experiment.score(experiment.trained_module(arm, trained.checkpoint), arm)[0]
        for _ in range(2)
    )
    assert torch.equal(first["transform"], again["transform"])
    assert math.isfinite(float(first["rotation_error_deg"].mean()))


def test_a_record_is_json_that_everybody_can_read(tmp_path, monkeypatch):
    """A metric that is not a number is null: JSON knows no NaN."""
    from corrmat import metrics

    monkeypatch.setattr(
        metrics, "chamfer", lambda prediction, batch: torch.full((len(batch),), torch.nan)
    )
    experiment.run(load("1.1"), tmp_path / "results", tmp_path / "runs")
    text = (tmp_path / "results/smoke/shapes/1.1/metrics.json").read_text()

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    record = json.loads(text, parse_constant=refuse)
    assert record["arms"]["DCP"]["chamfer"] is None


def test_a_record_says_what_its_arms_were_trained_on(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "default_precision", lambda accelerator: "bf16-mixed")
    steps = ["--trainer.max_steps", "2"]
    hardware = experiment.run(load("3.2", *steps), tmp_path / "results", tmp_path / "r")["hardware"]
    assert hardware["precision"] == "bf16-mixed / 32-true"  # PCRNet_corr: see pcrnet.yaml
    assert hardware["threads"] == torch.get_num_threads()
    assert hardware["gpu"] == torch.cuda.is_available()
