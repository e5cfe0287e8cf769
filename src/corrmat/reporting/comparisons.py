"""Tables of `corrmat compare`'s records: the shipped weights beside the classical pipelines."""

import json
from collections import Counter
from pathlib import Path
from typing import Any, TypedDict, get_args

import numpy as np
from scipy import stats

from corrmat.calibration import Verdict
from corrmat.reporting.model_results import Comparison, ModelResult, read_comparison
from corrmat.reporting.tables import markdown_head, markdown_row
from corrmat.weights import shipped_metadata

OURS = "corrmat"
# Below results/: what slides or turns, and what does not; scans that were not simulated; and scenes
# that the tool was not made for.
FREE_MOTIONS = Path("register", "free_motions.json")
REAL_SCANS = Path("register", "real_scans.json")
OTHER_SCENES = Path("register", "other_scenes.json")
PROTOCOLS = ("real", "views", "clean", "dense", "rooms")  # in the order of the tables


class FreeMotionsRow(TypedDict):
    """A row of results/register/free_motions.json."""

    clouds: str
    registrations: int
    slides: int  # registrations whose source is said to slide
    turns: int  # registrations after which any turn about an axis is said to fit as well
    right: int | None  # with the right direction or axis; None where nothing slides or turns
    aligned: int  # registrations that are called "aligned"


class OtherScenesRow(TypedDict):
    """A row of results/register/other_scenes.json."""

    scenes: str
    registrations: int
    right: int
    median_deg: float
    verdicts: list[int]  # aligned, probably aligned, doubtful


class RealScansRow(TypedDict):
    """A row of results/register/real_scans.json: two scans, from several poses of the source."""

    scans: str
    points: list[int]  # of source and target
    registrations: int
    right: dict[str, int] | None  # by model; None where the scans show nothing in common
    median_deg: float | None  # ours
    verdicts: list[int]  # on ours: aligned, probably aligned, doubtful
    seconds: float  # ours


def comparison_summary(results: Path) -> str:
    """Build README's table: recall at 5 degrees of every model, ours with its interval."""
    records = read_comparisons(results)
    if not records:
        return "No comparison is recorded; `make protocols` makes them."
    models = list(records[0].models)
    lines = markdown_head(["pairs", "data", "points", *models])
    for record in records:
        cells = []
        for model in models:
            if model not in record.models:
                cells.append("")
                continue
            hits = record.models[model].within_angle
            interval = f" ({_wilson(hits)})" if model == OURS else ""
            cells.append(f"{hits.mean():.0%}{interval}")
        about = [record.protocol, record.data, str(record.points)]
        lines.append(markdown_row([*about, *cells]))
    return "\n".join(lines)


def comparison_table(results: Path) -> str:
    """Build the table of docs/register.md: a row a set of pairs and model, with intervals.

    The intervals are Wilson's, at 95 %. The p value is the exact McNemar test's: that the model
    is within 5 degrees as often as ours, on the same pairs.
    """
    heads = ["pairs", "data", "points", "model", "within 5 deg", "ADD-S", "p", "median deg", "ms"]
    lines = markdown_head(heads)
    for record in read_comparisons(results):
        ours = record.models[OURS].within_angle
        for model, result in record.models.items():
            start = [record.protocol, record.data, str(record.points), model]
            recalls = _recall_cells(result, None if model == OURS else ours)
            more = f"{result.median_deg:.2g}", f"{result.ms:.0f}"
            lines.append(markdown_row([*start, *recalls, *more]))
    return "\n".join(lines)


def networks_table(results: Path) -> str:
    """Build the table of other networks of this project in the shipped one's place.

    The p value is the exact McNemar test's against the shipped network, on the same pairs.
    """
    path = results / "register" / "networks.json"
    if not path.is_file():
        return "No comparison is recorded."
    heads = ["network", "its record", "within 5 deg", "ADD-S", "p"]
    lines = markdown_head(heads)
    models = read_comparison(path).models
    ours = models[OURS].within_angle
    for name, result in models.items():
        record = "" if name == OURS else shipped_metadata(name)["record"]
        recalls = _recall_cells(result, None if name == OURS else ours)
        lines.append(markdown_row([Path(name).name, record, *recalls]))
    return "\n".join(lines)


