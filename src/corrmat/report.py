"""Records become tables. Numbers come from results/ and from nowhere else."""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from corrmat.errors import CorrmatError
from corrmat.files import replace_text

# metric -> (heading, format, factor); the sound ones first, then the paper's.
METRICS: dict[str, tuple[str, str, float]] = {
    "match_accuracy": ("correct matches, %", ".1f", 100),
    "rotation_error_deg_mean": ("rotation error, mean, deg", ".3g", 1),
    "rotation_error_deg_median": ("rotation error, median, deg", ".3g", 1),
    "translation_rmse": ("translation RMSE", ".2g", 1),
    "outlier_precision": ("outlier class, precision, %", ".1f", 100),
    "outlier_recall": ("outlier class, recall, %", ".1f", 100),
    "recall@5deg_0.05": ("pairs under 5 deg and 0.05, %", ".1f", 100),
    "chamfer": ("Chamfer distance (squared)", ".2g", 1),
    "failed": ("pairs without an answer", ".0f", 1),
    "relative_euler_rmse_deg": ("rotation RMSE (Euler), deg", ".3g", 1),
    "relative_euler_mae_deg": ("rotation MAE (Euler), deg", ".3g", 1),
    "naive_euler_rmse_deg": ("rotation RMSE (naive Euler), deg", ".3g", 1),
    "transposed_match_accuracy": ("matches as released (transposed), %", ".1f", 100),
}
PART_METRICS = {
    "bands": ("relative_euler_mae_deg", "match_accuracy", "chamfer"),
    "sweep": (
        "match_accuracy", "rotation_error_deg_median", "relative_euler_rmse_deg",
        "outlier_precision", "outlier_recall",
    ),
}  # fmt: skip
# Which of them the paper calls its rotation error, by the arms' family.
PAPERS_OWN = {
    "DCP": "relative_euler_rmse_deg",
    "RPMNet": "rotation_error_deg_mean",
    "PCRNet": "naive_euler_rmse_deg",
}


def family(record: Mapping[str, Any]) -> str:
    """What a record's arms are variants of: DCP, RPMNet, PCRNet, or a network of one's own."""
    return next(iter(record["arms"])).split("_")[0]


def papers_own(record: Mapping[str, Any]) -> str:
    """What the paper calls a record's rotation error; the sound one for a network of one's own."""
    if record.get("bands_deg"):
        return "relative_euler_mae_deg"  # of both tables
    return PAPERS_OWN.get(family(record), "rotation_error_deg_mean")


def table(record: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Ours beside the paper's: headings and rows of text, one row a metric (and a band)."""
    arms, baselines, paper = record["arms"], record.get("baselines", {}), record["paper"]
    heads = ["", *arms, "ratio", *baselines, *(f"paper {arm}" for arm in paper), "paper ratio"]

    def texts(name: str, part: str = "", index: int = 0) -> list[str] | None:
        ours, others, theirs = (
            [value_of(_part(found, part, index), name) for found in group.values()]
            for group in (arms, baselines, paper)
        )
        if all(value is None for value in ours):
            return None
        text = [[cell(v, name) for v in group] for group in (ours, others, theirs)]
        return [*text[0], ratio(ours), *text[1], *text[2], ratio(theirs)]

    rows = [[METRICS[name][0], *found] for name in METRICS if (found := texts(name))]
    for part, names in PART_METRICS.items():
        for index, label in enumerate(_labels(record, part)):
            for name in names:
                if found := texts(name, part, index):
                    rows.append([f"{label}: {METRICS[name][0]}", *found])
    return heads, rows


def terminal_table(record: Mapping[str, Any]) -> str:
    """`table` for a terminal, with a line on what was trained and for how long."""
    heads, rows = table(record)
    widths = [max(len(row[i]) for row in [heads, *rows]) for i in range(len(heads))]

    def line(cells: Sequence[str]) -> str:
        first, *rest = cells
        return "  ".join(
            [first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(rest, widths[1:], strict=True))]
        )

    effort = "; ".join(
        f"{arm}: {found['pairs_seen']:,} pairs in {found['train_seconds'] / 60:.1f} min"
        for arm, found in record["arms"].items()
    )
    where = f"({record['scale']}, {record['data']}, {int(_pairs(record))} test pairs)"
    title = f"\n{record['id']}  {record['title']}  {where}"
    return "\n".join([title, effort, "", line(heads), "-" * len(line(heads)), *map(line, rows), ""])


