"""What a run promises when something goes wrong; docs/reliability.md lists these tests."""

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import lightning as L
import pytest
import torch
from conftest import ROOT
from test_experiment import load, press_ctrl_c, train

from corrmat.cli import main
from corrmat.errors import CorrmatError
from corrmat.training import experiment, fit
from corrmat.training.callbacks import MovableCheckpoint

STEPS = ("--trainer.max_steps", "60")  # long enough to be killed in between


def command(*words):
    options = ("--scale", "smoke", "--trainer.enable_progress_bar", "false", "--logger", "none")
    return [sys.executable, "-m", "corrmat", *words, *options]


def start(folder, *words, **variables):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **variables}
    return subprocess.Popen(
        command(*words), cwd=folder, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def weights(folder, name="last.ckpt"):
    return torch.load(folder / name, weights_only=True)["state_dict"]


def assert_same_end(folder, trained, whole):
    """Weights, curve and count of an arm are those of a run that nothing had happened to."""
    assert trained.pairs_seen == whole.pairs_seen
    assert trained.curve == whole.curve
    ours, theirs = weights(folder), weights(whole.checkpoint.parent)
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def interrupted(folder, settings, step=5):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):  # noqa: PT012
        press_ctrl_c("training_step", step, patch)
        train(settings, folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Lightning leaves it ignored


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An arm that nothing has happened to."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("whole")
    return train(load("1.1", *STEPS).arms["DCP_corr"], folder)


def killed(folder, after):
    """Kill -9 a training that has just validated for the `after`th time."""
    config = str(ROOT / "configs/exp/1.1.yaml")
    process = start(folder, "fit", "--config", config, "--arm", "DCP_corr", *STEPS)
    validations = (line for line in process.stdout if line.startswith("step"))
    for _ in range(after):
        next(validations)
    process.kill()
    process.communicate()


def test_kill_9_and_the_same_command_end_as_if_nothing_had_been(tmp_path, whole, capsys):
    torch.set_num_threads(1)
    killed(tmp_path, after=3)
    folder = tmp_path / "runs/smoke/shapes/1.1/DCP_corr"
    assert not (folder / "trained.json").exists()
    trained = train(load("1.1", *STEPS).arms["DCP_corr"], folder)
    assert "continuing from" in capsys.readouterr().out
    assert_same_end(folder, trained, whole)


@pytest.mark.parametrize("step", [6, 8])  # in the middle of the second epoch, and at its end
def test_a_run_of_epochs_whose_rate_falls_in_steps_resumes_as_well(step, tmp_path):
    """As at scale paper."""
    torch.set_num_threads(1)
    options = {
        "trainer.max_steps": -1, "trainer.max_epochs": 4, "trainer.check_val_every_n_epoch": 1,
        "trainer.val_check_interval": 1.0, "data.train_shapes": 20,
        "optimizer.schedule": "step", "optimizer.milestones": [1, 2],
    }  # fmt: skip
    words = [f"--{name}={value}" for name, value in options.items()]
    settings = load("1.1", *words).arms["DCP_corr"]
    whole = train(settings, tmp_path / "whole")
    interrupted(tmp_path / "arm", settings, step)
    assert_same_end(tmp_path / "arm", train(settings, tmp_path / "arm"), whole)


@pytest.mark.slow
def test_kill_9_at_any_moment(tmp_path, whole):
    """Killed again and again, a little later every time, until there is nothing left to do."""
    torch.set_num_threads(1)
    folder, config = tmp_path / "runs/smoke/shapes/1.1/DCP_corr", ROOT / "configs/exp/1.1.yaml"
    for kills in range(40):
        process = start(tmp_path, "fit", "--config", str(config), "--arm", "DCP_corr", *STEPS)
        process.stdout.readline()  # imports take as long as the machine is slow
        try:
            process.communicate(timeout=kills / 4)
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
    assert process.returncode == 0
    assert kills > 3
    done = json.loads((folder / "trained.json").read_text())
    assert (done["pairs_seen"], done["curve"]) == (whole.pairs_seen, whole.curve)
    ours, theirs = weights(folder), weights(whole.checkpoint.parent)
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def test_a_run_that_was_moved_still_knows_its_best_weights(tmp_path):
    """Lightning forgets their score with the folder, and any later weights would replace them."""
    best = MovableCheckpoint(tmp_path / "then", "best", monitor="val/error")
    file = str(tmp_path / "then" / "best.ckpt")
    best.best_model_path = best.kth_best_model_path = file
    best.best_model_score = best.kth_value = torch.tensor(1.5)
    best.best_k_models = {file: best.best_model_score}
    moved = MovableCheckpoint(tmp_path / "now", "best", monitor="val/error")
    moved.load_state_dict(best.state_dict())
    assert moved.best_model_path == str(tmp_path / "now" / "best.ckpt")
    assert moved.best_k_models == {moved.best_model_path: 1.5}
    assert not moved.check_monitor_top_k(L.Trainer(logger=False), torch.tensor(2.0))
    assert moved.check_monitor_top_k(L.Trainer(logger=False), torch.tensor(1.0))


def test_a_resumed_run_names_every_commit_of_its_code(tmp_path, monkeypatch):
    monkeypatch.setattr(fit, "commit", lambda: "before")
    settings = load("1.1", *STEPS).arms["DCP_corr"]
    interrupted(tmp_path / "arm", settings)
    monkeypatch.setattr(fit, "commit", lambda: "after")
    assert train(settings, tmp_path / "arm").commit == "before / after"


def test_sigterm_saves_and_says_how_to_go_on(tmp_path):
    config = str(ROOT / "configs/exp/1.1.yaml")
    process = start(tmp_path, "fit", "--config", config, "--arm", "DCP_corr",
                    "--trainer.max_steps", "100000")  # fmt: skip
    next(line for line in process.stdout if line.startswith("step"))
    process.terminate()
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert (tmp_path / "runs/smoke/shapes/1.1/DCP_corr/last.ckpt").exists()
    assert "the same command, without --fresh, continues from there" in said
    assert "Traceback" not in said


def test_fresh_starts_anew(tmp_path, whole, capsys):
    torch.set_num_threads(1)
    settings = load("1.1", *STEPS).arms["DCP_corr"]
    interrupted(tmp_path / "arm", settings)
    trained = train(settings, tmp_path / "arm", fresh=True)
    assert "continuing from" not in capsys.readouterr().out
    assert_same_end(tmp_path / "arm", trained, whole)


def test_a_checkpoint_cut_short_is_left_out(tmp_path, whole, capsys):
    torch.set_num_threads(1)
    settings = load("1.1", *STEPS).arms["DCP_corr"]
    interrupted(tmp_path / "arm", settings)
    last = tmp_path / "arm" / "last.ckpt"
    last.write_bytes(last.read_bytes()[:-1000])
    trained = train(settings, tmp_path / "arm")
    said = capsys.readouterr().out
    assert "last.ckpt cannot be read" in said
    assert "continuing from" in said
    assert_same_end(tmp_path / "arm", trained, whole)


def test_a_full_disk_keeps_the_last_good_checkpoint(tmp_path, whole):
    """A limit on the size of files is what a full disk is: writing fails half way."""
    torch.set_num_threads(1)
    settings, folder = load("1.1", *STEPS).arms["DCP_corr"], tmp_path / "arm"
    interrupted(folder, settings)
    before = {path.name: path.read_bytes() for path in folder.glob("*.ckpt")}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before["last.ckpt"]) // 2, hard))
    try:
        with pytest.raises(CorrmatError, match=r"File too large.*last good checkpoint: .*last"):
            train(settings, folder, logger="none")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {path.name: path.read_bytes() for path in folder.glob("*.ckpt")} == before
    assert not list(folder.glob("*.partial"))
    assert_same_end(folder, train(settings, folder), whole)


