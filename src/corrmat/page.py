"""All records on one page that needs no server and no network."""

import ast
import csv
import itertools
import json
import string
import subprocess
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from plotly.offline import get_plotlyjs

from corrmat import report
from corrmat.figures import BLUE, COLOURS, GREEN, RED, grid, panels

# What a family's numbers depend on, below src/corrmat; the recipes come on top.
CODE = (
    "ops/rigid.py", "ops/correspondence.py", "ops/streaming.py",
    "ops/neighbors.py", "data/pairs.py", "data/datamodule.py", "data/clouds.py",
    "data/normals.py", "data/modelnet40.py", "data/shapes.py", "data/families.py",
    "data/solids.py", "losses.py", "methods.py", "module.py", "metrics.py", "baselines.py",
)  # fmt: skip
FAMILY_CODE = {
    "DCP": (
        "networks/dcp.py",
        "networks/dgcnn.py",
        "networks/edges.py",
        "networks/attention.py",
        "networks/compare.py",
    ),
    "RPMNet": (
        "networks/rpmnet.py",
        "ops/sinkhorn.py",
        "networks/edges.py",
        "networks/ppf.py",
        "networks/pointnet.py",
    ),
    "PCRNet": ("networks/pcrnet.py", "networks/pointnet.py", "networks/compare.py"),
}
QUANTILES = np.linspace(0, 1, 101)
Plots = dict[str, dict[str, Any]]


def build(results: Path) -> str:
    """The page of every record below a folder.

    Args:
        results: folder of records, as `report.read_records` reads it.

    Returns:
        HTML with everything in it.
    """
    records = report.read_records(results)
    plots: Plots = {}
    sections = [_summary(records)]
    for identity, group in itertools.groupby(
        sorted(records, key=lambda r: r["id"]), key=lambda r: r["id"]
    ):
        same = list(group)
        articles = [_article(record, results, plots) for record in same]
        title = escape(f"{identity} {report.family(same[0])}: {same[0]['title']}")
        sections.append(
            f'<section id="exp-{identity}"><h2>{title}</h2>{"".join(articles)}</section>'
        )
    sections.append(_robustness(results, plots))
    names = [record["id"] for record in records]
    nav = "".join(f'<a href="#exp-{i}">{i}</a>' for i in sorted(set(names)))
    template = string.Template(files("corrmat").joinpath("page.html").read_text())
    return template.safe_substitute(
        intro=(
            "Every number comes from a file in <code>results/</code>: hover over it for the file, "
            "follow it to the record it belongs to, where the command stands that makes it again. "
            "METHOD is red, METHOD_corr blue, further arms green and purple, baselines dashed "
            "grey; dotted lines are the paper's values."
        ),
        nav=f'<a href="#summary">summary</a>{nav}<a href="#robustness">figure 2</a>',
        body="\n".join(sections),
        plots=json.dumps(plots, separators=(",", ":")).replace("</", "<\\/"),
        plotly=get_plotlyjs(),
    )


def command(record: Mapping[str, Any]) -> str:
    """What makes a record again; a recipe of one's own has no make target."""
    if not record["paper"]:
        return f"corrmat run --config ... --scale {record['scale']}"
    target = record["id"] if record["id"] == "outliers" else f"exp{record['id']}"
    scale = "" if record["scale"] == "laptop" else f" SCALE={record['scale']}"
    data = "" if record["data"] == "shapes" else f" DATA={record['data']} ROOT=..."
    seed = "" if record["seed"] == 0 else f' ARGS="--seed {record["seed"]}"'
    return f"make {target}{scale}{data}{seed}"


