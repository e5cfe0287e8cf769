"""Figures of a record: the paper's curves, and which points were matched with which."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogFormatter, NullFormatter

from corrmat.files import replace_bytes
from corrmat.reporting.record import ArmResult, Record, Subset, defined
from corrmat.reporting.snapshots import PairSnapshot, SnapshotStep, Stage, stages
from corrmat.reporting.tables import METRICS, MISPRINTS

# The columns of the paper's figures 5, 6 and 7, by family.
PANELS = {
    "DCP": ("loss", "match_accuracy", "relative_euler_rmse_deg", "translation_rmse"),
    "RPMNet": ("loss", "match_accuracy", "rotation_error_deg_mean", "chamfer"),
    "PCRNet": ("loss", "match_accuracy", "naive_euler_rmse_deg", "rotation_error_deg_mean"),
}
_OTHER_PANELS = ("loss", "match_accuracy", "rotation_error_deg_mean", "translation_rmse")
_PAIRS, _MINUTES = "training pairs seen", "minutes of training"
_BAND_PANELS = ("match_accuracy", "relative_euler_mae_deg", "chamfer")
_SWEEP_PANELS = ("match_accuracy", "relative_euler_rmse_deg")
# Okabe and Ito's palette, which the colour-blind can tell apart.
RED, BLUE, GREEN, PURPLE, GREY = "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#999999"
MAX_LINES = 150  # matches drawn
Source = Literal["arm", "paper", "misprint", "baseline"]
_STYLES: dict[Source, dict[str, Any]] = {
    "arm": {"linewidth": 1.4},
    "paper": {"linestyle": ":", "linewidth": 1.4},
    "baseline": {"linestyle": "--", "linewidth": 1.2},
}


class BaselineResult(NamedTuple):
    """Where METHOD puts the source of METHOD_corr's snapshot."""

    arm: str
    rotation: list[list[float]]  # (3, 3)
    translation: list[float]  # (3,)
    rotation_error_deg: float


class CurveSeries(NamedTuple):
    """An arm's values, those that the paper reports for it, or a baseline's."""

    arm: str
    colour: str
    x: list[float]
    y: list[float]
    source: Source = "arm"

    @property
    def label(self) -> str:
        """The entry in the legend."""
        before = {"arm": "", "paper": "paper, ", "misprint": "misprinted, ", "baseline": "guess: "}
        return before[self.source] + self.arm


class Panel(NamedTuple):
    """One pair of axes."""

    title: str
    xlabel: str
    log_x: bool
    log_y: bool
    series: list[CurveSeries]
    bars: bool = False


def arm_colours(record: Record) -> dict[str, str]:
    """Assign colours as the paper does: METHOD red, METHOD_corr blue, controls others."""
    colours = dict(zip(record.controls, (GREEN, PURPLE, "#E69F00"), strict=False))
    colours |= {record.treatment: BLUE} | ({record.baseline: RED} if record.baseline else {})
    return {arm: colours.get(arm, GREY) for arm in record.arms}


def panels(record: Record) -> list[Panel]:
    """Describe the curves of a record.

    They show validation during training against pairs seen, in the paper's columns (`PANELS`), and
    against minutes as well if a pair takes one arm more than twice as long as another.
    Tests in bands of initial misalignment (1.4 and 2.4) are shown against the band instead, and
    tests with other shares of outliers against the share.
    """
    first = next(iter(record.arms.values()))
    if first.bands:
        return [_subset_panel(record, name, "bands") for name in _BAND_PANELS]
    names = PANELS.get(record.family, _OTHER_PANELS)
    sweep = [_subset_panel(record, name, "sweep") for name in _SWEEP_PANELS if first.sweep]
    training = [_training_panel(record, name) for name in names]
    paces = [arm.train_seconds / arm.pairs_seen for arm in record.arms.values() if arm.pairs_seen]
    if paces and max(paces) > 2 * min(paces) > 0:
        against = ("match_accuracy", "rotation_error_deg_mean")
        training += [_training_panel(record, name, _MINUTES) for name in against]
    return training + sweep


