"""A trained checkpoint becomes the weights of the package: tensors and a calibration."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from corrmat import weights
from corrmat.errors import CorrmatError
from corrmat.files import ensure_writable, replace_json
from corrmat.registration.calibrate import calibrate
from corrmat.reporting.training_runs import TRAINING, TrainingRun, training_runs
from corrmat.revision import commit


def ship(
    checkpoint: Path, facts: Mapping[str, Any], results: Path, *, start: str | None, seed: int
) -> None:
    """Calibrate the confidence of a checkpoint and write its weights into the package.

    Nothing is written before the calibration is done. Training goes on from the weights that ship,
    so that the pairs of every run are added up; results/register/training.json has its curve.

    Args:
        checkpoint: of `corrmat fit`.
        facts: of its run, see `training.runs.trained_facts`.
        results: folder of records.
        start: the weights that the run started from; "corrmat" for those that ship.
        seed: of the run.
    """
    ensure_writable(results / "register")
    shipped_by = commit()
    _, hparams, network = weights.checkpoint_network(checkpoint)
    calibration, recalls = calibrate(str(checkpoint))
    before = int(weights.shipped_metadata().get("pairs", 0)) if start == "corrmat" else 0
    pairs = before + facts["pairs_seen"]
    path = weights.ship_network(
        "corrmat", "Invariant_corr", hparams, network,
        commit=str(shipped_by), calibration=json.dumps(calibration), pairs=str(pairs),
    )  # fmt: skip
    run = {"before": before, "pairs": pairs, "seed": seed, **facts, "validation": recalls}
    add_training(results, cast(TrainingRun, run))
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, trained on {pairs:,} pairs")


def refuse_used_seed(results: Path, seed: int) -> None:
    """Refuse to train on from the shipped weights with a seed that they were trained with.

    Raises:
        CorrmatError: a run of results/register/training.json has it.
    """
    if seed in (run.get("seed") for run in training_runs(results)):
        raise CorrmatError(
            f"the shipped weights have trained with seed {seed}: it would repeat the same shapes; "
            "give another --seed"
        )


def recalibrate() -> None:
    """Fit the confidence of the shipped weights anew, after a change of how they are used."""
    about = weights.shipped_metadata()
    calibration, recalls = calibrate("corrmat")
    method, network = about.pop("method"), json.loads(about.pop("network"))
    about["calibration"] = json.dumps(calibration)
    path = weights.ship_network("corrmat", method, network, weights.load_model(), **about)
    shares = ", ".join(f"{name} {recall:.0%}" for name, recall in recalls.items())
    print(f"{path}: calibrated; within 5 degrees on held-out pairs: {shares}")


def add_training(results: Path, run: TrainingRun) -> None:
    """Add a training run to results/register/training.json."""
    path = results / TRAINING
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_json(path, [*training_runs(results), run])
