"""What DCP's batch norms cost: a network with running statistics and with each batch's own.

    python benchmarks/batch_norm.py 1.2 "DCP_corr, never frozen" never_frozen.safetensors
    python benchmarks/batch_norm.py 1.2 "DCP_corr, frozen after 70 %" 1.2/DCP_corr

In training a batch norm normalises the sources of a batch by their statistics, and the targets by
theirs. In a test both are normalised by one set of running statistics. Where the two clouds differ,
that is another network than was trained. This tests one both ways, on the test pairs of scale
overnight in batches as in training, and adds the medians to results/batch_norm.json.
"""

import json
import sys
from pathlib import Path

from torch import nn

from corrmat.files import update_json
from corrmat.methods import Method
from corrmat.networks.state import load_state
from corrmat.reporting.intervals import estimates, pair_errors
from corrmat.reporting.writer import pair_rows
from corrmat.revision import commit
from corrmat.training.fit import score
from corrmat.training.preflight import Arm, build_method, prepare
from corrmat.training.recipe import load
from corrmat.weights import load_model

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "results" / "batch_norm.json"


def use_statistics_of_batches(method: Method) -> None:
    """Let batch norms normalise each batch by its own statistics, in tests as well."""
    for module in method.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean = module.running_var = None


def test(method: Method, arm: Arm) -> dict[str, dict[str, float]]:
    """Test a network, and return its median error and its matches, with intervals."""
    return estimates(pair_errors(pair_rows(arm.name, score(method, arm))))


def main(identity: str, name: str, model: str) -> None:
    """Test a network with both statistics, and write the medians.

    Args:
        identity: of the experiment on whose pairs to test.
        name: of the network in the table, beginning with its arm's.
        model: shipped network or checkpoint of DCP.
    """
    today = commit()
    path = ROOT / "configs" / "exp" / f"{identity}.yaml"
    arm_name = name.split(",")[0]
    arm = prepare(load(path, "overnight", {}, [arm_name]).arms[arm_name])
    method = build_method(arm.settings)
    load_state(method.network, load_model(model).state_dict())
    running = test(method, arm)
    use_statistics_of_batches(method)
    result = {"commit": today, "running": running, "batch": test(method, arm)}
    update_json(PATH, f"{identity} {name}", result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
