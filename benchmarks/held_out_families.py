"""What the network of `corrmat register` loses on families that it was not trained on.

    python benchmarks/held_out_families.py [ROOT]        half an hour on one core; can be resumed

Two small trainings, each without one of two groups of ten families. Both are tested on the same
`real` pairs of both groups, so that every pair is of a family seen for one network and not seen
for the other; and, if the folder of ModelNet40 is given, on its `real` pairs. So is the shipped
network. The record is results/register/held_out_families.json.
"""

import sys
from dataclasses import fields
from pathlib import Path

from corrmat.cli import main as corrmat
from corrmat.data.shapes.dataset import NAMES, SIZE
from corrmat.registration import benchmark
from corrmat.reporting.model_results import write_comparison
from corrmat.revision import commit
from corrmat.types import PairBatch

ROOT = Path(__file__).resolve().parents[1]
GROUPS = {"first": NAMES[0::4], "second": NAMES[2::4]}
DATA = "shapes+assemblies"  # all are tested on objects
SETTINGS = {  # 8,000 pairs
    "start": "null", "seed": 0, "network.layers": 2, "trainer.max_steps": 1000,
    "data.data": DATA, "data.train_shapes": "null", "data.num_points": 512, "data.keep": 0.7,
    "optimizer.lr": 1e-3,
}  # fmt: skip


def train(left_out: str) -> Path:
    """Train without a group of families; return the checkpoint."""
    families = [name for name in NAMES if name not in GROUPS[left_out]]
    name = f"{DATA}-without-{left_out}"
    settings = SETTINGS | {"data.name": name, "data.categories": [*families, "assembly"]}
    words = [f"--{option}={value}" for option, value in settings.items()]
    recipe, runs = ROOT / "configs" / "weights.yaml", ROOT / "runs"
    code = corrmat(["fit", f"--config={recipe}", f"--runs={runs}", *words])
    if code:
        sys.exit(code)
    return runs / "laptop" / name / "weights" / "Invariant_corr" / "last.ckpt"


def pairs_of(pairs: PairBatch, group: str) -> PairBatch:
    """Select the pairs of the families of a group."""
    families = [NAMES[shape % len(NAMES)] for shape in pairs.shape]
    chosen = [row for row, family in enumerate(families) if family in GROUPS[group]]
    return PairBatch(**{f.name: getattr(pairs, f.name)[chosen] for f in fields(pairs)})


def main(root: str | None = None) -> None:
    """Train both, then test each on all pairs."""
    code = commit()
    pairs = benchmark.frozen_pairs("real", count=SIZE["test"])
    tests = {group: pairs_of(pairs, group) for group in GROUPS}
    if root is not None:
        tests["modelnet40"] = benchmark.frozen_pairs("real", "modelnet40", Path(root))
    results = {}
    models = {f"without {left_out}": str(train(left_out)) for left_out in GROUPS}
    for what, model in (models | {"shipped": "corrmat"}).items():
        for name, test in tests.items():
            results[f"{what}, {name}"] = benchmark.compare(test, [model])[model]
    print(benchmark.to_table(results))
    about = {"protocol": "real", "points": 512, **{name: list(g) for name, g in GROUPS.items()}}
    path = ROOT / "results" / "register" / "held_out_families.json"
    write_comparison(path, results, about | {"commit": code, "settings": SETTINGS})


if __name__ == "__main__":
    main(*sys.argv[1:])