def staleness(record: Mapping[str, Any], repository: Path) -> str:
    """What has changed since an arm of a record was trained; empty if nothing has.

    Args:
        record: with the commits that its arms were trained at.
        repository: a checkout that knows them.
    """
    family = report.family(record)
    code = [f"src/corrmat/{name}" for name in (*CODE, *FAMILY_CODE.get(family, ()))]
    code += [f"configs/exp/{record['id']}.yaml", f"configs/{family.lower()}.yaml"]
    arms = record["arms"].values()
    commits = {str(arm.get("trained_at") or record.get("commit")) for arm in arms}
    if any(commit == "None" or commit.endswith("+") for commit in commits):
        return "trained with uncommitted code"

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *words], cwd=repository, capture_output=True, text=True)

    changed: set[str] = set()
    for commit in commits:
        try:
            found = git("diff", "--name-only", "--relative", commit, "--", *code)
        except OSError:
            return "git is not at hand, so nobody can tell whether the code has changed"
        if found.returncode:
            return (
                f"commit {commit} is not at hand, so nobody can tell whether the code has changed"
            )
        for name in found.stdout.split():
            then, now = git("show", f"{commit}:./{name}"), repository / name
            same = not then.returncode and now.exists()
            if not (same and _says(name, then.stdout) == _says(name, now.read_text())):
                changed.add(now.name)
    return f"changed since: {', '.join(sorted(changed))}" if changed else ""


def _says(name: str, text: str) -> object:
    """What a recipe or a module says to the machine: comments and docstrings left out."""
    if name.endswith(".yaml"):
        return yaml.safe_load(text)
    tree = ast.parse(text)
    for node in ast.walk(tree):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        if documented and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)


def _summary(records: Sequence[Mapping[str, Any]]) -> str:
    heads = ["experiment", "scale", "data", "metric", "METHOD", "METHOD_corr", "ratio"]
    heads += ["paper METHOD", "paper METHOD_corr", "paper ratio"]
    rows = []
    for record in sorted(records, key=lambda r: (r["id"], r["scale"], r["data"])):
        for metric in ("match_accuracy", report.papers_own(record)):
            ours = [report.overall(a, metric) for a in list(record["arms"].values())[:2]]
            first = list(record["arms"])[:2]
            paper = [report.overall(record["paper"].get(a, {}), metric) for a in first]
            cells = [_linked(report.cell(v, metric), record, metric) for v in ours]
            cells.append(report.ratio(ours))
            cells += [report.cell(v, metric) for v in paper] + [report.ratio(paper)]
            start = [record["id"], record["scale"], record["data"], report.METRICS[metric][0]]
            rows.append([*map(escape, start), *cells])
    return f'<section id="summary"><h2>Summary</h2>{_table(heads, rows)}</section>'


def _article(record: Mapping[str, Any], results: Path, plots: Plots) -> str:
    name = _name(record)
    folder = results / record["scale"] / record["data"] / record["id"]
    heads, rows = report.table(record)
    source = f"results/{record['scale']}/{record['data']}/{record['id']}/metrics.json"
    title = escape(f"{source}; {command(record)}", quote=True)
    cells = [
        [escape(row[0]), *(f'<span title="{title}">{escape(cell)}</span>' for cell in row[1:])]
        for row in rows
    ]
    plots[f"{name}-curves"] = _curves(record)
    plots[f"{name}-errors"] = _errors(folder / "per_pair.csv", list(record["arms"]))
    parts = [
        f'<article id="{name}"><h3>{escape(record["scale"])}, {escape(record["data"])}</h3>',
        _provenance(record, source),
        _plot(f"{name}-curves", "Curves"),
        _plot(f"{name}-errors", "Share of test pairs below each rotation error"),
        f"<details><summary>All numbers</summary>{_table(heads, cells)}</details>",
        _views(folder / "views.json", name, plots),
        "</article>",
    ]
    return "".join(parts)


def _provenance(record: Mapping[str, Any], source: str) -> str:
    repository = Path(__file__).resolve().parents[2]
    stale = staleness(record, repository)
    mark = f' <span class="stale">{escape(stale)}</span>' if stale else ""
    effort = "; ".join(
        f"{arm}: {found['pairs_seen']:,} pairs in {found['train_seconds'] / 60:.1f} min, "
        f"trained at {found.get('trained_at')}"
        for arm, found in record["arms"].items()
    )
    machine = record.get("hardware", {})
    where = f"{machine.get('threads', '?')} CPU threads" + (", a GPU" if machine.get("gpu") else "")
    where += f", {machine['precision']}" if "precision" in machine else ""
    where += "".join(f", {name} {version}" for name, version in record.get("versions", {}).items())
    facts = (
        f"commit {record.get('commit')}, seed {record['seed']}, {where}. {effort}. File: {source}"
    )
    return f'<p class="from"><code>{escape(command(record))}</code>. {escape(facts)}{mark}</p>'


