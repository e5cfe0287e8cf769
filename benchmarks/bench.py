"""Speed of the parts that cost: pairs a second, and DCP's training step against a naive twin.

    make bench        a table on the screen and in results/bench/bench.json

Times are medians after a warm-up. The naive twin is the same network with plain batch-norm
passes over the edges; both run in one process, so the ratio holds on a noisy machine.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from twins import PlainNormLinear  # noqa: E402

from corrmat.data import shapes  # noqa: E402
from corrmat.data.pairs import Key, PairSettings, make_pairs  # noqa: E402
from corrmat.methods import DCPCorr  # noqa: E402
from corrmat.module import OptimizerSettings  # noqa: E402
from corrmat.networks.dcp import DCPNetwork  # noqa: E402

SIZES = (128, 256, 512, 1024)
LAPTOP = {"width": 128, "feedforward": 256, "edge_channels": (32, 32, 64, 128), "k": 10}


def main() -> None:
    """Measure, print, write."""
    clouds = shapes.load("test", 32)
    rows = [{"what": "pairs", **pairs_a_second(clouds)}]
    for name, batch, hparams, sizes in (
        ("laptop network", 4, LAPTOP, SIZES),
        ("paper network", 2, {}, SIZES[:3]),
    ):
        for n in sizes:
            rows.append({"what": f"training step, {name}, N={n}, batch {batch}"})
            rows[-1] |= training_step(clouds, n, batch, hparams)
            print(format_row(rows[-1]), flush=True)
    print(format_row(rows[0]))
    path = ROOT / "results" / "bench" / "bench.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    found = {"threads": torch.get_num_threads(), "torch": torch.__version__, "rows": rows}
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written: {path.relative_to(ROOT)}")


def pairs_a_second(clouds: shapes.CloudSet) -> dict[str, float]:
    """Pairs a second on one core, identical sampling, N = 512."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    how = PairSettings(num_points=512)
    keys = [Key(0, 0, 0, i) for i in range(16)]
    seconds = median(lambda: make_pairs(clouds, range(16), keys, how), repeats=100)
    torch.set_num_threads(threads)
    return {"pairs_a_second": round(16 / seconds)}


def training_step(clouds: shapes.CloudSet, n: int, batch: int, hparams: dict) -> dict[str, float]:
    """Milliseconds a pair, forward and backward, ours and the naive twin's."""
    keys = [Key(0, 0, 0, i) for i in range(batch)]
    pairs = make_pairs(clouds, range(batch), keys, PairSettings(num_points=n))

    def milliseconds(naive: bool) -> float:
        torch.manual_seed(0)
        method = DCPCorr(DCPNetwork(**hparams), OptimizerSettings())
        if naive:
            for layer in method.network.embed.edge:
                layer.__class__ = PlainNormLinear

        def step() -> None:
            method.zero_grad()
            method.loss(method(pairs.source, pairs.target), pairs).backward()

        return 1e3 * median(step, repeats=5) / batch

    ours, naive = milliseconds(naive=False), milliseconds(naive=True)
    return {
        "ms_a_pair": round(ours, 1),
        "naive_ms": round(naive, 1),
        "ratio": round(naive / ours, 2),
    }


def median(work: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call, after two that do not count."""
    seconds = []
    for turn in range(repeats + 2):
        start = time.perf_counter()
        work()
        if turn >= 2:
            seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def format_row(row: dict) -> str:
    """One line of the table."""
    figures = "  ".join(f"{k} {v}" for k, v in row.items() if k != "what")
    return f"{row['what']:52s} {figures}"


if __name__ == "__main__":
    main()
