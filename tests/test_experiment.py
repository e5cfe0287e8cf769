"""Smoke training of every experiment, and what a run promises besides its numbers."""

import contextlib
import csv
import dataclasses
import functools
import io
import json
import math
import multiprocessing
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import types

import numpy as np
import pytest
import torch
from conftest import ROOT, parse_overrides, shared
from rich.console import Console
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from corrmat import weights
from corrmat.baselines import is_available
from corrmat.errors import CorrmatError, DivergedError
from corrmat.metrics import rotation_error_deg
from corrmat.module import RegistrationModule
from corrmat.registration import benchmark
from corrmat.reporting.page import build_page
from corrmat.reporting.record import Record, read_snapshots
from corrmat.training import callbacks, console, experiment, fit, hardware, recipe, runs
from corrmat.training.preflight import planned_steps, prepare

IDS = [path.stem for path in sorted((ROOT / "configs" / "exp").glob("*.yaml"))]


def load(identity, *options, arms=None):
    path = ROOT / "configs" / "exp" / f"{identity}.yaml"
    words = ["--trainer.enable_progress_bar", "false", *options]
    return recipe.load(path, "smoke", parse_overrides(words), arms)


def train(settings, folder, **options):
    return fit.train(prepare(settings), folder, **options)


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
    if isinstance(record, Record):
        record = record.to_json()
    if isinstance(record, dict):
        return {k: numbers(v) for k, v in record.items() if k != "train_seconds"}
    return [numbers(v) for v in record] if isinstance(record, list) else repr(record)


@pytest.fixture(scope="module")
def smoke_run(tmp_path_factory):
    """Run an experiment at smoke scale, once for all tests: record, folder of results, output."""

    @functools.cache
    def run(identity):
        folder = tmp_path_factory.mktemp(identity)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            record = experiment.run(load(identity), folder / "results", folder / "runs")
        return record, folder / "results", printed.getvalue()

    return run


@pytest.mark.parametrize("identity", IDS)
def test_smoke_run_leaves_a_whole_record(identity, smoke_run):
    loaded = load(identity)
    _, results, printed = smoke_run(identity)
    folder = results / "smoke" / "shapes" / identity
    assert {p.name for p in folder.iterdir()} == {
        "metrics.json",
        "config.yaml",
        "per_pair.csv",
        "curves.png",
        "matches.png",
        "snapshots.json",
    }
    record = json.loads((folder / "metrics.json").read_text())
    assert list(record["arms"]) == list(loaded.arms)
    assert record["test_pairs"] == loaded.test_pairs
    bands = max(1, len(loaded.bands_deg) - 1)
    for arm in record["arms"].values():
        assert arm["pairs"] == 8 * bands
        assert arm["pairs_seen"] == 32
        assert [point["pairs_seen"] for point in arm["curve"]] == [16, 32]
        assert len(arm.get("bands", [])) == (bands if bands > 1 else 0)
        assert [part["outliers"] for part in arm.get("sweep", [])] == list(loaded.sweep_outliers)
        assert 0 < arm["rotation_error_deg_mean"] < 180
    rows = list(csv.DictReader((folder / "per_pair.csv").open()))
    baselines = [name for name in loaded.baselines if is_available(name)]
    tested = [*loaded.arms, *baselines]
    assert len(rows) == len(tested) * 8 * bands
    assert list(dict.fromkeys(row["arm"] for row in rows)) == tested
    assert list(record["baselines"]) == baselines
    snapshots = read_snapshots(folder)
    assert [snapshot.rank for snapshot in snapshots] == ["easiest", "median", "hardest"]
    errors = [snapshot.rotation_error_deg for snapshot in snapshots]
    assert errors == sorted(errors)
    assert all(len(s.steps[-1].matched) == len(s.source) for s in snapshots)
    for snapshot in snapshots:
        distance, _ = KDTree(snapshot.clean).query(snapshot.source)
        assert np.median(distance) < 0.1  # the source lies on the shape that is drawn behind it
    for picture in ("curves.png", "matches.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")
    assert "correct matches, %" in printed
    assert not list(results.rglob("*.partial"))


def test_the_same_command_gives_the_same_numbers_bit_for_bit(tmp_path, smoke_run):
    record = smoke_run("1.2")[0]
    again = experiment.run(load("1.2"), tmp_path / "1", tmp_path / "runs")
    assert numbers(record) == numbers(again)
    other = experiment.run(load("1.2", "--seed", "1"), tmp_path / "2", tmp_path / "runs")
    assert numbers(other) != numbers(record)


