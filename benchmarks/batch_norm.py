"""What DCP's batch norms cost: the same networks with running statistics and with a batch's own.

    python benchmarks/batch_norm.py 1.2 laptop shapes
    python benchmarks/batch_norm.py outliers laptop modelnet40 ROOT

In training a batch norm normalises the sources of a batch by their statistics, and the targets by
theirs. In a test both are normalised by one set of running statistics. Where the two clouds differ,
that is another network than was trained. This trains DCP and DCP_corr with statistics that are
never frozen, and with the recipe's. It tests each network both ways, on the same pairs in the same
batches, and adds the medians to results/batch_norm.json.
"""

import json
import logging
import sys
from dataclasses import asdict, replace
from pathlib import Path

from torch import nn

from corrmat.files import replace_text
from corrmat.methods import Method
from corrmat.reporting.intervals import match_accuracy, median_rotation, pair_errors
from corrmat.reporting.writer import pair_rows
from corrmat.training.console import Board
from corrmat.training.experiment import train_or_reuse
from corrmat.training.fit import load_trained, score
from corrmat.training.preflight import Arm, prepare
from corrmat.training.recipe import load

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "results" / "batch_norm.json"
ARMS = "DCP", "DCP_corr"


def use_statistics_of_batches(method: Method) -> None:
    """Let batch norms normalise each batch by its own statistics, in tests as well."""
    for module in method.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean = module.running_var = None


def medians(method: Method, arm: Arm) -> dict[str, object]:
    """Test a network, and return its median error and its matches, with intervals."""
    errors = pair_errors(pair_rows(arm.name, score(method, arm)))
    return {
        "median_deg": asdict(median_rotation(errors)),
        "match_accuracy": asdict(match_accuracy(errors)),
    }


def main(identity: str, scale: str, data: str, root: str | None = None) -> None:
    """Train and test both arms of an experiment, with and without frozen statistics.

    Args:
        identity: of the experiment, 1.1 to 1.3 or outliers.
        scale: of the recipe.
        data: to train and test on.
        root: folder of the data set.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    path = ROOT / "configs" / "exp" / f"{identity}.yaml"
    recipe = load(path, scale, {"data": {"data": data, "root": root}})
    never = replace(recipe, id=f"{identity}-norms-never-frozen")
    rows = []
    with Board() as board:
        for name in ARMS:
            own = recipe.arms[name]
            unfrozen = replace(own, optimizer=replace(own.optimizer, freeze_norms=1.0))
            for place, settings in ((never, unfrozen), (recipe, own)):
                arm = prepare(settings)
                trained = train_or_reuse(place, arm, ROOT / "runs", "csv", board)
                method = load_trained(arm, trained.checkpoint)
                running = medians(method, arm)
                use_statistics_of_batches(method)
                rows.append(
                    {
                        "arm": name,
                        "freeze_norms": settings.optimizer.freeze_norms,
                        "pairs_seen": trained.pairs_seen,
                        "commit": trained.commit,
                        "running": running,
                        "batch": medians(method, arm),
                    }
                )
                print(json.dumps(rows[-1], indent=1), flush=True)
    content = json.loads(PATH.read_text()) if PATH.is_file() else {}
    content[f"{identity}, {scale}, {data}"] = rows
    replace_text(PATH, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
