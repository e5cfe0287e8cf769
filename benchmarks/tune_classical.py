"""Search the lengths of the classical pipelines, in good faith, on validation pairs.

    python benchmarks/tune_classical.py        an hour; needs pip install -e '.[baselines]'

One setting serves all protocols, as ours does. The best are `FPFH_RANSAC`, `FPFH_FGR` and `KISS`
in corrmat.baselines; all that were tried, with their recalls, are in results/register/tuning.json.
A search that was interrupted goes on.
"""

import functools
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

from corrmat.baselines import FpfhSettings, KissSettings
from corrmat.files import replace_json
from corrmat.registration import benchmark, hypotheses

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register" / "tuning.json"
PAIRS = 100  # of each protocol
PROTOCOLS = ("real", "views", "clean")
RADII = (0.45, 0.65, 0.9)
INLIER_THRESHOLDS = {"ransac": (0.08, 0.12, 0.18), "fgr": (0.03, 0.05, 0.08)}
VOXEL_SIZES = (0.06, 0.08, 0.1, 0.13, 0.17, 0.22)


def settings() -> Iterator[tuple[str, FpfhSettings | KissSettings]]:
    """Yield every model and setting to try."""
    for model, thresholds in INLIER_THRESHOLDS.items():
        for radius, threshold in itertools.product(RADII, thresholds):
            yield model, FpfhSettings(radius, threshold)
    for size in VOXEL_SIZES:
        yield "kiss", KissSettings(size)


def main() -> None:
    """Try every setting on pairs of 512 points of all protocols."""
    rows = json.loads(RESULTS.read_text()) if RESULTS.is_file() else []
    done = {json.dumps([row["model"], row["settings"]]) for row in rows}
    pairs = {
        protocol: benchmark.frozen_pairs(protocol, count=PAIRS, split="val")
        for protocol in PROTOCOLS
    }
    for model, chosen in settings():
        if json.dumps([model, chosen._asdict()]) in done:
            continue
        tried = functools.partial(getattr(hypotheses, model), settings=chosen)
        hypotheses.CLASSICAL["tried"] = tried
        recalls = {
            protocol: benchmark.compare(batch, ["tried"])["tried"].recall_5deg
            for protocol, batch in pairs.items()
        }
        rows.append({"model": model, "settings": chosen._asdict(), "recall_5deg": recalls})
        print(rows[-1], flush=True)
        replace_json(RESULTS, rows)
    for model in ("ransac", "fgr", "kiss"):
        tries = [row for row in rows if row["model"] == model]
        print("best", max(tries, key=lambda row: sum(row["recall_5deg"].values())))


if __name__ == "__main__":
    main()
