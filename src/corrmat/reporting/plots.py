"""Interactive plots of the page, as plotly's plain dictionaries."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from corrmat.reporting.figures import BLUE, GREEN, GREY, RED, arm_colours, grid, panels
from corrmat.reporting.intervals import read_errors
from corrmat.reporting.record import Record
from corrmat.reporting.snapshots import PairSnapshot, Stage, stages, thin

Plot = dict[str, object]
"""A plotly figure: `data` and `layout`."""
QUANTILES = np.linspace(0, 1, 51)
_MAX_POINTS, _MAX_LINES = 200, 60  # drawn of a cloud, of the matches: the page stays small


def curves_plot(record: Record) -> Plot:
    """Plot `figures.panels` of a record."""
    all_panels = panels(record)
    rows, columns = grid(len(all_panels))
    data: list[Plot] = []
    layout: Plot = {
        "grid": {"rows": rows, "columns": columns, "pattern": "independent"},
        "margin": {"t": 40, "r": 10},
        "legend": {"orientation": "h", "y": -0.25 / rows},
        "height": 330 * rows,
    }
    for index, panel in enumerate(all_panels):
        suffix = "" if index == 0 else str(index + 1)
        for series in panel.series:
            in_legend = all(trace.get("name") != series.label for trace in data)
            label: Plot = {"name": series.label, "showlegend": in_legend}
            line = {"color": series.colour}
            if series.source != "arm":
                mode = "markers" if series.source == "misprint" else "lines"
                label = {"name": series.label, "mode": mode, "showlegend": False}
                line["dash"] = "dot" if series.source == "paper" else "dash"
            axes = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": series.arm}
            x, y = ([float(f"{value:.4g}") for value in values] for values in (series.x, series.y))
            data.append(axes | {"x": x, "y": y, "line": line} | label)
        for axis, log, text in (("x", panel.log_x, panel.xlabel), ("y", panel.log_y, panel.title)):
            title = {"text": text, "standoff": 4}
            layout[f"{axis}axis{suffix}"] = {"type": "log" if log else "linear", "title": title}
    return {"data": data, "layout": layout}


def errors_plot(per_pair: Path, record: Record) -> Plot:
    """Plot the empirical distribution of rotation errors, a line an arm or baseline.

    Args:
        per_pair: per_pair.csv of the record.
        record: names and colours of the arms.
    """
    colours = arm_colours(record)
    data = []
    for arm, errors in read_errors(per_pair).items():
        quantiles = np.quantile(errors.rotation_deg, QUANTILES, method="inverted_cdf")
        style = {"color": colours.get(arm, GREY), "dash": "solid" if arm in colours else "dash"}
        x = [float(f"{max(value, 1e-4):.4g}") for value in quantiles]
        share = (100 * QUANTILES).round(1).tolist()
        data.append({"x": x, "y": share, "name": arm, "line": style})
    layout = {
        "xaxis": {"type": "log", "title": {"text": "rotation error, deg"}},
        "yaxis": {"title": {"text": "% of test pairs below"}},
        "margin": {"t": 20, "r": 10},
    }
    return {"data": data, "layout": layout}


def snapshot_plot(snapshot: PairSnapshot) -> Plot:
    """Plot a pair in 3-D, with a slider over the network's iterations."""
    scenes = stages(snapshot)
    last = len(scenes) - 1
    traces: list[tuple[Plot, range]] = []  # each with the stages that show it
    for index, stage in enumerate(scenes):
        target, *others = _stage_traces(stage)
        if index < 2:  # it is set aside before, and then stays where it is
            traces.append((target, range(1, last + 1) if index else range(1)))
        traces += [(trace, range(index, index + 1)) for trace in others]
    data = [trace | {"visible": last in shown} for trace, shown in traces]
    steps = [
        {
            "label": stage.label,
            "method": "restyle",
            "args": [{"visible": [index in shown for _, shown in traces]}],
        }
        for index, stage in enumerate(scenes)
    ]
    hidden = {"visible": False}
    layout = {
        "scene": {"aspectmode": "data", "xaxis": hidden, "yaxis": hidden, "zaxis": hidden},
        "sliders": [{"active": len(scenes) - 1, "steps": steps}],
        "margin": {"l": 40, "r": 40, "t": 0, "b": 30},  # room for the slider's labels
        "legend": {"orientation": "h", "y": 1},  # above: the slider is below
    }
    return {"data": data, "layout": layout}


def _stage_traces(stage: Stage) -> list[Plot]:
    """Plot one stage: clouds, right and wrong matches, outliers."""
    outlier, correct = stage.called_outlier, stage.correct
    return [
        point_trace(thin(stage.target, _MAX_POINTS), "target", BLUE),
        point_trace(thin(stage.source, _MAX_POINTS), "source", "#000"),
        _match_trace(stage, correct & ~outlier, "right matches", GREEN),
        _match_trace(stage, ~correct & ~outlier, "wrong matches", RED),
        point_trace(stage.source[outlier], "called outlier", "#ff7f0e", "circle-open", 6),
    ]


def point_trace(
    points: np.ndarray, name: str, colour: str, symbol: str = "circle", size: int = 2
) -> Plot:
    """Build a 3-D scatter trace of points (N, 3)."""
    x, y, z = points.round(3).T.tolist() if len(points) else ([], [], [])
    marker = {"size": size, "color": colour, "symbol": symbol}
    common: Plot = {"type": "scatter3d", "mode": "markers", "hoverinfo": "skip"}
    return common | {"x": x, "y": y, "z": z, "name": name, "marker": marker}


def _match_trace(stage: Stage, which: np.ndarray, name: str, colour: str) -> Plot:
    """Build a 3-D trace of some of the matches, as lines with gaps."""
    chosen = np.flatnonzero(which)[:: max(1, len(which) // _MAX_LINES)]
    ends: list[list[float | None]] = [[], [], []]
    for i in chosen:
        for axis in range(3):
            start, end = stage.source[i, axis], stage.target[stage.matched[i], axis]
            ends[axis] += [round(float(start), 3), round(float(end), 3), None]
    common = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "line": {"color": colour}}
    return common | {"x": ends[0], "y": ends[1], "z": ends[2], "name": name}


def robustness_plot(curves: Mapping[str, dict]) -> Plot:
    """Plot figure 2 from a curve.json: wrong matches against a wrong rotation vector."""
    data = []
    for index, (label, curve) in enumerate(curves["curves"].items()):
        colour = RED if label == "rotation vector" else f"hsl(210, 60%, {70 - 12 * index}%)"
        trace = {"x": curves["percent"], "y": curve["mean"], "name": label}
        data.append(trace | {"line": {"color": colour}})
    for label, points in curves["paper"].items():
        marker = {"symbol": "x", "color": RED if label == "rotation vector" else BLUE}
        trace = {"x": [float(p) for p in points], "y": list(points.values()), "mode": "markers"}
        data.append(trace | {"name": f"paper's chart, {label}", "marker": marker})
    layout = {
        "xaxis": {"title": {"text": "per cent corrupted"}},
        "yaxis": {"title": {"text": "rotation error, mean, deg"}},
        "margin": {"t": 20, "r": 10},
    }
    return {"data": data, "layout": layout}
