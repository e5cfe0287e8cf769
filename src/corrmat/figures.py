"""Figures of a record: the paper's curves, and what was matched with what."""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, NullFormatter

from corrmat.files import replace_bytes
from corrmat.report import METRICS, family, value_of

# The columns of the paper's figures 5, 6 and 7: what a curve shows, by the arms' family.
PANELS = {
    "DCP": ("loss", "match_accuracy", "relative_euler_rmse_deg", "translation_rmse"),
    "RPMNet": ("loss", "match_accuracy", "rotation_error_deg_mean", "chamfer"),
    "PCRNet": ("loss", "match_accuracy", "naive_euler_rmse_deg", "rotation_error_deg_mean"),
}
OF_BANDS = ("match_accuracy", "relative_euler_mae_deg", "chamfer")
OF_SWEEP = ("match_accuracy", "relative_euler_rmse_deg")
RED, BLUE, GREEN, PURPLE = "#d62728", "#1f77b4", "#2ca02c", "#9467bd"
COLOURS = (RED, BLUE, GREEN, PURPLE)  # METHOD red, METHOD_corr blue: the paper's
LINES = 150  # matches drawn, at most


class Curve(NamedTuple):
    """An arm's values, or those that the paper gives for it."""

    arm: str
    colour: str
    x: list[float]
    y: list[float]
    paper: bool = False


class Panel(NamedTuple):
    """One pair of axes."""

    title: str
    across: str  # what x counts
    log_x: bool
    log_y: bool
    curves: list[Curve]


def panels(record: Mapping[str, Any]) -> list[Panel]:
    """What the curves of a record show.

    Validation in training, against pairs seen, in the paper's columns (`PANELS`); for a test in
    bands of initial misalignment (1.4 and 2.4) what it found in each instead; and what other
    shares of outliers than the trained one do, where they were tested.
    """
    first = next(iter(record["arms"].values()))
    if first.get("bands"):
        return [_against(record, name, "bands") for name in OF_BANDS]
    own = ("loss", "match_accuracy", "rotation_error_deg_mean", "translation_rmse")
    found = [_training(record, name) for name in PANELS.get(family(record), own)]
    return found + [_against(record, name, "sweep") for name in OF_SWEEP if first.get("sweep")]