def test_test_pairs_that_are_not_the_recipes_are_named(tmp_path, capsys):
    loaded = dataclasses.replace(load("3.3", arms=["PCRNet_corr"]), test_pairs="others")
    experiment.run(loaded, tmp_path / "results", tmp_path / "runs", "none")
    assert "are not the recipe's (others)" in capsys.readouterr().out


@pytest.mark.parametrize("identity", ["1.1", "2.4"])
def test_per_pair_csv_alone_gives_every_rotation_metric_of_the_record(identity, smoke_run):
    """Predict once, score many: 2.4 is tested in bands, whose rows follow each other."""
    record, results, _ = smoke_run(identity)
    folder = results / "smoke/shapes" / identity
    table = list(csv.DictReader((folder / "per_pair.csv").open()))
    for arm, result in (record.arms | record.baselines).items():
        rows = [row for row in table if row["arm"] == arm]
        predicted, truth = (
            torch.tensor([[float(v) for v in row[name].split()] for row in rows])
            for name in ("transform", "true_transform")
        )
        rotations = [t[:, :9].reshape(-1, 3, 3) for t in (predicted, truth)]
        metrics = metrics_of(rotations, predicted[:, 9:], truth[:, 9:])
        for name, value in metrics.items():
            assert float(value) == pytest.approx(result.metrics[name], rel=1e-6, abs=1e-9), name
        stated = torch.tensor([float(row["rotation_error_deg"]) for row in rows]).double()
        torch.testing.assert_close(rotation_error_deg(*rotations), stated, rtol=1e-6, atol=1e-6)
        if arm in ("identity", "ransac"):  # they have no matches
            assert {row["num_correct"] for row in rows} == {""}
            assert math.isnan(result.metrics["match_accuracy"])
            continue
        correct, total = (
            sum(int(row[name]) for row in rows) for name in ("num_correct", "num_matchable")
        )
        assert correct / total == result.metrics["match_accuracy"]


def metrics_of(rotations, translation, true_translation):
    """The metrics of SPEC.md section 5, from transforms alone, by scipy's Euler angles."""
    predicted, truth = (Rotation.from_matrix(r.double().numpy()) for r in rotations)
    relative = (predicted * truth.inv()).as_euler("zyx", degrees=True)
    naive = predicted.as_euler("zyx", degrees=True) - truth.as_euler("zyx", degrees=True)
    error = rotation_error_deg(*rotations)
    off = (translation - true_translation).double()
    close = (error < 5) & (off.norm(dim=1) < 0.05)
    return {
        "rotation_error_deg_mean": error.mean(),
        "relative_euler_rmse_deg": (relative**2).mean() ** 0.5,
        "relative_euler_mae_deg": abs(relative).mean(),
        "naive_euler_rmse_deg": (naive**2).mean() ** 0.5,
        "translation_rmse": off.square().mean().sqrt(),
        "recall@5deg_0.05": close.double().mean(),
    }


def test_experiment_1_4_takes_the_networks_of_1_1(tmp_path, capsys, smoke_run):
    first = experiment.run(load("1.1"), tmp_path / "results", tmp_path / "runs")
    capsys.readouterr()
    again = experiment.run(load("1.4"), tmp_path / "results", tmp_path / "runs")
    assert capsys.readouterr().out.count("trained already: ") == 2
    for arm in first.arms:
        assert again.arms[arm].curve == first.arms[arm].curve
    assert numbers(smoke_run("1.4")[0]) == numbers(again)
    capsys.readouterr()
    experiment.run(load("1.4", "--optimizer.lr", "1e-4"), tmp_path / "results", tmp_path / "runs")
    assert "trained already" not in capsys.readouterr().out  # other settings: not the same network


def test_the_real_part_runs_by_the_same_command(tmp_path):
    loaded = load("1.2", "--data.data", "modelnet40", "--data.root", str(shared("data")))
    record = experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    assert record.data == "modelnet40"
    config = (tmp_path / "results/smoke/modelnet40/1.2/config.yaml").read_text()
    assert str(shared("data")) not in config


