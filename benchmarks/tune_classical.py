"""Search the lengths of the classical pipelines, in good faith, on validation pairs.

    python benchmarks/tune_classical.py        minutes; needs pip install open3d

The best settings are `FPFH_RANSAC` and `FPFH_FGR` in corrmat.baselines; all that were tried,
with their recalls, are in results/register/tuning.json.
"""

import functools
import itertools
import json
from pathlib import Path

from corrmat.baselines import FpfhSettings
from corrmat.registration import benchmark, hypotheses

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register" / "tuning.json"
PAIRS = 60
RADII = (0.2, 0.3, 0.45, 0.65)
INLIER_THRESHOLDS = (0.05, 0.08, 0.12)


def main() -> None:
    """Try every setting on `real` pairs of 512 and 1024 points."""
    rows = []
    pairs = {
        n: benchmark.frozen_pairs("real", points=n, count=PAIRS, split="val") for n in (512, 1024)
    }
    for model, radius, threshold, mutual in itertools.product(
        ("ransac", "fgr"), RADII, INLIER_THRESHOLDS, (True, False)
    ):
        if model == "fgr" and mutual:
            continue  # it filters its matches itself
        settings = FpfhSettings(feature_radius=radius, inlier_threshold=threshold, mutual=mutual)
        tried = functools.partial(getattr(hypotheses, model), settings=settings)
        hypotheses.CLASSICAL["tried"] = tried
        row = {"model": model, **settings._asdict()}
        for n, batch in pairs.items():
            row[f"recall_5deg_{n}"] = benchmark.compare(batch, ["tried"])["tried"].recall_5deg
        rows.append(row)
        print(row, flush=True)
    for model in ("ransac", "fgr"):
        tries = [row for row in rows if row["model"] == model]
        print("best", max(tries, key=lambda r: r["recall_5deg_512"] + r["recall_5deg_1024"]))
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
