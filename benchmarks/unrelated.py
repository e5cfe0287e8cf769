"""What the shipped weights say of two clouds that do not show one thing: no pose is right.

    python benchmarks/unrelated.py        some minutes

Sources of test pairs beside targets of others, of the embedded shapes and of large clouds. The
record is results/register/unrelated.json; the confidence is computed from its scores.
"""

from dataclasses import asdict
from pathlib import Path

from corrmat.files import replace_json
from corrmat.registration import benchmark
from corrmat.reporting.confidences import UNRELATED
from corrmat.revision import commit

RESULTS = Path(__file__).resolve().parents[1] / "results"
PAIRS = 60  # of each protocol and size


def main() -> None:
    """Register the pairs of every protocol."""
    code, entries = commit(), []
    for protocol, sizes in benchmark.TABLE_POINTS.items():
        for points in sizes:
            pairs = benchmark.unrelated(benchmark.frozen_pairs(protocol, points=points), PAIRS)
            result = benchmark.compare(pairs, ["corrmat"])["corrmat"]
            print(protocol, points)
            entries.append({"protocol": protocol, "points": points, "result": asdict(result)})
    replace_json(RESULTS / UNRELATED, {"commit": code, "pairs": entries})


if __name__ == "__main__":
    main()
