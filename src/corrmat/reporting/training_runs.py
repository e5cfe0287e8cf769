"""How the weights of `corrmat register` were trained: their curve, and what more would bring."""

import json
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullLocator

from corrmat.reporting.comparisons import PROTOCOLS
from corrmat.reporting.figures import BLUE, GREEN, RED, save

TRAINING = Path("register", "training.json")  # below results/


class TrainingRun(TypedDict):
    """A training of the shipped weights; an entry of results/register/training.json."""

    before: int  # pairs that the weights had seen when it started
    pairs: int  # and when it ended
    seed: NotRequired[int]  # not of the first runs
    pairs_seen: int
    train_seconds: float | None
    commit: str
    curve: list[dict[str, float]]  # on validation pairs
    validation: dict[str, float]  # share of each protocol's held-out pairs within 5 degrees


def doubling_summary(results: Path) -> str:
    """Say what twice the training pairs would bring, by a line through the ends of the runs."""
    runs = training_runs(results)
    if len(runs) < 2:
        return "Fewer than two training runs are recorded."
    gains = []
    for protocol in PROTOCOLS:
        if protocol in runs[0]["validation"]:
            slope, _ = _recall_line(runs, protocol)
            gains.append(f"{protocol} {slope:+.1f}")
    return (
        f"A straight line through the ends of the {len(runs)} runs, over the logarithm of the "
        f"pairs, says what twice the pairs bring, in points of recall: {', '.join(gains)}."
    )


def training_runs(results: Path) -> list[TrainingRun]:
    """Read how the shipped weights were trained, a run an entry; none if nothing is recorded."""
    path = results / TRAINING
    return json.loads(path.read_text()) if path.is_file() else []


def _recall_line(runs: list[TrainingRun], protocol: str) -> tuple[float, float]:
    """Fit recall in per cent by a line in log2 of the pairs: slope and intercept."""
    doublings = np.log2([run["pairs"] for run in runs])
    slope, intercept = np.polyfit(doublings, [100 * r["validation"][protocol] for r in runs], 1)
    return float(slope), float(intercept)


def draw_training(results: Path) -> None:
    """Draw how the shipped weights were trained: loss, and recall on held-out pairs.

    A dotted line is the fit of `doubling_summary`, as far as twice the pairs.
    Nothing is drawn where results/register/training.json is missing.
    """
    runs = training_runs(results)
    if not runs:
        return
    figure = Figure(figsize=(8.2, 3), layout="constrained")
    loss, recall = figure.subplots(1, 2)
    for run in runs:
        x = [run["before"] + point["pairs_seen"] for point in run["curve"]]
        loss.plot(x, [point["loss"] for point in run["curve"]], color=BLUE)
    for protocol, colour in zip(PROTOCOLS, (RED, GREEN, BLUE), strict=False):
        y = [100 * run["validation"][protocol] for run in runs]
        recall.plot([run["pairs"] for run in runs], y, "o-", color=colour, label=protocol)
        if len(runs) > 1:
            ends = np.array([runs[0]["pairs"], 2 * runs[-1]["pairs"]])
            slope, intercept = _recall_line(runs, protocol)
            recall.plot(ends, slope * np.log2(ends) + intercept, ":", color=colour)
    loss.set(title="training loss", xlabel="pairs seen")
    recall.set(title="within 5 degrees, held out, %", xlabel="pairs seen", xscale="log")
    recall.set_xticks([runs[0]["pairs"], runs[-1]["pairs"], 2 * runs[-1]["pairs"]])
    recall.xaxis.set_minor_locator(NullLocator())
    figure.legend(*recall.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    for axes in (loss, recall):
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.3)
    save(figure, results / "register" / "training.png")