@pytest.mark.parametrize("option", ["--results", "--runs"])
def test_a_folder_that_cannot_be_written_is_said_at_once(option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setattr(experiment, "train", None)
    config = str(ROOT / "configs/exp/1.1.yaml")
    code = main(["run", "--config", config, "--scale", "smoke", option, str(tmp_path / "file/x")])
    assert code == 2
    assert "cannot write to" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_record_that_cannot_be_finished_leaves_whole_files(tmp_path, monkeypatch):
    """Every file is the old or the new one; metrics.json comes last, so it is still the old."""
    results, runs = tmp_path / "results", tmp_path / "runs"
    folder = results / "smoke/shapes/3.2"

    def record(lr):
        loaded = load("3.2", "--optimizer.lr", lr, arms=["PCRNet_corr"])
        return experiment.run(loaded, results, runs, "none")

    def files():
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    record("1e-3")
    old, moved = files(), []
    replace = Path.replace

    def fails_at_the_third(path, target):
        if path.parent.name == ".3.2.partial" and Path(target).parent == folder:
            moved.append(path.name)
            if len(moved) == 3:
                raise OSError("no space left on device")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", fails_at_the_third)
    with pytest.raises(OSError, match="no space left"):
        record("2e-3")
    monkeypatch.undo()
    torn = files()
    record("2e-3")
    assert set(torn) == set(old) == set(files())
    assert [name for name in torn if torn[name] not in (old[name], files()[name])] == []
    assert torn["metrics.json"] == old["metrics.json"]
    assert torn["per_pair.csv"] == files()["per_pair.csv"] != old["per_pair.csv"]
    assert "lr: 0.002" in files()["config.yaml"].decode()


@pytest.mark.parametrize("words", [["run", "--help"], []])
def test_a_reader_that_leaves_early_gets_no_traceback(words):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    process = subprocess.Popen(
        [sys.executable, "-m", "corrmat", *words], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait() == 0


def slurm(task):
    """What srun tells the second of two nodes, or the first, with a task each."""
    return {
        "SLURM_JOB_ID": str(os.getpid()), "SLURM_JOB_NAME": "corrmat", "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "1", "SLURM_NNODES": "2", "SLURM_NODELIST": "localhost",
        "SLURM_PROCID": task, "SLURM_NODEID": task, "SLURM_LOCALID": "0",
    }  # fmt: skip


@pytest.mark.parametrize("launcher", ["lightning", pytest.param("slurm", marks=pytest.mark.slow)])
def test_two_processes_train_as_one_does(tmp_path, launcher):
    """DDP: the same curve at the same global batch, every validation pair counted once.

    RPMNet, for its norms know no batch; three held-out pairs, which two cannot share evenly.
    """
    config = str(ROOT / "configs/exp/2.2.yaml")
    # A batch of two and one of four round differently, and Adam makes much of a gradient near zero.
    precision = ("--trainer.precision", "64-true")
    common = ("--data.train_shapes", "30", "--trainer.max_steps", "8", *precision)
    words = (
        "run", "--config", config, *common, "--data.batch_size", "2",
        "--trainer.accelerator", "cpu", "--trainer.strategy", "ddp",
    )  # fmt: skip
    if launcher == "slurm":
        words += ("--trainer.devices", "1", "--trainer.num_nodes", "2")
        processes = [start(tmp_path, *words, **slurm(task)) for task in ("0", "1")]
    else:
        processes = [start(tmp_path, *words, "--trainer.devices", "2")]
    for process in processes:
        said, _ = process.communicate(timeout=300)
        assert process.returncode == 0, said
    loaded = load("2.2", *common, "--data.batch_size", "4", "--trainer.accelerator", "cpu")
    torch.set_num_threads(1)
    alone = experiment.run(loaded, tmp_path / "results_1", tmp_path / "runs_1", "none")
    record = json.loads((tmp_path / "results/smoke/shapes/2.2/metrics.json").read_text())
    for arm in loaded.arms:
        ours, theirs = record["arms"][arm], alone.arms[arm].to_json()
        assert ours["pairs_seen"] == theirs["pairs_seen"] == 32
        assert len(ours["curve"]) == len(theirs["curve"]) == 2
        for one, other in zip(ours["curve"], theirs["curve"], strict=True):
            for name in ("loss", "rotation_error_deg_mean", "match_accuracy", "chamfer"):
                assert one[name] == pytest.approx(other[name], rel=1e-3, abs=1e-5)
        assert ours["pairs"] == theirs["pairs"] == 8