def _training_panel(record: Record, name: str, xlabel: str = _PAIRS) -> Panel:
    """Describe the curves of one validation metric (or of the training loss).

    Args:
        record: whose.
        name: of the metric.
        xlabel: `_PAIRS`, or `_MINUTES`: an arm's training time, in proportion to its pairs.
    """
    title, _, factor = METRICS.get(name, ("training loss, share of its start", "", 1))
    series: list[CurveSeries] = []
    lengths = []
    for arm, colour, result in _arms(record):
        pace = result.train_seconds / 60 / (result.pairs_seen or 1) if xlabel == _MINUTES else 1
        spent = [pace * point["pairs_seen"] for point in result.curve]
        lengths.append(max(spent, default=1))
        values = [defined(point.get(name)) for point in result.curve]
        drawn = [(x, y) for x, y in zip(spent, values, strict=True) if y is not None]
        if drawn:
            # The arms' losses have no unit in common.
            first = drawn[0][1]
            unit = 1 / first if name == "loss" and first else factor
            x = [x for x, _ in drawn]
            series.append(CurveSeries(arm, colour, x, [unit * y for _, y in drawn]))
        final = record.paper[arm].get(name) if arm in record.paper else None
        if spent and final is not None:
            ends = [min(spent[0], spent[-1] / 2), spent[-1]]
            series.append(CurveSeries(arm, colour, ends, [factor * final] * 2, "paper"))
    guess = record.baselines.get("identity", ArmResult({})).get(name)
    if series and guess:
        x = [s.x[i] for s in series for i in (0, -1)]
        series.append(
            CurveSeries("identity", GREY, [min(x), max(x)], [factor * guess] * 2, "baseline")
        )
    # Laptop's PCRNet: equal minutes, not equal pairs.
    log_x = max(lengths, default=1) > 4 * min(lengths, default=1)
    log_y = name not in ("loss", "match_accuracy")
    return Panel(title, xlabel, log_x, log_y, series)


def _subset_panel(record: Record, name: str, part: str) -> Panel:
    """Describe a metric against rotation bands or shares of outliers."""
    title, _, factor = METRICS[name]
    series: list[CurveSeries] = []
    for arm, colour, result in _arms(record):
        sources: dict[Source, ArmResult | None] = {"arm": result, "paper": record.paper.get(arm)}
        for source, values in sources.items():
            subsets: list[Subset] = getattr(values, part) if values else []
            points: dict[Source, list[tuple[float, float]]] = {}
            for subset in subsets:
                value = defined(subset.metrics.get(name))
                if value is not None:
                    is_wrong = (record.id, arm, subset.label, name) in MISPRINTS
                    of = "misprint" if source == "paper" and is_wrong else source
                    points.setdefault(of, []).append((subset.position, factor * value))
            for of, available in points.items():
                x, y = map(list, zip(*available, strict=True))
                series.append(CurveSeries(arm, colour, x, y, of))
    xlabel = "initial misalignment, deg" if part == "bands" else "outliers in the test, %"
    log_y = name != "match_accuracy"
    return Panel(title, xlabel, False, log_y, series, bars=part == "bands")


def _arms(record: Record) -> Iterator[tuple[str, str, ArmResult]]:
    colours = arm_colours(record)
    for arm, result in record.arms.items():
        yield arm, colours[arm], result


