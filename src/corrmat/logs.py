"""Where a run is logged: CSV always unless told otherwise, wandb offline beside it."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger

from corrmat import report

Choice = Literal["none", "csv", "wandb"]


def loggers(
    choice: Choice, folder: Path, arm: str, group: str, config: Mapping[str, Any]
) -> list[Logger]:
    """The loggers of one arm's training.

    Args:
        choice: "wandb" for CSV and wandb, "csv", or "none". WANDB_MODE=disabled turns "wandb"
            into "csv", WANDB_MODE=online sends at once; else wandb writes below the folder.
        folder: of the arm's run.
        arm: its name, wandb's job type.
        group: what belongs together: <scale>/<data>/<id>.
        config: every resolved setting.
    """
    found: list[Logger] = [] if choice == "none" else [CSVLogger(folder, name="csv")]
    if choice == "wandb" and _mode() != "disabled":
        found.append(WandbLogger(experiment=_start(folder, arm, group, config)))
    return found


def finish(made: list[Logger]) -> None:
    """Close what must be closed."""
    for logger in made:
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()


def send_record(
    choice: Choice, run: Path, record: Mapping[str, Any], views: list[dict[str, Any]], at: Path
) -> None:
    """The record as a wandb run of its own, of job type "record".

    Args:
        choice: see `loggers`.
        run: folder of the experiment's runs.
        record: what metrics.json holds: its numbers become the summary and a table.
        views: of `record.view`: become wandb.Object3D clouds.
        at: folder of the record, for its pictures.
    """
    if choice != "wandb" or _mode() == "disabled":
        return
    import wandb

    group = f"{record['scale']}/{record['data']}/{record['id']}"
    config = {name: record[name] for name in ("id", "title", "scale", "data", "seed", "commit")}
    started = _start(run, "record", group, config)
    heads, rows = report.table(record)
    pictures = [at / "curves.png", *([at / "matches.png"] if views else [])]
    started.log(
        {
            "table": wandb.Table(columns=["metric", *heads[1:]], data=rows),
            **{picture.stem: wandb.Image(str(picture)) for picture in pictures},
            **{f"pair/{view['rank']}": wandb.Object3D(_cloud(view)) for view in views},
        }
    )
    for arm, found in record["arms"].items():
        for name, value in found.items():
            if isinstance(value, int | float) and math.isfinite(value):
                started.summary[f"{arm}/{name}"] = value
    started.finish()


def _cloud(view: Mapping[str, Any]) -> np.ndarray:
    """Points and colours (N + M, 6): the source as it was moved, right matches green, wrong red."""
    step = view["steps"][-1]
    moved = np.array(view["source"]) @ np.array(step["rotation"]).T + np.array(step["translation"])
    right = np.array(step["matched"]) == np.array(view["match"])
    green, red, blue = (44, 160, 44), (214, 39, 40), (31, 119, 180)
    target = np.array(view["target"])
    colours = np.where(right[:, None], green, red)
    return np.vstack(
        [np.hstack([moved, colours]), np.hstack([target, np.tile(blue, (len(target), 1))])]
    )


def _mode() -> str:
    return os.environ.get("WANDB_MODE", "offline")


def _start(folder: Path, job: str, group: str, config: Mapping[str, Any]) -> Any:  # noqa: ANN401
    import wandb  # starts slowly, and not everybody wants it

    folder.mkdir(parents=True, exist_ok=True)
    return wandb.init(
        project="corrmat",
        name=f"{group}/{job}",
        group=group,
        job_type=job,
        dir=str(folder),
        mode="online" if _mode() == "online" else "offline",
        config=dict(config),
        settings=wandb.Settings(
            silent=True, console="off", disable_git=True, save_code=False, x_disable_stats=True
        ),
    )
