"""Writes the record of an experiment into results/, each file whole or not at all."""

import csv
import json
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import yaml
from torch import Tensor

from corrmat.reporting import figures
from corrmat.reporting.record import Record, read_record, read_snapshots
from corrmat.reporting.snapshots import PairSnapshot

FILES = (
    "per_pair.csv", "config.yaml", "curves.png", "snapshots.json", "matches.png", "metrics.json",
)  # fmt: skip


def pair_rows(arm: str, tests: Sequence[Mapping[str, Tensor]]) -> list[dict[str, object]]:
    """Build the rows of per_pair.csv: predicted and true transform of each pair, and its errors.

    A transform is twelve numbers: the rotation row by row, then the translation. Nine digits
    determine a float32, so that every metric can be computed again from the file.

    Args:
        arm: name of the arm or baseline.
        tests: per-pair values of `RegistrationMetrics.per_pair`, one set a rotation band.
    """
    rows: list[dict[str, object]] = []
    for band, values in enumerate(tests):
        for i in range(len(values["shape"])):
            correct = values["num_correct"][i]
            rows.append(
                {
                    "arm": arm,
                    "band": band,
                    "shape": int(values["shape"][i]),
                    "category": int(values["category"][i]),
                    "rotation_error_deg": f"{float(values['rotation_error_deg'][i]):.12g}",
                    "translation_error": f"{float(values['translation_error'][i]):.12g}",
                    "num_correct": int(correct) if correct.isfinite() else "",
                    "num_matchable": int(values["num_matchable"][i]),
                    "chamfer": f"{float(values['chamfer'][i]):.12g}",
                    "transform": _numbers(values["transform"][i]),
                    "true_transform": _numbers(values["true_transform"][i]),
                }
            )
    return rows


def write_record(
    folder: Path,
    record: Record,
    config: Mapping[str, object],
    rows: Sequence[Mapping[str, object]],
    snapshots: Sequence[PairSnapshot],
) -> None:
    """Write all files of a record beside their place, then move them in, metrics.json last.

    Args:
        folder: of the record.
        record: content of metrics.json.
        config: every setting of every arm, for config.yaml.
        rows: of per_pair.csv, see `pair_rows`.
        snapshots: pairs predicted by METHOD_corr, by rank of their error; may be empty.
    """
    staging = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    with (staging / "per_pair.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    (staging / "config.yaml").write_text(yaml.safe_dump(dict(config), sort_keys=False))
    if snapshots:
        content = json.dumps([asdict(snapshot) for snapshot in snapshots])
        (staging / "snapshots.json").write_text(content + "\n")
    text = json.dumps(null_for_nan(record.to_json()), indent=1)
    (staging / "metrics.json").write_text(text + "\n")
    draw_record(staging)
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        if (staging / name).exists():
            (staging / name).replace(folder / name)
        else:  # a network without matches has no pictures of them
            (folder / name).unlink(missing_ok=True)
    staging.rmdir()


def draw_record(folder: Path) -> None:
    """Draw curves.png and matches.png of the record in a folder."""
    record = read_record(folder / "metrics.json")
    figures.draw_curves(record, folder / "curves.png")
    snapshots = read_snapshots(folder)
    if snapshots:
        snapshot = snapshots[len(snapshots) // 2]
        place = f"{record.scale}, {record.data}"
        title = f"{record.id} {snapshot.arm} ({place}), the {snapshot.rank} pair"
        baseline = _baseline_result(folder, record, snapshot)
        figures.draw_matches(snapshot, title, folder / "matches.png", baseline)


def _baseline_result(
    folder: Path, record: Record, snapshot: PairSnapshot
) -> figures.BaselineResult | None:
    """Find where METHOD puts the source of a snapshot of METHOD_corr."""
    with (folder / "per_pair.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if int(row["shape"]) == snapshot.shape]

    def distance(row: Mapping[str, str]) -> float:
        return abs(float(row["rotation_error_deg"]) - snapshot.rotation_error_deg)

    # In 1.4 and 2.4 every rotation band has a pair of this shape.
    same_arm = [row for row in rows if row["arm"] == snapshot.arm]
    band = min(same_arm, key=distance)["band"] if same_arm else None
    for row in rows:
        if (row["arm"], row["band"]) == (record.baseline, band):
            values = [float(number) for number in row["transform"].split()]
            rotation = [values[start : start + 3] for start in (0, 3, 6)]
            error = float(row["rotation_error_deg"])
            return figures.BaselineResult(row["arm"], rotation, values[9:], error)
    return None


def null_for_nan(value: object) -> object:
    """Replace NaN by None in nested values: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {key: null_for_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [null_for_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(values: Tensor) -> str:
    return " ".join(f"{value:.9g}" for value in values.tolist())
