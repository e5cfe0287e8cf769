"""Search the lengths of the classical pipelines, in good faith, on validation pairs.

    python benchmarks/tune_classical.py        minutes; needs pip install open3d

The best settings are `RANSAC` and `FGR` in corrmat.aligners; all that were tried,
with their recalls, are in results/register/tuning.json.
"""

import functools
import itertools
import json
from pathlib import Path

from corrmat.aligners import ClassicalSettings

from corrmat import aligners, comparison

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register" / "tuning.json"
PAIRS = 60
RADII = (0.2, 0.3, 0.45, 0.65)
REACHES = (0.05, 0.08, 0.12)


def main() -> None:
    """Try every setting on `real` pairs of 512 and 1024 points."""
    found = []
    pairs = {
        n: comparison.frozen_pairs("real", points=n, count=PAIRS, split="val") for n in (512, 1024)
    }
    for model, radius, reach, mutual in itertools.product(
        ("ransac", "fgr"), RADII, REACHES, (True, False)
    ):
        if model == "fgr" and mutual:
            continue  # it filters its matches itself
        how = ClassicalSettings(feature_radius=radius, reach=reach, mutual=mutual)
        tried = functools.partial(getattr(aligners, model), how=how)
        aligners.CLASSICAL["tried"] = tried
        row = {"model": model, **how._asdict()}
        for n, batch in pairs.items():
            row[f"recall_5deg_{n}"] = comparison.compare(batch, ["tried"])["tried"]["recall_5deg"]
        found.append(row)
        print(row, flush=True)
    for model in ("ransac", "fgr"):
        own = [row for row in found if row["model"] == model]
        print("best", max(own, key=lambda r: r["recall_5deg_512"] + r["recall_5deg_1024"]))
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
