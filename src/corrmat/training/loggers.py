"""Loggers: CSV unless told otherwise, and wandb offline beside it."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger

from corrmat.reporting.record import Record
from corrmat.reporting.snapshots import PairSnapshot, stages
from corrmat.reporting.tables import table

if TYPE_CHECKING:
    from wandb.sdk.wandb_run import Run

Choice = Literal["none", "csv", "wandb"]
_GREEN, _RED, _BLUE = (0, 158, 115), (213, 94, 0), (0, 114, 178)


def make_loggers(
    choice: Choice, folder: Path, arm: str, group: str, config: Mapping[str, object]
) -> list[Logger]:
    """Make the loggers of one arm's training.

    Args:
        choice: "wandb" for CSV and wandb, "csv", or "none". WANDB_MODE=disabled turns "wandb"
            into "csv"; WANDB_MODE=online sends at once; else wandb writes below the folder.
        folder: of the arm's run.
        arm: its name, wandb's job type.
        group: <scale>/<data>/<id>, wandb's group.
        config: every setting of the arm.
    """
    loggers: list[Logger] = [] if choice == "none" else [CSVLogger(folder, name="csv")]
    if choice == "wandb" and _wandb_mode() != "disabled":
        loggers.append(WandbLogger(experiment=_start_run(folder, arm, group, config)))
    return loggers


def finish_loggers(loggers: Sequence[Logger]) -> None:
    """Finish wandb's runs."""
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()


def log_record(
    choice: Choice, run: Path, record: Record, snapshots: Sequence[PairSnapshot], folder: Path
) -> None:
    """Log the record as a wandb run of its own, of job type "record".

    Args:
        choice: see `make_loggers`.
        run: folder of the experiment's runs.
        record: its numbers become the summary and a table.
        snapshots: become wandb.Object3D clouds.
        folder: of the record, for its pictures.
    """
    if choice != "wandb" or _wandb_mode() == "disabled":
        return
    import wandb

    config = {
        name: getattr(record, name) for name in ("id", "title", "scale", "data", "seed", "commit")
    }
    started = _start_run(run, "record", record.place.as_posix(), config)
    heads, rows = table(record)
    pictures = [folder / "curves.png", *([folder / "matches.png"] if snapshots else [])]
    started.log(
        {
            "table": wandb.Table(columns=["metric", *heads[1:]], data=rows),
            **{picture.stem: wandb.Image(str(picture)) for picture in pictures},
            **{f"pair/{s.rank}": wandb.Object3D(_coloured_cloud(s)) for s in snapshots},
        }
    )
    for arm, result in record.arms.items():
        for name, value in result.to_json().items():
            if isinstance(value, int | float) and math.isfinite(value):
                started.summary[f"{arm}/{name}"] = value
    started.finish()


def _coloured_cloud(snapshot: PairSnapshot) -> np.ndarray:
    """Build points with colours (N + M, 6): aligned source (right green, wrong red) and target."""
    stage = stages(snapshot)[-1]
    colours = np.where(stage.correct[:, None], _GREEN, _RED)
    target_colours = np.tile(_BLUE, (len(stage.target), 1))
    source = np.hstack([stage.source, colours])
    return np.vstack([source, np.hstack([stage.target, target_colours])])


def _wandb_mode() -> str:
    return os.environ.get("WANDB_MODE", "offline")


def _start_run(folder: Path, job: str, group: str, config: Mapping[str, object]) -> "Run":
    """Start a wandb run that writes below a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("WANDB_DATA_DIR", "WANDB_CACHE_DIR"):  # not in a home that may be read-only
        os.environ.setdefault(name, str(folder.absolute() / "wandb"))
    import wandb  # starts slowly, and not everybody wants it

    return wandb.init(
        project="corrmat",
        name=f"{group}/{job}",
        group=group,
        job_type=job,
        dir=str(folder),
        mode="online" if _wandb_mode() == "online" else "offline",
        config=dict(config),
        settings=wandb.Settings(
            silent=True, console="off", disable_git=True, save_code=False, x_disable_stats=True
        ),
    )