def press_ctrl_c(during, step, patch):
    """Ctrl-C in the middle of a training or validation step: a terminal tells every process."""
    original = getattr(RegistrationModule, during)

    def interrupted(self, batch, batch_index):
        result = original(self, batch, batch_index)
        if self.global_step == step and batch_index != 1:
            patch.undo()
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        return result

    patch.setattr(RegistrationModule, during, interrupted)


@pytest.mark.parametrize(
    ("during", "step", "workers"),
    [
        ("training_step", 5, 0),
        ("training_step", 8, 0),  # the last batch of an epoch
        ("training_step", 13, 0),
        ("training_step", 13, 2),
        ("validation_step", 12, 0),
        ("validation_step", 12, 2),
    ],
)
def test_ctrl_c_and_the_same_command_end_as_if_nothing_had_been(
    during, step, workers, tmp_path, capsys
):
    options = ["--trainer.max_steps", "20", "--data.num_workers", str(workers)]
    settings, folder = load("1.1", *options).arms["DCP_corr"], tmp_path / "DCP_corr"
    whole = train(settings, tmp_path / "whole")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stopped:  # noqa: PT012
        press_ctrl_c(during, step, patch)
        train(settings, folder)
    assert stopped.value.code == 1
    assert "the same command, without --fresh, continues from there" in capsys.readouterr().out
    assert not (folder / "trained.json").exists()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Lightning leaves it ignored
    trained = train(settings, folder)
    assert "continuing from" in capsys.readouterr().out
    assert trained.pairs_seen == whole.pairs_seen == 80
    assert trained.curve == whole.curve
    for name in ("best.ckpt", "last.ckpt"):
        weights = [
            torch.load(t / name, weights_only=True)["state_dict"]
            for t in (tmp_path / "whole", folder)
        ]
        assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])


def test_ctrl_c_in_the_last_step_stops_the_run_with_its_arm_trained(tmp_path, capsys):
    settings, folder = load("1.1").arms["DCP"], tmp_path / "DCP"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):  # noqa: PT012
        press_ctrl_c("training_step", 7, patch)
        train(settings, folder)
    assert "stopping after this step" in capsys.readouterr().out
    assert json.loads((folder / "trained.json").read_text())["pairs_seen"] == 32


def test_a_signal_while_a_line_is_printed_still_stops_with_a_checkpoint(tmp_path, monkeypatch):
    """Python cannot print within a print: the notice is lost, nothing else."""

    def reentrant(*_):
        raise RuntimeError("reentrant call inside <_io.BufferedWriter name='<stdout>'>")

    stop = callbacks.SaveOnInterrupt(tmp_path / "last.ckpt")
    monkeypatch.setattr(callbacks.log, "info", reentrant)
    stop._request_stop(signal.SIGTERM, None)
    assert stop.stop_requested


def test_a_network_that_the_paper_knows_nothing_of_leaves_a_record(tmp_path):
    """Without a matrix to be looked at, and without a figure of the paper's to follow."""
    options = ["--trainer.enable_progress_bar", "false", "--data.data", "shapes"]
    overrides = parse_overrides(options)
    loaded = recipe.load(ROOT / "configs" / "weights.yaml", "smoke", overrides)
    experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    (folder,) = (tmp_path / "results" / "smoke" / "shapes").glob(f"{loaded.id}*")
    assert (folder / "curves.png").is_file()
    assert not (folder / "matches.png").exists()
    assert "Invariant_corr" in build_page(tmp_path / "results")


def test_other_settings_do_not_go_on_from_an_old_checkpoint(tmp_path, capsys):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        press_ctrl_c("training_step", 5, patch)
        train(load("1.1").arms["DCP"], tmp_path / "DCP")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    capsys.readouterr()
    old = (tmp_path / "DCP" / "last.ckpt").read_bytes()
    settings = load("1.1", "--optimizer.lr", "1e-4").arms["DCP"]
    train(settings, tmp_path / "DCP")
    assert "continuing" not in capsys.readouterr().out
    assert (tmp_path / "DCP.previous" / "last.ckpt").read_bytes() == old  # nothing is lost
    train(load("1.1", "--optimizer.lr", "2e-4").arms["DCP"], tmp_path / "DCP")
    assert (tmp_path / "DCP.previous" / "last.ckpt").read_bytes() == old
    assert (tmp_path / "DCP.previous2" / "best.ckpt").is_file()


