"""Where a training step's time goes: operators by kind, as stacked bars.

    python benchmarks/anatomy.py now        measures this code
    python benchmarks/anatomy.py "before"   the same for another checkout, by PYTHONPATH=its/src

Each run replaces its own label in results/bench/anatomy.json and draws results/bench/anatomy.png.
Every operator is timed by the host as PyTorch dispatches it, so this is for CPUs. What is left of
an untimed step is the time between operators: Python, autograd, allocation.
"""

import argparse
import json
import time
from collections import Counter
from typing import Any

import bench
import matplotlib as mpl
import torch
from matplotlib import pyplot as plt
from torch.utils._python_dispatch import TorchDispatchMode

PLACE = bench.ROOT / "results" / "bench"
# The first kind whose word occurs in the operator's name.
KINDS = {
    "attention": ("scaled_dot_product",),
    "matrix products": ("mm", "convolution"),
    "norms": ("_norm",),
    "exponentials": ("exp", "softmax"),
    "maxima, neighbours, rows": (
        "amax", "max", "topk", "sort", "eq", "nonzero", "scatter", "embedding", "gather", "index",
        "cdist", "cumsum", "euclidean",
    ),
}  # fmt: skip
ELEMENTWISE, BETWEEN = "other, element by element", "between operators"
# Okabe and Ito's colours, which colour-blind readers can tell apart.
COLOURS = ("#E69F00", "#0072B2", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#999999")
REPEATS = 5


def kind_of(operator: str) -> str:
    """Return the kind of an operator by its name."""
    for kind, words in KINDS.items():
        if any(word in operator for word in words):
            return kind
    return ELEMENTWISE


class OperatorTimes(TorchDispatchMode):
    """Sums the seconds of every kind of operator."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: Counter[str] = Counter()

    def __torch_dispatch__(
        self,
        func: Any,  # noqa: ANN401
        types: Any,  # noqa: ANN401
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:  # noqa: ANN401
        """Run an operator and take its time."""
        start = time.perf_counter()
        result = func(*args, **(kwargs or {}))
        self.seconds[kind_of(func.overloadpacket.__name__)] += time.perf_counter() - start
        return result


def dissect(method: str, hparams: dict[str, Any], n: int, batch: int) -> dict[str, float]:
    """Measure the milliseconds a pair of each kind of operator in a training step."""
    pairs, module, step = bench.build(method, hparams, n, batch)

    def run() -> None:
        step(bench.loss_of(module, pairs))

    best: Counter[str] | None = None
    for _ in range(REPEATS):
        with OperatorTimes() as times:
            run()
        if best is None or times.seconds.total() < best.total():
            best = times.seconds
    assert best is not None
    whole = min(bench.median([run], 1)[0] for _ in range(REPEATS))
    best[BETWEEN] = max(0.0, whole - best.total())
    return {kind: round(1e3 * seconds / batch, 3) for kind, seconds in best.items()}


def draw(measured: dict[str, dict[str, dict[str, float]]]) -> None:
    """Draw the bars of every label, one row a training step."""
    mpl.use("Agg")
    steps = list(dict.fromkeys(step for bars in measured.values() for step in bars))
    figure, panels = plt.subplots(
        len(steps), 1, figsize=(8, 1.3 * len(steps) + 0.6), layout="constrained"
    )
    kinds = [*KINDS, ELEMENTWISE, BETWEEN]
    for axes, step in zip(panels, steps, strict=True):
        labels = [label for label in measured if step in measured[label]]
        left = [0.0] * len(labels)
        for kind, colour in zip(kinds, COLOURS, strict=True):
            width = [measured[label][step].get(kind, 0) for label in labels]
            axes.barh(labels, width, left=left, color=colour, label=kind)
            left = [a + b for a, b in zip(left, width, strict=True)]
        for row, total in enumerate(left):
            axes.text(total, row, f" {total:.3g}", va="center", fontsize=9)
        axes.set_title(step, fontsize=9, loc="left")
        axes.set_xlim(0, 1.12 * max(left))
        axes.invert_yaxis()
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=9)
    panels[-1].set_xlabel("milliseconds a pair")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3,
                  frameon=False, fontsize=9)  # fmt: skip
    figure.savefig(PLACE / "anatomy.png", dpi=120)
    plt.close(figure)


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("label", help="of these bars, e.g. now")
    label = parser.parse_args().label
    path = PLACE / "anatomy.json"
    measured = json.loads(path.read_text()) if path.is_file() else {}
    measured[label] = {}
    for method, hparams, n, batch in bench.STEPS:
        size = "laptop network" if hparams else "paper's network"
        name = f"{method}, {size}, N={n}, batch {batch}"
        measured[label][name] = bench.in_a_process(dissect, method, hparams, n, batch)
        print(name, measured[label][name], flush=True)
    path.write_text(json.dumps(measured, indent=1) + "\n")
    draw(measured)
    print(
        f"written: {path.relative_to(bench.ROOT)}, anatomy.png; threads: {torch.get_num_threads()}"
    )


if __name__ == "__main__":
    main()