def families_table(results: Path) -> str:
    """Build the table of two networks, each trained without some families.

    The same pairs are tested with the network that has not seen their families and with the one
    that has; p is the exact McNemar test's between the two.
    """
    path = results / "register" / "held_out_families.json"
    if not path.is_file():
        return "No test is recorded."
    tested = read_comparison(path).models

    def hits(*names: str) -> np.ndarray:
        return np.concatenate([tested[name].within_angle for name in names])

    unseen = hits("without first, first", "without second, second")
    trained = hits("without second, first", "without first, second")
    shipped = hits("shipped, first", "shipped, second")
    rows = {
        "families that the small network has not seen": unseen,
        "the same, small network that has seen them": trained,
        "the same, shipped network": shipped,
    }
    if "shipped, modelnet40" in tested:
        other = hits("without first, modelnet40", "without second, modelnet40")
        rows["modelnet40, both small networks"] = other
        rows["modelnet40, shipped network"] = hits("shipped, modelnet40")
    lines = markdown_head(["pairs", "count", "within 5 deg"])
    for what, within in rows.items():
        recall = f"{within.mean():.1%} ({_wilson(within)})"
        lines.append(markdown_row([what, str(len(within)), recall]))
    p = f"p = {_mcnemar(trained, unseen):.2g} (exact McNemar test)"
    return "\n".join([*lines, "", f"The first two rows differ with {p}."])


def choice_table(results: Path) -> str:
    """Build the table of weights that were tried for the choice among candidates."""
    path = results / "register" / "choice.json"
    if not path.is_file():
        return "No choice is recorded."
    record = json.loads(path.read_text())
    protocols = [name for name in PROTOCOLS if name in record]
    heads = ["weights of coherence, unmatched loss, support, verification", *protocols]
    lines = markdown_head(heads)
    for weights in record[protocols[0]]["weights"]:
        tried = [record[name]["weights"][weights] for name in protocols]
        shares = [f"{row['recall_5deg']:.1%}, {row['recall_adds']:.1%}" for row in tried]
        lines.append(markdown_row([weights, *shares]))
    for anchors in record[protocols[0]]["right_matches"]:
        right = [f"{record[name]['right_matches'][anchors]:.1%}" for name in protocols]
        lines.append(markdown_row([f"right matches, {anchors} anchors", *right]))
    counts = ", ".join(f"{record[name]['pairs']} {name}" for name in protocols)
    means = ", ".join(
        f"{by['candidates']:.0f}, {by['distinct']:.1f} of them different ({name})"
        for name, by in ((name, record[name]) for name in protocols)
    )
    return "\n".join([*lines, "", f"{counts} pairs. Candidates a pair, in the mean: {means}."])


def large_choice_table(results: Path) -> str:
    """Build the table of what the choice among the candidates of large clouds is worth."""
    paths = sorted((results / "register").glob("*-procedural-*.json"))
    records = [record for record in map(_read_json, paths) if "choice" in record]
    if not records:
        return "No choice is recorded."
    lines = markdown_head(["candidates and weights", *(record["protocol"] for record in records)])
    for choice in records[0]["choice"]:
        rows = [record["choice"][choice] for record in records]
        shares = [f"{row['recall_5deg']:.0%}, {row['recall_adds']:.0%}" for row in rows]
        lines.append(markdown_row([choice, *shares]))
    return "\n".join(lines)