@pytest.mark.parametrize(("lacking", "same"), [("new_shapes", True), ("num_points", False)])
def test_an_option_that_a_run_did_not_know_had_its_default(lacking, same, tmp_path, capsys):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        press_ctrl_c("training_step", 5, patch)
        train(load("1.1").arms["DCP"], tmp_path / "DCP")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    capsys.readouterr()
    settings = tmp_path / "DCP" / "settings.yaml"
    lines = settings.read_text().splitlines(keepends=True)
    older = "".join(line for line in lines if not line.strip().startswith(f"{lacking}:"))
    assert older != settings.read_text()
    settings.write_text(older)
    train(load("1.1").arms["DCP"], tmp_path / "DCP")
    assert ("continuing from" in capsys.readouterr().out) == same


def test_the_commit_is_read_before_training_and_not_after(tmp_path, monkeypatch):
    """Hours later the files may be another commit's, but the code in memory is not."""
    runs = tmp_path / "runs"
    for module in (fit, experiment):
        monkeypatch.setattr(module, "commit", lambda: f"{len(list(runs.rglob('*.ckpt')))} saved")
    record = experiment.run(load("1.2"), tmp_path / "results", runs)
    assert (record.commit, record.arms["DCP"].trained_at) == ("0 saved", "0 saved")


def test_other_weights_under_the_same_name_are_another_start(tmp_path, capsys):
    settings = load("1.1").arms["DCP"]
    train(settings, tmp_path / "first")
    checkpoint = shutil.copy(tmp_path / "first" / "best.ckpt", tmp_path / "start.ckpt")
    started = dataclasses.replace(settings, start=str(checkpoint))
    folder = tmp_path / "runs"
    arm = prepare(started)
    before = runs.training_settings(arm)
    assert "start_checksum" in before
    train(dataclasses.replace(settings, seed=1), folder)
    shutil.copy(folder / "best.ckpt", checkpoint)
    assert runs.training_settings(arm) != before


def test_a_run_without_its_weights_is_not_trained(tmp_path):
    loaded = load("1.1", arms=["DCP"])
    arm = prepare(loaded.arms["DCP"])
    folder = tmp_path / loaded.place / "DCP"
    train(loaded.arms["DCP"], folder)
    assert runs.find_trained(loaded, arm, tmp_path) is not None
    (folder / "best.ckpt").unlink()
    assert runs.find_trained(loaded, arm, tmp_path) is None


def test_an_arm_that_was_finished_is_not_trained_again_before_its_record(tmp_path, capsys):
    """Ctrl-C in the second arm costs nothing of the first; a recorded run starts anew."""
    loaded = load("1.1")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        original = experiment.train

        def second_is_stopped(arm, *rest, **named):
            if arm.name == "DCP_corr":
                press_ctrl_c("training_step", 3, patch)
            return original(arm, *rest, **named)

        patch.setattr(experiment, "train", second_is_stopped)
        experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    assert not (tmp_path / "results").exists()
    capsys.readouterr()
    record = experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    shown = capsys.readouterr().out
    assert shown.count("trained already") == shown.count("continuing from") == 1
    folder = tmp_path / "runs" / loaded.place / "DCP"
    old = (folder / "best.ckpt").read_bytes()
    again = experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    assert "trained already" not in capsys.readouterr().out
    assert numbers(again) == numbers(record)
    kept = folder.with_name("DCP.previous") / "best.ckpt"
    assert kept.read_bytes() == old  # what a record was tested with is not lost


def test_the_last_step_is_validated_wherever_it_falls(tmp_path):
    settings = load("1.1", "--trainer.max_steps", "6").arms["DCP"]
    trained = train(settings, tmp_path / "DCP")
    assert [point["pairs_seen"] for point in trained.curve] == [16, 24]


