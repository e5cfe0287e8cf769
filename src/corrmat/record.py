"""The record of an experiment: metrics.json, per_pair.csv, config.yaml and curves.png."""

import csv
import json
import math
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from corrmat import figures, metrics, report
from corrmat.recipe import Recipe
from corrmat.types import PairBatch, Prediction

FILES = (
    "per_pair.csv", "config.yaml", "curves.png", "views.json", "matches.png", "metrics.json",
)  # fmt: skip


def scores(
    tests: list[dict[str, Tensor]],
    bands_deg: tuple[float, ...],
    sweep: Mapping[float, dict[str, Tensor]],
) -> dict[str, Any]:
    """Metrics over all pairs of an arm, then of each rotation band and share of outliers, if any.

    Args:
        tests: per-pair values (`RegistrationMetrics.per_pair`), one set a band.
        bands_deg: the bands' edges; empty if `tests` holds one set of all pairs.
        sweep: share of outliers to per-pair values.
    """
    everything = {key: torch.cat([found[key] for found in tests]) for key in tests[0]}
    found_all: dict[str, Any] = metrics.summary(everything)
    if bands_deg:
        found_all["bands"] = [
            {"band_deg": [low, high]} | metrics.summary(found)
            for low, high, found in zip(bands_deg, bands_deg[1:], tests, strict=False)
        ]
    if sweep:
        found_all["sweep"] = [
            {"outliers": share} | metrics.summary(found) for share, found in sweep.items()
        ]
    return found_all


def rows(arm: str, tests: list[dict[str, Tensor]]) -> list[dict[str, Any]]:
    """Lines of per_pair.csv: the predicted transform of each pair and what it scores.

    A transform is twelve numbers: the rotation row by row, then the translation.

    Args:
        arm: name of the arm or baseline.
        tests: per-pair values, one set a band.
    """
    return [_line(arm, band, found, i) for band, found in enumerate(tests) for i in _pairs(found)]


def _pairs(found: dict[str, Tensor]) -> range:
    return range(len(found["shape"]))


def _line(arm: str, band: int, found: dict[str, Tensor], i: int) -> dict[str, Any]:
    return {
        "arm": arm,
        "band": band,
        "shape": int(found["shape"][i]),
        "category": int(found["category"][i]),
        "rotation_error_deg": f"{float(found['rotation_error_deg'][i]):.5g}",
        "translation_error": f"{float(found['translation_error'][i]):.5g}",
        "right": int(found["right"][i]) if found["right"][i].isfinite() else "",
        "rows": int(found["rows"][i]),
        "chamfer": f"{float(found['chamfer'][i]):.5g}",
        "transform": " ".join(f"{value:.6g}" for value in found["transform"][i].tolist()),
    }


def view(
    arm: str, rank: str, error_deg: float, batch: PairBatch, prediction: Prediction
) -> dict[str, Any]:
    """One pair as plain numbers: what figures and pages show of it.

    Args:
        arm: whose prediction.
        rank: "easiest", "median" or "hardest" pair of the test.
        error_deg: its rotation error.
        batch: a batch of this pair alone.
        prediction: of that batch, with a correspondence.
    """
    steps = [
        {
            "rotation": _rounded(step.rotation[0], 6),
            "translation": _rounded(step.translation[0], 6),
            "matched": step.correspondence.argmax()[0].tolist(),
        }
        for step in prediction.steps
        if step.correspondence is not None
    ]
    return {
        "arm": arm,
        "rank": rank,
        "rotation_error_deg": round(error_deg, 5),
        "shape": int(batch.shape[0]),
        "source": _rounded(batch.source[0, :, :3], 4),
        "target": _rounded(batch.target[0, :, :3], 4),
        "match": batch.match[0].tolist(),
        "steps": steps,
    }


def _rounded(values: Tensor, digits: int) -> Any:  # noqa: ANN401
    return np.round(values.double().numpy(), digits).tolist()


def write(
    folder: Path,
    record: dict[str, Any],
    recipe: Recipe,
    lines: list[dict[str, Any]],
    views: list[dict[str, Any]],
) -> None:
    """Write all files beside their place, then move them in, metrics.json last.

    Args:
        folder: of the record.
        record: what metrics.json holds.
        recipe: its settings.
        lines: of per_pair.csv.
        views: pairs and what METHOD_corr says of them (`view`), by rank of their error.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    with (partial / "per_pair.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(lines[0]))
        table.writeheader()
        table.writerows(lines)
    settings = {arm: report.plain(own.as_dict()) for arm, own in recipe.settings.items()}
    for own in settings.values():
        own["data"].pop("root")  # where the data lies is nobody else's business
    config = {"id": recipe.id, "scale": recipe.scale, "arms": settings}
    (partial / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    if views:
        (partial / "views.json").write_text(json.dumps(views) + "\n")
    (partial / "metrics.json").write_text(json.dumps(_finite(record), indent=1) + "\n")
    draw(partial)
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        if (partial / name).exists():
            (partial / name).replace(folder / name)
        else:  # of a network without matches
            (folder / name).unlink(missing_ok=True)
    partial.rmdir()


def draw(folder: Path) -> None:
    """Draw curves.png and matches.png of the record in a folder."""
    record = json.loads((folder / "metrics.json").read_text())
    figures.curves_figure(record, folder / "curves.png")
    if (folder / "views.json").is_file():
        views = json.loads((folder / "views.json").read_text())
        middle = views[len(views) // 2]
        figures.matches_figure(middle, _title(record, middle), folder / "matches.png")


def _title(record: dict[str, Any], view: dict[str, Any]) -> str:
    place = f"{record['scale']}, {record['data']}"
    return f"{record['id']} {view['arm']} ({place}), the {view['rank']} pair"


def _finite(value: Any) -> Any:  # noqa: ANN401
    """Nested values with null for what is not a number: JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def commit() -> str | None:
    """The commit of the code, "+" behind it when files have changed; None outside a checkout."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=here, capture_output=True, text=True, check=True
        ).stdout

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # not somebody else's checkout
        changed = git("status", "--porcelain", "--", ".", "../../configs")
        return git("rev-parse", "--short=12", "HEAD").strip() + ("+" if changed.strip() else "")
    except (OSError, subprocess.CalledProcessError):
        return None