def grid(number: int) -> tuple[int, int]:
    """Return rows and columns for this number of panels."""
    columns = 2 if number in (2, 4) else min(number, 3)
    return -(-number // columns), columns


class _PlainLogFormatter(LogFormatter):
    """Label minor ticks where there is room, as 0.2 and not as 2e-01."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return super().__call__(x, pos) and f"{x:g}"


def draw_curves(record: Record, path: Path) -> None:
    """Draw `panels` of a record as a PNG; the paper's values are dotted."""
    all_panels = panels(record)
    rows, columns = grid(len(all_panels))
    figure = Figure(figsize=(3.75 * columns, 3.2 * rows + 0.6), layout="constrained")
    figure.suptitle(f"{record.id}  {record.title}  ({record.scale}, {record.data})")
    training = [s for p in all_panels if p.xlabel == _PAIRS for s in p.series]
    ends = [value for series in training for value in (series.x[0], series.x[-1])]
    places = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes in places[len(all_panels) :]:
        axes.remove()
    for axes, panel in zip(places, all_panels, strict=False):
        if panel.bars:
            _draw_bars(axes, panel.series, record.controls)
            axes.set_xticks(record.bands_deg)
        for series in [] if panel.bars else panel.series:
            marker = "." if series.source == "arm" and len(series.x) <= 40 else ""
            style = _STYLES[series.source] | {"marker": marker}
            if series.source == "arm" and series.arm in record.controls:
                style["linestyle"] = "-."  # not by colour alone
            axes.plot(series.x, series.y, color=series.colour, label=series.label, **style)
        if panel.log_x:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        if panel.xlabel == _PAIRS and ends:
            axes.set_xlim(0.9 * min(ends) if panel.log_x else 0, 1.05 * max(ends))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if panel.log_y:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(_PlainLogFormatter(minor_thresholds=(1, 0.4)))
        axes.set(title=panel.title, xlabel=panel.xlabel)
        axes.grid(alpha=0.3)
    entries = [axes.get_legend_handles_labels() for axes in figure.axes]
    drawn = {
        label: handle
        for handles, labels in entries
        for handle, label in zip(handles, labels, strict=True)
    }
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=4)
    save(figure, path)


def _draw_bars(axes: Axes, series: list[CurveSeries], controls: Sequence[str]) -> None:
    """Draw a bar for every band and arm, and a diamond where the paper's value is.

    Bars of controls are hatched.
    """
    arms = list(dict.fromkeys(s.arm for s in series))
    for arm_series in series:
        x = np.asarray(arm_series.x)
        width = 0.8 * np.diff(x).min(initial=np.inf if len(x) > 1 else 1) / len(arms)
        at = x + width * (arms.index(arm_series.arm) - (len(arms) - 1) / 2)
        style: dict[str, Any] = {"color": arm_series.colour, "label": arm_series.label}
        if arm_series.source == "arm":
            hatch = "////" if arm_series.arm in controls else ""
            axes.bar(at, arm_series.y, width, alpha=0.75, hatch=hatch, edgecolor="white", **style)
        else:
            marker = "X" if arm_series.source == "misprint" else "D"
            style |= {"marker": marker, "s": 26, "edgecolors": "black", "zorder": 3}
            axes.scatter(at, arm_series.y, **style)


def draw_matches(
    snapshot: PairSnapshot, title: str, path: Path, baseline: BaselineResult | None = None
) -> None:
    """Draw a pair before and after, right matches green, wrong ones orange (figures 8 and 9).

    The source is black and the target blue. Points called outliers have a ring, which is orange
    if they are inliers.

    Args:
        snapshot: the pair.
        title: above the figure.
        path: of the PNG.
        baseline: where METHOD puts the source, to be drawn between the two.
    """
    view = principal_axes(np.asarray(snapshot.target))
    before, *_, after = stages(_turned(snapshot, view))
    right = f"{100 * snapshot.match_accuracy:.0f} % of the matches are right"
    scenes = [(f"{snapshot.arm}: {right}", before, True)]
    if baseline is not None:
        moved, shape = (
            (np.asarray(c) @ np.asarray(baseline.rotation).T + np.asarray(baseline.translation))
            @ view
            for c in (snapshot.source, snapshot.clean)
        )
        none = np.zeros(len(moved), bool)
        scene = Stage(
            baseline.arm, moved, after.target, np.zeros(len(moved), np.int64), none, shape
        )
        scenes.append(
            (f"{baseline.arm}: {_degrees(baseline.rotation_error_deg)} off", scene, False)
        )
    scenes.append((f"{snapshot.arm}: {_degrees(snapshot.rotation_error_deg)} off", after, True))
    boxes = [_box(_project(np.concatenate([s.shape, s.source, s.target]))) for _, s, _ in scenes]
    widths = [min(max(box[0] / box[1], 1), 3) for box in boxes]  # room for the headings
    figure = Figure(figsize=(10, min(1 + 10 / sum(widths), 6)), layout="constrained")
    figure.suptitle(title)
    for axes, (heading, scene, has_matches) in zip(
        figure.subplots(1, len(scenes), width_ratios=widths), scenes, strict=True
    ):
        _draw_scene(axes, scene, has_matches=has_matches)
        axes.set_title(heading, fontsize="medium")
    handles, labels = figure.axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize="small")
    save(figure, path)