def test_nothing_is_deleted_or_trained_when_the_test_split_cannot_be_read(tmp_path):
    loaded = load("1.1", arms=["DCP"])
    experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    best = tmp_path / "runs/smoke/shapes/1.1/DCP/best.ckpt"
    before = best.stat().st_mtime_ns
    for words, message in (
        ("--data.test_shapes 801", "801"),
        ("--trainer.accelerator warp", "accelerator"),
        ("--seed -1", "seed"),
        ("--network.k 0", "k"),
        ("--network.width -4", "--network options"),
        ("--trainer.max_steps -1 --trainer.max_epochs -1", "one-cycle"),
        ("--trainer.max_steps -1 --trainer.max_time 00:00:01:00", "one-cycle"),
        ("--trainer.accumulate_grad_batches 0", "is not positive"),
        ("--trainer.accumulate_grad_batches 3", "middle of a step"),  # validated after 4 batches
        ("--trainer.accumulate_grad_batches 2", "middle of a step"),  # over epochs of 9
        ("--trainer.max_steps 0", "leaves nothing to do"),
        ("--trainer.max_steps 10", "cannot rise in one step"),
        ("--trainer.limit_test_batches 0", "limit_test_batches does not go with records"),
        ("--trainer.limit_train_batches 0.01", "leaves nothing to do"),
        ("--trainer.limit_val_batches 0.01", "leaves nothing to do"),
        ("--trainer.fast_dev_run true", "fast_dev_run does not go with records"),
        ("--trainer.sync_batchnorm true", "sync_batchnorm does not go with records"),
        ("--trainer.overfit_batches 1", "overfit_batches does not go with records"),
        ("--trainer.val_check_interval 00:01:00:00", "is not a number of batches"),
        ("--trainer.val_check_interval 10 --trainer.check_val_every_n_epoch 1", "never comes"),
        ("--trainer.devices 5", "cannot share 4 held-out shapes"),
        ("--trainer.devices 2 --trainer.val_check_interval 6 --trainer.check_val_every_n_epoch 1",
         "never comes in epochs of 4 batches"),
        ("--trainer.limit_train_batches 3 --trainer.val_check_interval 5 "
         "--trainer.check_val_every_n_epoch 1", "never comes in epochs of 3 batches"),
        ("--data.train_shapes 4 --trainer.devices 8", "cannot share"),
        ("--trainer.precision 16-mixed", "cannot clip"),
    ):  # fmt: skip
        changed = load("1.1", *words.split(), arms=["DCP"])
        with pytest.raises(CorrmatError, match=message):
            experiment.run(changed, tmp_path / "results", tmp_path / "runs")
        assert best.stat().st_mtime_ns == before
    sweep = dataclasses.replace(loaded, sweep_outliers=(0.1, 1.5))
    with pytest.raises(CorrmatError, match=r"outliers = 1\.5"):
        experiment.run(sweep, tmp_path / "results", tmp_path / "runs")
    assert best.stat().st_mtime_ns == before


def test_two_processes_do_not_train_into_one_folder(tmp_path):
    loaded, folder = load("1.1", arms=["DCP"]), tmp_path / "runs/smoke/shapes/1.1/DCP"
    with runs.only_process(folder), pytest.raises(CorrmatError, match="another process trains"):
        experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    assert not folder.exists()
    experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    assert (folder / "best.ckpt").is_file()