def markdown_summary(records: Sequence[Mapping[str, Any]]) -> str:
    """The README's table: "METHOD → METHOD_corr", a row a record, the paper's below each id."""
    heads = [
        "experiment",
        "data",
        "correct matches, %",
        "rotation error, mean, deg",
        "rotation error, median, deg",
        "the paper's rotation error, deg",
        "minutes",
    ]
    lines = [_row(heads), "|" + "---|" * len(heads)]
    for identity, group in itertools.groupby(records, key=lambda record: record["id"]):
        same = list(group)
        for record in same:
            arms = list(record["arms"].values())[:2]
            minutes = [f"{found['train_seconds'] / 60:.1f}" for found in arms]
            start = [f"{identity} {family(record)}, {record['scale']}", record["data"]]
            lines.append(_row([*start, *_pairwise(record, arms), " → ".join(minutes)]))
        cells = _pairwise(same[0], list(same[0]["paper"].values()))
        if any(cells):
            lines.append(_row([f"{identity} {family(same[0])}, paper", "ModelNet40", *cells, ""]))
    return "\n".join(lines)


def _pairwise(record: Mapping[str, Any], arms: Sequence[Mapping[str, Any]]) -> list[str]:
    """Cells "METHOD → METHOD_corr"; empty where neither has a number."""
    names = ["match_accuracy", "rotation_error_deg_mean", "rotation_error_deg_median"]
    cells = []
    for name in [*names, papers_own(record)]:
        values = [overall(found, name) for found in arms]
        shown = [cell(value, name) or "-" for value in values]
        cells.append(" → ".join(shown) if set(shown) != {"-"} else "")
    return cells


def markdown_tables(records: Sequence[Mapping[str, Any]]) -> str:
    """`table` of every record as Markdown, each under a heading."""
    parts = []
    for record in records:
        heads, rows = table(record)
        parts.append(
            f"### {record['id']}, {record['title']}: {record['scale']}, {record['data']}\n"
        )
        parts += [_row(heads), "|" + "---|" * len(heads), *map(_row, rows), ""]
    return "\n".join(parts).rstrip()


def markdown_register(results: Path) -> str:
    """The README's table of `corrmat register`: a row a set of pairs, a column a model."""
    records = [json.loads(path.read_text()) for path in sorted(results.glob("register/*-*.json"))]
    if not records:
        return "No comparison is recorded; `make protocols` makes them."
    models = list(records[0]["models"])
    heads = ["pairs", "data", "points", *models]
    lines = [_row(heads), "|" + "---|" * len(heads)]
    for record in sorted(records, key=lambda r: (r["protocol"] != "real", r["data"], r["points"])):
        found = [record["models"].get(model) for model in models]
        cells = [
            "" if f is None
            else f"{f['recall_5deg']:.0%} / {f['recall_adds']:.0%}, {f['ms']:.0f} ms"
            for f in found
        ]  # fmt: skip
        lines.append(_row([record["protocol"], record["data"], str(record["points"]), *cells]))
    return "\n".join(lines)


def markdown_networks(results: Path) -> str:
    """The table of docs/register.md: other networks of this project in the shipped one's place."""
    path = results / "register" / "networks.json"
    if not path.is_file():
        return "No comparison is recorded."
    lines = [_row(["network", "recall at 5 deg", "recall ADD-S"]), "|---|---|---|"]
    for name, found in json.loads(path.read_text())["models"].items():
        parts = Path(name).parts
        shown = f"{parts[-2]}, experiment {parts[-3]}" if len(parts) > 2 else f"{name} (shipped)"
        lines.append(_row([shown, f"{found['recall_5deg']:.0%}", f"{found['recall_adds']:.0%}"]))
    return "\n".join(lines)


def markdown_confidence(results: Path) -> str:
    """The table of docs/register.md: what the confidence promised, and how often it was so."""
    from corrmat import comparison, registration

    lines = [_row(["data", "confidence", "pairs", "promised", "aligned"]), "|---|---|---|---|---|"]
    for data in ("shapes", "modelnet40"):
        promised: list[float] = []
        aligned: list[bool] = []
        for path in sorted((results / "register").glob(f"*-{data}-*.json")):
            found = json.loads(path.read_text())["models"]["corrmat"]["per_pair"]
            both = zip(found["agreement"], found["support"], strict=True)
            promised += [registration.calibrated(*values) for values in both]
            aligned += [near < comparison.NEAR for near in found["adds"]]
        for low, high in itertools.pairwise((0, 0.25, 0.5, 0.75, 1)):
            here = [i for i, value in enumerate(promised) if low <= value < high]
            if here:
                shares = [
                    sum(values[i] for i in here) / len(here) for values in (promised, aligned)
                ]
                cells = [f"{low:.0%} to {high:.0%}", str(len(here)), *(f"{s:.0%}" for s in shares)]
                lines.append(_row([data, *cells]))
    return "\n".join(lines)