def _curves(record: Mapping[str, Any]) -> dict[str, Any]:
    shown = panels(record)
    rows, columns = grid(len(shown))
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        "grid": {"rows": rows, "columns": columns, "pattern": "independent"},
        "margin": {"t": 40, "r": 10},
        "legend": {"orientation": "h", "y": -0.25 / rows},
        "height": 330 * rows,
    }
    for i, panel in enumerate(shown):
        suffix = "" if i == 0 else str(i + 1)
        for curve in panel.curves:
            new = all(known.get("name") != curve.arm for known in data)
            own: dict[str, Any] = {"name": curve.arm, "showlegend": new}
            dotted = {"name": f"paper, {curve.arm}", "mode": "lines", "showlegend": False}
            line = {"color": curve.colour} | ({"dash": "dot"} if curve.paper else {})
            place = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": curve.arm}
            values = {"x": curve.x, "y": curve.y, "line": line}
            data.append(place | values | (dotted if curve.paper else own))
        kinds = ("log" if log else "linear" for log in (panel.log_x, panel.log_y))
        for axis, kind, text in zip("xy", kinds, (panel.across, panel.title), strict=True):
            title = {"text": text, "standoff": 4}
            layout[f"{axis}axis{suffix}"] = {"type": kind, "title": title}
    return {"data": data, "layout": layout}


def _errors(path: Path, arms: Sequence[str]) -> dict[str, Any]:
    """Empirical distribution of rotation errors, a line an arm or baseline."""
    errors: dict[str, list[float]] = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            errors.setdefault(row["arm"], []).append(float(row["rotation_error_deg"]))
    colours = dict(zip(arms, COLOURS, strict=False))
    data = []
    for arm, values in errors.items():
        found = np.quantile(np.nan_to_num(values, nan=180.0), QUANTILES, method="inverted_cdf")
        style = {"color": colours.get(arm, "#888"), "dash": "solid" if arm in colours else "dash"}
        shown = [float(f"{max(value, 1e-4):.4g}") for value in found]
        share = (100 * QUANTILES).round(1).tolist()
        data.append({"x": shown, "y": share, "name": arm, "line": style})
    layout = {
        "xaxis": {"type": "log", "title": {"text": "rotation error, deg"}},
        "yaxis": {"title": {"text": "% of test pairs below"}},
        "margin": {"t": 20, "r": 10},
    }
    return {"data": data, "layout": layout}


def _views(path: Path, name: str, plots: Plots) -> str:
    """Folds with the easiest, median and hardest pair; nothing for a record without them."""
    if not path.is_file():
        return ""
    places = []
    for view in json.loads(path.read_text()):
        key = f"{name}-{view['rank']}"
        plots[key] = _view(view)
        label = f"{view['rank']} pair, {view['rotation_error_deg']:.3g} deg"
        places.append(
            f'<details class="views"><summary>{escape(label)}: {escape(view["arm"])} in 3-D'
            f"</summary>{_plot(key, label, 'plot view')}</details>"
        )
    return "".join(places)