def test_the_run_of_a_record_is_kept_while_others_come_and_go(tmp_path):
    loaded, folder = load("1.1", arms=["DCP"]), tmp_path / "runs/smoke/shapes/1.1/DCP"
    experiment.run(loaded, tmp_path / "results", tmp_path / "runs")
    recorded = (folder / "best.ckpt").read_bytes()
    other = load("1.1", "--optimizer.lr", "1e-4", arms=["DCP"]).arms["DCP"]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        press_ctrl_c("training_step", 5, patch)
        train(other, folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    train(loaded.arms["DCP"], folder)
    assert (folder.with_name("DCP.previous") / "best.ckpt").read_bytes() == recorded
    for rate in ("2e-4", "3e-4"):  # finished, without a record: none replaces another
        train(load("1.1", "--optimizer.lr", rate, arms=["DCP"]).arms["DCP"], folder)
    train(loaded.arms["DCP"], folder)
    assert (folder.with_name("DCP.previous") / "best.ckpt").read_bytes() == recorded
    kept = [path.name for path in folder.parent.glob("DCP.previous*")]
    assert sorted(kept) == [f"DCP.previous{number}" for number in ("", 2, 3, 4, 5)]


def test_a_checkpoint_that_lies_there_by_itself_is_kept(tmp_path):
    (tmp_path / "DCP").mkdir()
    (tmp_path / "DCP" / "best.ckpt").write_bytes(b"mine")
    train(load("1.1").arms["DCP"], tmp_path / "DCP")
    assert (tmp_path / "DCP.previous" / "best.ckpt").read_bytes() == b"mine"


def test_a_checkpoint_of_other_options_is_named(tmp_path, caplog):
    """Options like the number of neighbours change the answer, but no weight."""
    arm = load("1.1", arms=["DCP"]).arms["DCP"]
    trained = train(arm, tmp_path / "DCP")
    fit.load_trained(prepare(arm), trained.checkpoint)
    assert "was trained with" not in caplog.text
    fit.load_trained(
        prepare(load("1.1", "--network.k", "7", arms=["DCP"]).arms["DCP"]), trained.checkpoint
    )
    assert f"was trained with --network.k {arm.network.k}, not 7" in caplog.text


def test_a_training_that_is_not_resumed_starts_at_the_first_batch(tmp_path):
    """Whatever the same DataModule was used for before."""
    settings = load("1.1", arms=["DCP"]).arms["DCP"]
    arm = prepare(settings)
    arm.datamodule.load_state_dict({"epoch": 1, "batches": 2})
    used, unused = (
        fit.train(one, tmp_path / name) for one, name in ((arm, "used"), (prepare(settings), "un"))
    )
    assert [point["pairs_seen"] for point in used.curve] == [
        point["pairs_seen"] for point in unused.curve
    ]
    assert (
        (used.curve[-1]["rotation_error_deg_mean"]) == unused.curve[-1]["rotation_error_deg_mean"]
    )


def test_another_seed_has_a_record_of_its_own(tmp_path):
    loaded = load("2.4", "--seed", "3")
    assert loaded.place.as_posix() == "smoke/shapes/2.4-seed3"
    assert loaded.place_of("2.1").as_posix() == "smoke/shapes/2.1-seed3"
    assert load("2.4").place.as_posix() == "smoke/shapes/2.4"
    record = Record.from_json(
        {"id": "2.4", "scale": "smoke", "data": "shapes", "seed": 3, "arms": {}}
    )
    assert record.place == loaded.place


def test_a_baseline_whose_package_is_missing_is_left_out(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "open3d", None)
    record = experiment.run(load("1.1"), tmp_path / "results", tmp_path / "runs")
    assert list(record.baselines) == ["identity", "untrained"]
    assert "ransac is left out: pip install open3d" in caplog.text


def test_ransac_solves_identical_points(tmp_path):
    """The paper's setting, without training: a learned network competes with this."""
    pytest.importorskip("open3d")
    record = experiment.run(load("1.1"), tmp_path / "results", tmp_path / "runs")
    assert record.baselines["ransac"].get("rotation_error_deg_median") < 1e-4


@pytest.mark.parametrize(
    ("experiment_id", "option", "size"),
    [
        ("1.1", "width", "33"),
        ("1.1", "heads", "0"),
        ("1.1", "feedforward", "0"),
        ("1.1", "k", "0"),
        ("1.1", "edge_channels", "[]"),
        ("2.1", "width", "12"),
        ("2.1", "annealing_width", "8"),
        ("2.1", "iterations", "0"),
        ("2.1", "test_iterations", "0"),
        ("3.1", "width", "0"),
        ("../weights", "heads", "0"),
        ("../weights", "neighbors", "0"),
    ],
)
def test_a_network_refuses_impossible_sizes_before_training(experiment_id, option, size, tmp_path):
    message = r"cannot build \w+ from the --network options: \w+ -?\d+ is not"
    with pytest.raises(CorrmatError, match=message):
        experiment.run(
            load(experiment_id, f"--network.{option}", size), tmp_path / "r", tmp_path / "runs"
        )
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
    import wandb

    loaded = load("1.2")
    experiment.run(loaded, tmp_path / "results", tmp_path / "runs", logger="wandb")
    wandb.teardown()  # a finished run's file is complete when wandb's service has ended
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
    train(load("1.1").arms["DCP"], tmp_path / "DCP", logger=logger)
    assert {name for name in ("csv", "wandb") if (tmp_path / "DCP" / name).exists()} == there


def test_a_board_shows_every_arm(tmp_path):
    text = io.StringIO()
    console.print_messages(0)
    board = console.Board(Console(file=text, force_terminal=True, width=120))
    settings = load("1.1").arms["DCP_corr"]
    with board:
        train(settings, tmp_path / "run", board=board)
    shown = text.getvalue()
    for word in ("arm", "pairs/s", "time left", "DCP_corr", "8/8", "rotation error"):
        assert word in shown
    assert re.search(r"done in \d+:\d\d", shown)
    assert board.rows["DCP_corr"]["rotation error"].endswith("°")


def test_a_board_of_a_run_that_ends_by_the_clock_knows_no_time_left(tmp_path):
    console.print_messages(0)
    board = console.Board(Console(file=io.StringIO(), force_terminal=True))
    endless = ["--trainer.max_steps", "-1", "--trainer.max_time", "00:00:00:02"]
    loaded = load("1.1", "--optimizer.schedule", "step", *endless)
    with board:
        train(loaded.arms["DCP"], tmp_path / "run", board=board)
    assert int(board.rows["DCP"]["step"]) > 0


def test_a_board_that_nobody_watches_draws_nothing(tmp_path):
    text = io.StringIO()
    with console.Board(Console(file=text)) as board:
        board.update("DCP", step="1/2")
    assert not board.is_visible
    assert text.getvalue() == ""


@pytest.mark.parametrize("arm", ["1.1 DCP", "2.2 RPMNet_corr", "3.2 PCRNet"])
def test_a_machine_that_is_fast_in_bfloat16_trains_in_it(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(hardware, "fast_precision", lambda accelerator: "bf16-mixed")
    dtypes = []
    original = RegistrationModule.training_step

    def noted(self, batch, batch_index):
        dtypes.append((self.trainer.precision, torch.is_autocast_enabled("cpu")))
        return original(self, batch, batch_index)

    monkeypatch.setattr(RegistrationModule, "training_step", noted)
    identity, name = arm.split()
    options = ("--trainer.accelerator", "cpu", "--trainer.precision", "auto")
    loaded = load(identity, *options, arms=[name])
    assert loaded.arms[name].trainer.gradient_clip_val
    ready = prepare(loaded.arms[name])
    trained = fit.train(ready, tmp_path / name)
    assert set(dtypes) == {("bf16-mixed", True)}
    assert math.isfinite(trained.curve[-1]["loss"])
    (pairs,) = fit.score(fit.load_trained(ready, trained.checkpoint), ready)
    assert pairs["rotation_error_deg"].isfinite().all()


@pytest.mark.parametrize(
    ("devices", "one"),
    [(4, 1), ("auto", 1), (-1, 1), ("3", 1), ([3, 1], [3]), ("2,5", [2])],
)
def test_a_test_runs_on_the_first_device_that_is_named(devices, one):
    assert hardware.first_device(devices) == one


def test_a_cycle_that_would_rise_in_one_step_is_refused_before_anything_is_deleted():
    arm = prepare(load("1.1", "--trainer.max_epochs", "3").arms["DCP"])
    batches = len(arm.datamodule.train_dataloader())
    assert planned_steps(arm) == 3 * batches
    options = "--trainer.max_epochs", "1", "--trainer.limit_train_batches", "5"
    with pytest.raises(CorrmatError, match="cannot rise in one step"):
        prepare(load("1.1", *options, "--optimizer.warmup", "0.2").arms["DCP"])


def test_batch_norms_keep_their_statistics_from_a_share_of_the_run_on(tmp_path):
    """Two of eight steps follow the batches, of two clouds each; a validation lies between."""
    settings = load("1.2", "--optimizer.freeze_norms", "0.25").arms["DCP_corr"]
    trained = train(settings, tmp_path)
    state = torch.load(trained.checkpoint.with_name("last.ckpt"), weights_only=True)["state_dict"]
    tracked = {int(n) for name, n in state.items() if name.endswith("num_batches_tracked")}
    assert tracked == {2 * 2}


def test_denormal_numbers_are_zero_in_all_threads_of_a_run():
    """Threads that torch has started before keep what they started with."""
    code = """
import torch
torch.set_num_threads(2)
import corrmat.cli
from corrmat.options import parse
corrmat.cli.prepare_output(parse(["run", "--config", "x.yaml"]))
print(int((torch.full((2**18,), 1e-39) * 1).count_nonzero()))
"""
    words = sys.executable, "-c", code
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == "0\n"


def test_an_interrupted_run_keeps_no_weights_that_are_not_finite(tmp_path, monkeypatch):
    """On a GPU the loss is not looked at in every step."""
    method = fit.fresh_method(load("1.2").arms["DCP_corr"])
    method._last_loss = torch.tensor(math.nan)
    monkeypatch.setattr(RegistrationModule, "global_step", 7)
    monkeypatch.setattr(RegistrationModule, "current_epoch", 0)
    monkeypatch.setattr(callbacks, "_validation_follows", lambda *_: False)
    interrupt = callbacks.SaveOnInterrupt(tmp_path / "last.ckpt")
    interrupt.stop_requested = True
    trainer = types.SimpleNamespace(accumulate_grad_batches=1, world_size=1, loggers=[])
    with pytest.raises(DivergedError, match="at step 7"):
        interrupt.on_train_batch_end(trainer, method, None, None, 0)


def test_a_run_that_diverges_is_finished_in_wandb(tmp_path, monkeypatch, no_network):
    """Else the next arm would log into its run."""
    import wandb

    monkeypatch.setattr(RegistrationModule, "require_finite_loss", diverge)
    with pytest.raises(DivergedError):
        train(load("1.1").arms["DCP_corr"], tmp_path / "run", logger="wandb")
    assert wandb.run is None


def diverge(self, where):
    raise DivergedError("the loss is nan")


def test_checkpoints_reload_to_the_same_network(tmp_path):
    settings = load("1.1").arms["DCP_corr"]
    trained = train(settings, tmp_path / "run")
    arm = prepare(settings)
    first, again = (fit.score(fit.load_trained(arm, trained.checkpoint), arm)[0] for _ in range(2))
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
    monkeypatch.setattr(hardware, "fast_precision", lambda accelerator: "bf16-mixed")
    steps = ["--trainer.max_steps", "2"]
    loaded = load("1.1", *steps)
    loaded.arms["DCP"].trainer.precision = "32-true"
    record = experiment.run(loaded, tmp_path / "results", tmp_path / "r")
    assert record.hardware["precision"] == "32-true / bf16-mixed"
    assert record.hardware["threads"] == torch.get_num_threads()
    assert record.hardware["gpu"] == torch.cuda.is_available()


def test_training_starts_from_other_weights():
    settings = recipe.load(ROOT / "configs" / "weights.yaml", "laptop").arms["Invariant_corr"]
    method = fit.fresh_method(settings)
    started, shipped = method.network.state_dict(), weights.load_model().state_dict()
    assert all(torch.equal(started[name], shipped[name]) for name in shipped)
    assert all(module.training for module in method.modules())
    smaller = {"network": {"layers": 1}}
    other = recipe.load(ROOT / "configs" / "weights.yaml", "laptop", smaller).arms["Invariant_corr"]
    with pytest.raises(CorrmatError, match="does not fit"):
        fit.fresh_method(other)


def test_a_layer_more_than_the_weights_have_changes_nothing():
    shipped = weights.load_model()
    hparams = json.loads(weights.shipped_metadata()["network"])
    deeper = {"network": {**hparams, "layers": hparams["layers"] + 1}}
    settings = recipe.load(ROOT / "configs" / "weights.yaml", "laptop", deeper)
    grown = fit.fresh_method(settings.arms["Invariant_corr"]).network.eval()
    pairs = benchmark.frozen_pairs("real", count=1)
    with torch.no_grad():
        before, after = (net(pairs.source, pairs.target) for net in (shipped, grown))
    torch.testing.assert_close(after.correspondence.prob(), before.correspondence.prob())


def test_the_loss_of_a_curve_is_that_of_its_batches(tmp_path):
    """Lightning divides a loss by the batches of a step."""
    options = ["--trainer.max_steps", "2", "--trainer.val_check_interval", "4"]
    options += ["--optimizer.lr", "1e-9", "--data.train_shapes", "36"]
    losses = []
    for batches in ("1", "2"):
        accumulate = ["--trainer.accumulate_grad_batches", batches]
        if batches == "1":
            accumulate += ["--trainer.max_steps", "4"]
        arm = load("1.1", *options, *accumulate).arms["DCP_corr"]
        losses.append(train(arm, tmp_path / batches).curve[-1]["loss"])
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)


def test_arms_with_other_test_pairs_are_not_compared(tmp_path):
    loaded = load("1.2")
    noisy = recipe.load(
        ROOT / "configs" / "exp" / "1.2.yaml", "smoke", {"data": {"jitter": 0.1}}
    ).arms["DCP"]
    mixed = dataclasses.replace(loaded, arms=loaded.arms | {"DCP": noisy})
    with pytest.raises(CorrmatError, match="DCP and DCP_corr would be tested on different pairs"):
        experiment.run(mixed, tmp_path / "results", tmp_path / "runs", "none")
    assert not list((tmp_path / "runs").glob("**/*.ckpt"))