def _training(record: Mapping[str, Any], name: str) -> Panel:
    title, _, factor = METRICS.get(name, ("training loss", "", 1))
    curves = []
    lengths = []
    for arm, colour, found in _arms(record):
        seen = [point["pairs_seen"] for point in found["curve"]]
        lengths.append(max(seen, default=1))
        values = [value_of(point, name) for point in found["curve"]]
        if seen and None not in values:
            curves.append(Curve(arm, colour, seen, [factor * v for v in values if v is not None]))
        final = value_of(record["paper"].get(arm, {}), name)
        if seen and final is not None:
            ends = [min(seen[0], seen[-1] // 2), seen[-1]]
            curves.append(Curve(arm, colour, ends, [factor * final] * 2, paper=True))
    apart = max(lengths) > 4 * min(lengths)  # PCRNet's arms share minutes, not pairs
    log_y = name not in ("loss", "match_accuracy")
    return Panel(title, "training pairs seen", apart, log_y, curves)


def _against(record: Mapping[str, Any], name: str, part: str) -> Panel:
    title, _, factor = METRICS[name]
    curves = []
    for arm, colour, found in _arms(record):
        for group, paper in ((found, False), (record["paper"].get(arm, {}), True)):
            points = [(_place(p), value_of(p, name)) for p in group.get(part, [])]
            known = [(x, factor * y) for x, y in points if y is not None]
            if known:
                x, y = map(list, zip(*known, strict=True))
                curves.append(Curve(arm, colour, x, y, paper))
    across = "initial misalignment, deg" if part == "bands" else "outliers in the test, %"
    return Panel(title, across, False, name != "match_accuracy", curves)


def _place(part: Mapping[str, Any]) -> float:
    return sum(part["band_deg"]) / 2 if "band_deg" in part else 100 * part["outliers"]


def _arms(record: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    for (arm, found), colour in zip(record["arms"].items(), COLOURS, strict=False):
        yield arm, colour, found


def grid(number: int) -> tuple[int, int]:
    """Rows and columns for so many panels."""
    rows = -(-number // 4)
    return rows, -(-number // rows)


class _Plain(LogFormatter):
    """Labels between powers of ten where there is room, as 0.2 and not as 2e-01."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return super().__call__(x, pos) and f"{x:g}"


def curves_figure(record: Mapping[str, Any], path: Path) -> None:
    """`panels` of a record as a PNG; what the paper gives is dotted."""
    shown = panels(record)
    rows, columns = grid(len(shown))
    figure = Figure(figsize=(3.75 * columns, 3.6 * rows + 0.4), layout="constrained")
    figure.suptitle(f"{record['id']}  {record['title']}  ({record['scale']}, {record['data']})")
    for axes, panel in zip(figure.subplots(rows, columns).flat, shown, strict=True):
        for curve in panel.curves:
            style = {"linestyle": ":", "linewidth": 1} if curve.paper else {"marker": "."}
            label = f"paper, {curve.arm}" if curve.paper else curve.arm
            axes.plot(curve.x, curve.y, color=curve.colour, label=label, **style)
        if panel.log_x:
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())
        if panel.log_y:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(_Plain(minor_thresholds=(1, 0.4)))
        axes.set(title=panel.title, xlabel=panel.across)
        axes.grid(alpha=0.3)
    lines = {line.get_label(): line for axes in figure.axes for line in axes.lines}
    figure.legend(handles=list(lines.values()), loc="outside lower center", ncols=4)
    save(figure, path)


def matches_figure(view: Mapping[str, Any], title: str, path: Path) -> None:
    """The paper's figure 8: a pair before and after, right matches green and wrong ones red.

    Source black, target blue; points called outliers have a ring, red where they are none.

    Args:
        view: a pair and what was predicted of it; see `record.view`.
        title: above the figure.
        path: of the PNG.
    """
    x, y, match = (np.asarray(view[name]) for name in ("source", "target", "match"))
    last = view["steps"][-1]
    called = np.asarray(last["matched"])
    aligned = x @ np.asarray(last["rotation"]).T + last["translation"]
    outlier, right = called == len(y), called == match
    inlier = (match >= 0) & (match < len(y))
    x, y, aligned = map(_seen, (x, y, aligned))
    # The target is set aside, so that lines do not hide in the clouds.
    aside = y - [y[:, 0].min() - x[:, 0].max() - 0.3 * np.ptp(y[:, 0]), 0]
    boxes = _box(x, aside), _box(aligned, y)
    wide = [min(max(box[0] / box[1], 1), 3) for box in boxes]  # room for the headings
    height = min(1 + 10 / sum(wide), 6)
    figure = Figure(figsize=(10, height), layout="constrained")
    figure.suptitle(f"{title}: {100 * right[inlier].mean():.0f} % of the matches are right")
    both = figure.subplots(1, 2, width_ratios=wide)
    for axes, source, target, heading in (
        (both[0], x, aside, "source, target set aside, matches"),
        (both[1], aligned, y, "registered"),
    ):
        drawn = np.flatnonzero(~outlier)[:LINES]
        ends = np.stack([source[drawn], target[called[drawn]]], 1)
        colours = np.where(right[drawn], GREEN, RED)
        axes.add_collection(LineCollection(list(ends), colors=colours, lw=0.5, alpha=0.6, zorder=1))
        axes.scatter(*target.T, s=22, color="#9ecae9", linewidths=0, label="target")
        axes.scatter(*source.T, s=4, color="black", linewidths=0, label="source")
        if outlier.any():
            rings = np.where(right[outlier], GREEN, RED)
            axes.scatter(
                *source[outlier].T, s=60, facecolors="none", edgecolors=rings,
                label="called outlier",
            )  # fmt: skip
        axes.set(title=heading, aspect="equal")
        axes.set_axis_off()
    both[1].legend(fontsize="x-small", loc="best")
    save(figure, path)


def _seen(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) as the eye sees them from a little aside and above: (N, 2), no perspective."""
    turn, up = np.radians((10, 20))
    right = [np.cos(turn), np.sin(turn), 0]
    over = [np.sin(up) * np.sin(turn), -np.sin(up) * np.cos(turn), np.cos(up)]
    return points @ np.array([right, over]).T


def _box(*clouds: np.ndarray) -> Sequence[float]:
    return np.ptp(np.concatenate(clouds), 0).clip(1e-3)


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a PNG beside its place, then move it in; the same bytes for the same figure."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    replace_bytes(path, content.getbuffer())
