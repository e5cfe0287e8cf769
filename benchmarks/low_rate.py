"""RPMNet_corr at RPMNet's own learning rate: what the loss does where the rates are equal (2.2).

    python benchmarks/low_rate.py overnight shapes
    python benchmarks/low_rate.py overnight modelnet40 ROOT

The paper trains RPMNet at a steady 1e-4 and RPMNet_corr from 1e-2 down. The recipe's control is
RPMNet at a high rate; this is the other one. It trains RPMNet_corr at RPMNet's rate, unless that
is done, tests it on the pairs of experiment 2.2, and adds it to results/low_rate.json beside the
arms of the record.
"""

import json
import logging
import sys
from dataclasses import asdict, replace
from pathlib import Path

from corrmat.files import update_json
from corrmat.reporting.intervals import (
    estimates,
    p_of_equal_errors,
    pair_errors,
    ratio_of_medians,
    read_errors,
)
from corrmat.reporting.writer import pair_rows
from corrmat.training.console import Board
from corrmat.training.experiment import train_or_reuse
from corrmat.training.fit import load_trained, score
from corrmat.training.preflight import prepare
from corrmat.training.recipe import load

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "results" / "low_rate.json"
ARM = "RPMNet_corr"


def main(scale: str, data: str, root: str | None = None) -> None:
    """Train and test RPMNet_corr at RPMNet's rate, and write it beside the record's arms.

    Args:
        scale: of the recipe.
        data: to train and test on.
        root: folder of the data set.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    path = ROOT / "configs" / "exp" / "2.2.yaml"
    recipe = load(path, scale, {"data": {"data": data, "root": root}})
    low = recipe.arms["RPMNet"].optimizer
    arm = prepare(replace(recipe.arms[ARM], optimizer=low))
    place = replace(recipe, id=f"{recipe.id}-low-rate", networks_of=None)
    with Board() as board:
        trained = train_or_reuse(place, arm, ROOT / "runs", "csv", board)
    record = read_errors(ROOT / "results" / recipe.place / "per_pair.csv")
    tested = pair_errors(pair_rows(ARM, score(load_trained(arm, trained.checkpoint), arm)))
    rows = {f"RPMNet, steady {low.lr:g}": record["RPMNet"], f"{ARM}, steady {low.lr:g}": tested}
    for name in ("RPMNet_high_rate", ARM):
        peak = recipe.arms[name].optimizer.lr
        rows[f"{recipe.arms[name].method}, one cycle to {peak:g}"] = record[name]
    content = {
        "commit": trained.commit,
        "pairs_seen": trained.pairs_seen,
        "rows": {name: estimates(errors) for name, errors in rows.items()},
        "ratio_at_the_low_rate": asdict(ratio_of_medians(record["RPMNet"], tested)),
        "p": p_of_equal_errors(record["RPMNet"], tested),
    }
    update_json(PATH, f"{scale}, {data}", content)
    print(json.dumps(content, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