def _degrees(error: float) -> str:
    """Format an angle to two digits, or to a whole degree."""
    return f"{error:.0f} deg" if error >= 10 else f"{error:.2g} deg"


def _draw_scene(axes: Axes, scene: Stage, *, has_matches: bool) -> None:
    """Draw two clouds, the shape behind the source, and the matches between them if asked to."""
    source, target = _project(scene.source), _project(scene.target)
    axes.scatter(*_project(scene.shape).T, s=7, color="0.85", linewidths=0, zorder=0, label="shape")
    if has_matches:
        axes.add_collection(_match_lines(scene, source, target))
    axes.scatter(*target.T, s=18, color="#9ecae9", linewidths=0, label="target")
    axes.scatter(*source.T, s=4, color="black", linewidths=0, label="source")
    for right, colour in ((True, GREEN), (False, RED)):
        called = scene.called_outlier & (scene.correct == right)
        if called.any():
            label = f"called outlier, {'rightly' if right else 'wrongly'}"
            rings = {"s": 60, "facecolors": "none", "edgecolors": colour, "label": label}
            axes.scatter(*source[called].T, **rings)
    axes.set_aspect("equal")
    axes.set_axis_off()


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Return the axes (3, 3), columns, of points' (N, 3) largest, least and middle extent.

    With them as x, depth and height no view is edge-on.
    """
    _, _, rows = np.linalg.svd(points - points.mean(0), full_matrices=False)
    view = rows[[0, 2, 1]].T
    return view * [1, np.linalg.det(view), 1]


def _turned(snapshot: PairSnapshot, view: np.ndarray) -> PairSnapshot:
    """Turn a pair so that the columns of `view` (3, 3) become the axes of the picture."""
    steps = [
        SnapshotStep(
            (view.T @ np.asarray(step.rotation) @ view).tolist(),
            (np.asarray(step.translation) @ view).tolist(),
            step.matched,
        )
        for step in snapshot.steps
    ]
    clouds = {
        name: (np.asarray(getattr(snapshot, name)) @ view).tolist()
        for name in ("source", "target", "clean")
    }
    return replace(snapshot, steps=steps, **clouds)


def _match_lines(stage: Stage, source: np.ndarray, target: np.ndarray) -> LineCollection:
    """Draw lines between matched points of projected clouds (N, 2) and (M, 2)."""
    drawn = np.flatnonzero(~stage.called_outlier)[:MAX_LINES]
    ends = np.stack([source[drawn], target[stage.matched[drawn]]], 1)
    colours = np.where(stage.correct[drawn], GREEN, RED)
    return LineCollection(list(ends), colors=list(colours), lw=0.5, alpha=0.6, zorder=1)


def _project(points: np.ndarray) -> np.ndarray:
    """Project points (N, 3) to (N, 2), seen from a little aside and above, orthographically."""
    azimuth, elevation = np.radians((10, 20))
    right = [np.cos(azimuth), np.sin(azimuth), 0]
    up_xy = np.sin(elevation) * np.array([np.sin(azimuth), -np.cos(azimuth)])
    return points @ np.array([right, [*up_xy, np.cos(elevation)]]).T


def _box(points: np.ndarray) -> np.ndarray:
    """Return width and height of projected points."""
    return np.ptp(points, 0).clip(1e-3)


def to_png(figure: Figure, dpi: int = 110) -> bytes:
    """Render a figure as a PNG; the same figure gives the same bytes."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    return content.getvalue()


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure as a PNG, atomically."""
    replace_bytes(path, to_png(figure, dpi))
