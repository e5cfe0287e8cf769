"""Where a training step's time goes on one thread: operators by kind, as stacked bars.

    python benchmarks/anatomy.py now      measures this code
    python benchmarks/anatomy.py before   the same for another checkout, by PYTHONPATH=its/src

Each run replaces its own label in results/bench/anatomy.json and draws results/bench/anatomy.png.
The shares are torch.profiler's, of the operators' own time on a CPU; they are scaled to a step
without the profiler. What is no operator is the time between them: Python, autograd, views.
One thread is how two trainings side by side use two cores. It also keeps the comparison free of
where a virtual machine's cores lie: two threads that share no cache exchange every slab.
"""

import argparse
import json
from collections import Counter
from typing import Any

import bench
import matplotlib as mpl
import torch
from matplotlib import pyplot as plt

from corrmat.files import replace_json

PLACE = bench.ROOT / "results" / "bench"
# The first kind one of whose words is in the operator's name.
KINDS = {
    "attention": ("scaled_dot_product",),
    "matrix products": ("mm", "convolution"),
    "norms": ("_norm",),
    "exponentials": ("exp_", "exp2", "logsumexp", "softmax"),
    "maxima, neighbours, rows": (
        "max", "topk", "sort", "::eq", "nonzero", "scatter", "embedding", "gather", "index_",
        "cdist", "cumsum", "euclidean",
    ),
}  # fmt: skip
VIEWS = {
    "view", "as_strided", "slice", "select", "transpose", "t", "expand", "reshape", "flatten",
    "unflatten", "unsqueeze", "squeeze", "alias", "detach", "empty", "empty_strided", "empty_like",
    "unbind", "split", "narrow", "chunk", "movedim", "permute", "to", "resolve_conj",
    "_unsafe_view",
}  # fmt: skip
ELEMENTWISE, BETWEEN = "other, element by element", "between operators"
# Okabe and Ito's colours, which colour-blind readers can tell apart.
COLOURS = ("#E69F00", "#0072B2", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#999999")
REPEATS = 3
MOST_POINTS = 1024  # larger clouds take minutes, and spend them on products and attention


def kind_of(event: str) -> str:
    """Return the kind of an operator by its name, as torch.profiler writes it."""
    if not event.startswith("aten::"):
        return BETWEEN
    for kind, words in KINDS.items():
        if any(word in event for word in words):
            return kind
    return BETWEEN if event.removeprefix("aten::") in VIEWS else ELEMENTWISE


def dissect(method: str, hparams: dict[str, Any], n: int, batch: int) -> dict[str, float]:
    """Measure the milliseconds a pair of each kind of operator in a training step."""
    torch.set_num_threads(1)
    pairs, module, step = bench.build(method, hparams, n, batch)

    def run() -> None:
        step(bench.loss_of(module, pairs))

    seconds = min(bench.median([run], 1)[0] for _ in range(REPEATS))
    for _ in range(2):  # the first profile allocates
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
            run()
    self_time: Counter[str] = Counter()
    for event in profile.key_averages():
        self_time[kind_of(event.key)] += event.self_cpu_time_total
    scale = 1e3 * seconds / batch / self_time.total()
    return {kind: round(scale * time, 3) for kind, time in self_time.items()}


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
            axes.text(
                total,
                row,
                f" {total:.3g}" if total < 100 else f" {total:,.0f}",
                va="center",
                fontsize=9,
            )
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
    for step in bench.STEPS:
        name = bench.step_name(*step)
        if step[2] > MOST_POINTS:
            continue
        measured[label][name] = bench.in_a_process(dissect, *step)
        print(name, measured[label][name], flush=True)
    replace_json(path, measured)
    draw(measured)
    print(f"written: {path.relative_to(bench.ROOT)}, anatomy.png")


if __name__ == "__main__":
    main()