def _read_json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def free_motions_table(results: Path) -> str:
    """Build the table of what is said to slide or turn: what does, and held-out pairs."""
    path = results / FREE_MOTIONS
    if not path.is_file():
        return "Sliding and turning is not recorded; `benchmarks/free_motions.py` measures it."
    heads = {
        "clouds": "clouds", "registrations": "registrations", "slides": "said to slide",
        "turns": "said to turn", "right": "in the right direction", "aligned": "aligned",
    }  # fmt: skip
    lines = markdown_head(list(heads.values()))
    for row in json.loads(path.read_text())["rows"]:
        cells = ["" if row[name] is None else str(row[name]) for name in heads]
        lines.append(markdown_row(cells))
    return "\n".join(lines)


def other_scenes_table(results: Path) -> str:
    """Build the table of scenes that the tool was not made for."""
    path = results / OTHER_SCENES
    if not path.is_file():
        return "Other scenes are not recorded; `benchmarks/other_scenes.py` registers some."
    lines = markdown_head(["scenes", "right", "median deg", ", ".join(get_args(Verdict))])
    rows: list[OtherScenesRow] = json.loads(path.read_text())["rows"]
    for row in rows:
        right = f"{row['right']} of {row['registrations']}"
        verdicts = ", ".join(map(str, row["verdicts"]))
        lines.append(markdown_row([row["scenes"], right, f"{row['median_deg']:.2g}", verdicts]))
    return "\n".join(lines)


def real_scans_table(results: Path) -> str:
    """Build the table of real scans: ours with its verdicts, and how often others are right.

    The last row is the sum over the pairs that have something in common.
    """
    path = results / REAL_SCANS
    if not path.is_file():
        return "No real scans are recorded; `benchmarks/real_scans.py` registers some."
    rows: list[RealScansRow] = json.loads(path.read_text())["rows"]
    models = list(rows[0]["right"] or {})
    words = ", ".join(get_args(Verdict))
    ours = "corrmat's median deg", f"corrmat: {words}", "corrmat's s"
    lines = markdown_head(["scans", "points", *models, *ours])
    totals, registrations = Counter[str](), 0
    for row in rows:
        right = row["right"] or {}
        if right:
            totals.update(right)
            registrations += row["registrations"]
        points = " and ".join(f"{count:,}" for count in row["points"])
        counts = [f"{right[m]} of {row['registrations']}" if right else "" for m in models]
        median = "" if row["median_deg"] is None else f"{row['median_deg']:.2g}"
        verdicts = ", ".join(map(str, row["verdicts"]))
        cells = [row["scans"], points, *counts, median, verdicts, f"{row['seconds']:.1f}"]
        lines.append(markdown_row(cells))
    sums = [f"{totals[m]} of {registrations}" for m in models]
    lines.append(markdown_row(["all that can be right", "", *sums, "", "", ""]))
    return "\n".join(lines)


def read_comparisons(results: Path) -> list[Comparison]:
    """Read the comparisons of all protocols, in the order of the tables."""
    records = map(read_comparison, (results / "register").glob("*-*-*.json"))
    kept = [record for record in records if record.protocol in PROTOCOLS]
    return sorted(kept, key=lambda r: (PROTOCOLS.index(r.protocol), r.data, r.points))


def _recall_cells(result: ModelResult, ours: np.ndarray | None) -> list[str]:
    """Format both recalls of a model with intervals, and its p value against our hits, if given."""
    hits = result.within_angle
    recalls = [f"{r.mean():.0%} ({_wilson(r)})" for r in (hits, result.aligned)]
    return [*recalls, "" if ours is None else f"{_mcnemar(ours, hits):.2g}"]


def _wilson(hits: np.ndarray) -> str:
    """Format Wilson's 95 % interval of a share, in per cent."""
    interval = stats.binomtest(int(hits.sum()), len(hits)).proportion_ci(0.95, "wilson")
    return f"{100 * interval.low:.0f} to {100 * interval.high:.0f}"


def _mcnemar(one: np.ndarray, other: np.ndarray) -> float:
    """Return the p value that two models are right equally often on the same pairs."""
    only_one, only_other = int((one & ~other).sum()), int((other & ~one).sum())
    if not only_one + only_other:
        return 1.0
    return float(stats.binomtest(only_one, only_one + only_other).pvalue)