def markdown_bench(results: Path) -> str:
    """The table of docs/speed.md: every row of the last `make bench`."""
    path = results / "bench" / "bench.json"
    if not path.is_file():
        return "No benchmark is recorded."
    found = json.loads(path.read_text())
    heads = ["what", "ms", "peak memory, MB", "share of the matrix product's GFLOP/s"]
    lines = [_row([*heads, "the other way takes"]), "|---" * 5 + "|"]
    for row in found["rows"]:
        if "not_measured" in row:
            continue
        seconds = row["seconds"] * 1e3 if "seconds" in row else None
        time = next((row[name] for name in ("ms_a_pair", "ms") if name in row), seconds)
        cells = [
            row["what"] + (" (a pair)" if "ms_a_pair" in row else ""),
            f"{row['gflops']} GFLOP/s"
            if time is None
            else f"{time:.3g}"
            if time < 100
            else f"{time:,.0f}",
            str(row.get("peak_mb", "")),
            f"{row['peak_share']:.0%}" if "peak_share" in row else "",
        ]
        ratios = [f"{v} x ({k.removesuffix('_ratio')})" for k, v in row.items() if "_ratio" in k]
        if "released_peak_mb" in row:
            ratios.append(f"{row['released_peak_mb']} MB")
        lines.append(_row([*cells, ", ".join(ratios)]))
    lines += [""] + [
        f"- {what}, one pair of N points: time grows with N^{by['seconds']} (from N = 1024 on), "
        f"memory with N^{by['peak_mb']} (from N = 4096 on, where no matrix is whole)."
        for what, by in found["exponents"].items()
    ]
    lines += [
        "",
        "Minutes of training an arm of a laptop recipe, alone on the machine:",
        "",
    ]
    for recipe, arms in found["recipes"].items():
        lines.append(f"- {recipe}: " + ", ".join(f"{arm} {m}" for arm, m in arms.items()))
    about = f"{found['threads']} threads ({found['instructions']}), torch {found['torch']}"
    return "\n".join([f"Measured with {about}.", "", *lines])


def read_records(results: Path, scale: str = "*") -> list[dict[str, Any]]:
    """Every record below a folder, ordered by scale, experiment and data."""
    found = results.glob(f"{scale}/*/*/metrics.json")
    records = [json.loads(path.read_text()) for path in found]
    return sorted(records, key=lambda r: (r["scale"], r["id"], r["data"]))


def refresh(path: Path, name: str, content: str) -> None:
    """Replace what stands between `<!-- name -->` and `<!-- /name -->` in a file.

    Raises:
        CorrmatError: the marks are not there.
    """
    if not path.is_file():
        raise CorrmatError(f"no {path} to write into")
    text = path.read_text()
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if start not in text or end not in text:
        raise CorrmatError(f"{path} has no {start} ... {end} to write into")
    before, rest = text.split(start, 1)
    after = rest.split(end, 1)[1]
    replace_text(path, f"{before}{start}\n{content}\n{end}{after}")


def plain(value: Any) -> Any:  # noqa: ANN401
    """Nested settings as dictionaries, lists, numbers and text: what YAML and JSON can say."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def ratio(values: Sequence[float | None]) -> str:
    """Of METHOD to METHOD_corr, the first two, as text; empty where one is missing."""
    if len(values) < 2 or values[0] is None or not values[1]:
        return ""
    return f"{values[0] / values[1]:.3g}"


def cell(value: float | None, metric: str) -> str:
    """A metric's value as text; empty where there is none."""
    _, style, factor = METRICS[metric]
    return "" if value is None else format(value * factor, style)


def value_of(found: Mapping[str, Any], name: str) -> float | None:
    """A metric of an arm, None where it is missing or no number."""
    value = found.get(name)
    return None if value is None or math.isnan(value) else float(value)


def overall(found: Mapping[str, Any], name: str) -> float | None:
    """`value_of`, or the mean over bands where no more is given: all have equally many pairs."""
    own = value_of(found, name)
    if own is not None or not found.get("bands"):
        return own
    parts = [value for part in found["bands"] if (value := value_of(part, name)) is not None]
    return sum(parts) / len(parts) if len(parts) == len(found["bands"]) else None


def _labels(record: Mapping[str, Any], part: str) -> list[str]:
    """What the parts of an arm's test are called: rotation bands, shares of outliers."""
    first = next(iter(record["arms"].values()))
    if part == "bands":
        return ["{:g} to {:g} deg".format(*found["band_deg"]) for found in first.get(part, [])]
    return [f"{100 * found['outliers']:g} % outliers" for found in first.get(part, [])]


def _part(found: Mapping[str, Any], part: str, index: int) -> Mapping[str, Any]:
    if not part:
        return found
    parts = found.get(part, [])
    return parts[index] if index < len(parts) else {}


def _pairs(record: Mapping[str, Any]) -> float:
    return next(iter(record["arms"].values()))["pairs"]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
