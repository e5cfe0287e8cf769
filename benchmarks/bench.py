"""Speed and memory of what costs: pairs a second, and a training step of every network.

    make bench        a table on the screen and in results/bench/bench.json

Times are medians after a warm-up, memory is the peak of a process of its own above what it held
before its first step. DCP's naive twin is the same network with plain batch-norm passes over the
edges; both run in one process, so the ratio holds on a noisy machine.
"""

import json
import multiprocessing
import resource
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from twins import PlainEdgeConvolution  # noqa: E402

from corrmat.data import shapes  # noqa: E402
from corrmat.data.pairs import Key, PairSettings, make_pairs  # noqa: E402
from corrmat.losses import correspondence_loss  # noqa: E402
from corrmat.methods import METHODS  # noqa: E402
from corrmat.ops import streaming  # noqa: E402
from corrmat.ops.correspondence import SoftCorrespondence  # noqa: E402
from corrmat.types import PairBatch  # noqa: E402

DCP_LAPTOP = {"width": 128, "feedforward": 256, "edge_channels": (32, 32, 64, 128), "k": 6}
RPMNET_LAPTOP = {"width": 32, "k": 32, "annealing_width": 256}
# method, hyper-parameters, points, batch
STEPS: tuple[tuple[str, dict[str, Any], int, int], ...] = (
    *(("DCP_corr", DCP_LAPTOP, n, 4) for n in (128, 256, 512, 1024)),
    ("DCP_corr", {}, 512, 16),
    ("RPMNet_corr", RPMNET_LAPTOP, 256, 2),
    ("RPMNet_corr", {}, 1024, 4),
    ("PCRNet_corr", {}, 100, 32),
    ("PCRNet_corr", {}, 1024, 32),
    ("PCRNet", {}, 100, 8),
)


def main() -> None:
    """Measure, print, write."""
    rows = [{"what": "pairs, N=512, one core", **pairs_a_second()}]
    print(format_row(rows[0]), flush=True)
    for method, hparams, n, batch in STEPS:
        size = "laptop network" if hparams else "paper's network"
        row = {"what": f"{method}, {size}, N={n}, batch {batch}"}
        row |= in_a_process(training_step, method, hparams, n, batch)
        if method == "DCP_corr":
            row |= in_a_process(against_naive, hparams, n, min(batch, 4))
        rows.append(row)
        print(format_row(row), flush=True)
    for n in (512, 2048, 8192):
        row = {"what": f"correspondence loss and pose, d=512, N={n}, streamed"}
        row |= in_a_process(against_dense, n)
        rows.append(row)
        print(format_row(row), flush=True)
    path = ROOT / "results" / "bench" / "bench.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    found = {"threads": torch.get_num_threads(), "torch": torch.__version__, "rows": rows}
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written: {path.relative_to(ROOT)}")


def pairs_a_second() -> dict[str, float]:
    """Pairs a second on one core, identical sampling, N = 512."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    clouds, how = shapes.load("test", 32), PairSettings(num_points=512)
    keys = [Key(0, 0, 0, i) for i in range(16)]
    seconds = median(lambda: make_pairs(clouds, range(16), keys, how), repeats=100)
    torch.set_num_threads(threads)
    return {"pairs_a_second": round(16 / seconds)}


def training_step(method: str, hparams: dict[str, Any], n: int, batch: int) -> dict[str, float]:
    """Milliseconds a pair of a training step, and its peak memory."""
    pairs, step = build(method, hparams, n, batch)
    held = peak_mb()
    seconds = median(step, repeats=3 if n * batch > 2000 else 20)
    return {"ms_a_pair": round(1e3 * seconds / len(pairs), 1), "peak_mb": round(peak_mb() - held)}


def against_naive(hparams: dict[str, Any], n: int, batch: int) -> dict[str, float]:
    """How many times longer DCP's naive twin takes."""
    seconds = []
    for naive in (False, True):
        _, step = build("DCP_corr", hparams, n, batch, naive)
        seconds.append(median(step, repeats=5))
    return {"naive_ratio": round(seconds[1] / seconds[0], 2)}


def against_dense(n: int) -> dict[str, float]:
    """Milliseconds of loss, pose and gradient, how many times longer the whole matrix takes."""
    torch.manual_seed(0)
    f_x, f_y = (torch.randn(1, n, 512).requires_grad_() for _ in range(2))
    y, match = torch.randn(1, n, 3), torch.arange(n).unsqueeze(0)

    def step() -> None:
        c = SoftCorrespondence(f_x, f_y, 512**-0.5)
        (c.soft_target(y).sum() + correspondence_loss(c, match)).backward()

    seconds, held = [], peak_mb()
    for most in (0, n * n):  # entries up to which the matrix is made whole
        streaming._DENSE = most
        seconds.append(median(step, repeats=3))
        if not most:
            used = peak_mb() - held
    return {
        "ms": round(1e3 * seconds[0], 1),
        "peak_mb": round(used),
        "dense_ratio": round(seconds[1] / seconds[0], 2),
    }


def build(
    method: str, hparams: dict[str, Any], n: int, batch: int, naive: bool = False
) -> tuple[PairBatch, Callable[[], None]]:
    """Pairs, and a function that does one training step on them."""
    torch.manual_seed(0)
    keys = [Key(0, 0, 0, i) for i in range(batch)]
    pairs = make_pairs(shapes.load("test", batch), range(batch), keys, PairSettings(num_points=n))
    network_type = METHODS[method].network_type
    module = METHODS[method](network_type(**hparams))
    adam = torch.optim.Adam(module.parameters(), 1e-4)
    if naive:
        for layer in module.network.embed.edge:  # type: ignore[union-attr]
            layer.__class__ = PlainEdgeConvolution

    def step() -> None:
        adam.zero_grad()
        module.loss(module(pairs.source, pairs.target), pairs).backward()
        adam.step()

    return pairs, step


def in_a_process(work: Callable[..., dict[str, float]], *arguments: Any) -> dict[str, float]:  # noqa: ANN401
    """Run in a fresh process, whose peak of memory is its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(work, *arguments).result()


def peak_mb() -> float:
    """Largest resident size of this process so far, in megabytes."""
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size / 2**20 if sys.platform == "darwin" else size / 2**10


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
