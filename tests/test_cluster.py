"""`make all LAUNCHER=ray`, on a real cluster of two workers on this machine."""

import os
import shutil
import signal
import subprocess
import threading
from pathlib import Path

import pytest
from conftest import ROOT, parse_overrides
from test_experiment import load, numbers

from corrmat.errors import CorrmatError
from corrmat.training import cluster, experiment

CONFIGS = [ROOT / "configs/exp" / f"{name}.yaml" for name in ("1.1", "1.4")]


def kill_a_worker_after(checkpoint, killed):
    """Kill -9 the first worker that trains, once it has written a checkpoint; note its number."""
    tick = threading.Event()
    while not checkpoint.exists():
        tick.wait(0.05)
    command = ["pgrep", "-f", "ray::1.1 DCP"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    os.kill(int(listed.stdout.split()[0]), signal.SIGKILL)
    killed.append(listed.stdout)


@pytest.mark.slow
def test_arms_trained_by_two_workers_one_of_them_killed_give_the_same_record(tmp_path, capfd):
    ray = pytest.importorskip("ray")
    if shutil.which("pgrep") is None:
        pytest.skip("pgrep is not at hand")
    steps = ("--trainer.max_steps", "20")
    alone = experiment.run(load("1.1", *steps), tmp_path / "results_1", tmp_path / "runs_1", "none")
    ray.init(num_cpus=2)
    checkpoint = tmp_path / "runs/smoke/shapes/1.1/DCP/last.ckpt"
    killed = []
    killer = threading.Thread(target=kill_a_worker_after, args=(checkpoint, killed), daemon=True)
    killer.start()
    try:
        overrides = parse_overrides(["--trainer.enable_progress_bar", "false", *steps])
        cluster.train_all(CONFIGS, "smoke", overrides, tmp_path / "runs", "none")
    finally:
        ray.shutdown()
    killer.join(timeout=30)
    assert killed
    said = capfd.readouterr().out
    assert "1.1 DCP: trained" in said
    assert "1.1 DCP_corr: trained" in said
    assert "1.4 DCP" not in said  # tests the networks of 1.1
    record = experiment.run(load("1.1", *steps), tmp_path / "results", tmp_path / "runs", "none")
    assert "trained already" in capfd.readouterr().out
    assert numbers(record) == numbers(alone)


def test_without_ray_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(CorrmatError, match=r"pip install ray"):
        cluster.train_all(CONFIGS, "smoke", {}, Path("runs"))