def _view(view: Mapping[str, Any]) -> dict[str, Any]:
    """A pair that turns with the mouse, and a slider over the network's iterations."""
    x, y, match = (np.asarray(view[key]) for key in ("source", "target", "match"))
    aside = np.array([0.6 * (np.ptp(x, 0).max() + np.ptp(y, 0).max()), 0, 0])
    last = np.asarray(view["steps"][-1]["matched"])
    stages = [("before", x, y + aside, last)]
    for number, step in enumerate(view["steps"], 1):
        moved = x @ np.asarray(step["rotation"]).T + step["translation"]
        stages.append((f"iteration {number}", moved, y, np.asarray(step["matched"])))
    data: list[dict[str, Any]] = []
    for index, (_, source, target, matched) in enumerate(stages):
        outlier, right = matched == len(y), matched == match
        traces = [
            _dots(_thinned(target), "target", BLUE),
            _dots(_thinned(source), "source", "#000"),
            _lines(source, target, matched, right & ~outlier, "right matches", GREEN),
            _lines(source, target, matched, ~right & ~outlier, "wrong matches", RED),
            _dots(source[outlier], "called outlier", "#ff7f0e", "circle-open", 6),
        ]
        data += [trace | {"visible": index == len(stages) - 1} for trace in traces]
    steps = [
        {
            "label": label,
            "method": "restyle",
            "args": [{"visible": [i // 5 == index for i in range(len(data))]}],
        }
        for index, (label, *_) in enumerate(stages)
    ]
    hidden = {"visible": False}
    layout = {
        "scene": {"aspectmode": "data", "xaxis": hidden, "yaxis": hidden, "zaxis": hidden},
        "sliders": [{"active": len(stages) - 1, "steps": steps}],
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"orientation": "h"},
    }
    return {"data": data, "layout": layout}


def _thinned(points: np.ndarray, most: int = 120) -> np.ndarray:
    """Every so many points, so that the page stays small."""
    return points[:: -(-len(points) // most)]


def _dots(
    points: np.ndarray, name: str, colour: str, symbol: str = "circle", size: int = 2
) -> dict[str, Any]:
    x, y, z = points.round(3).T.tolist() if len(points) else ([], [], [])
    marker = {"size": size, "color": colour, "symbol": symbol}
    common = {"type": "scatter3d", "mode": "markers", "hoverinfo": "skip"}
    return common | {"x": x, "y": y, "z": z, "name": name, "marker": marker}


def _lines(
    source: np.ndarray,
    target: np.ndarray,
    matched: np.ndarray,
    which: np.ndarray,
    name: str,
    colour: str,
) -> dict[str, Any]:
    chosen = np.flatnonzero(which)[:: max(1, len(which) // 70)]
    ends: list[list[float | None]] = [[], [], []]
    for i in chosen:
        for axis in range(3):
            a, b = source[i, axis], target[matched[i], axis]
            ends[axis] += [round(float(a), 3), round(float(b), 3), None]
    common = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "line": {"color": colour}}
    return common | {"x": ends[0], "y": ends[1], "z": ends[2], "name": name}


def _robustness(results: Path, plots: Plots) -> str:
    found = sorted(results.glob("*/robustness/curve.json"))
    parts = []
    for path in found:
        record = json.loads(path.read_text())
        name = f"robustness-{path.parts[-3]}"
        data = []
        for index, (label, curve) in enumerate(record["curves"].items()):
            line = {
                "color": RED if label == "rotation vector" else f"hsl(210, 60%, {70 - 12 * index}%)"
            }
            data.append({"x": record["percent"], "y": curve["mean"], "name": label, "line": line})
        for label, points in record["paper"].items():
            marks = {"symbol": "x", "color": RED if label == "rotation vector" else BLUE}
            at = {"x": [float(p) for p in points], "y": list(points.values())}
            data.append(
                at | {"mode": "markers", "name": f"paper's chart, {label}", "marker": marks}
            )
        axes = {"xaxis": {"title": {"text": "per cent corrupted"}}, "margin": {"t": 20, "r": 10}}
        layout = axes | {"yaxis": {"title": {"text": "rotation error, mean, deg"}}}
        plots[name] = {"data": data, "layout": layout}
        source = f"results/{path.parts[-3]}/robustness/curve.json"
        made_by = f"make robustness SCALE={path.parts[-3]}"
        facts = f"{record['draws']} draws a point, seed {record['seed']}. File: {source}"
        parts.append(f'<p class="from"><code>{made_by}</code>. {escape(facts)}</p>')
        parts.append(_plot(name, "Rotation error against per cent corrupted"))
    title = "Figure 2: wrong matches against a wrong rotation vector"
    return f'<section id="robustness"><h2>{title}</h2>{"".join(parts)}</section>'


def _name(record: Mapping[str, Any]) -> str:
    return f"{record['scale']}-{record['data']}-{record['id']}"


def _linked(text: str, record: Mapping[str, Any], metric: str) -> str:
    place = f"results/{record['scale']}/{record['data']}/{record['id']}/metrics.json"
    title = escape(f"{metric} in {place}; {command(record)}", quote=True)
    return f'<a href="#{_name(record)}" title="{title}">{escape(text)}</a>' if text else ""


def _plot(name: str, label: str, kind: str = "plot") -> str:
    return f'<div class="{kind}" data-plot="{name}" role="img" aria-label="{escape(label)}"></div>'


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th scope=col>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return (
        f'<div class="wide" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
