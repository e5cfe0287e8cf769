"""Records become tables and figures. Numbers come from results/ and from nowhere else."""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from corrmat.errors import CorrmatError

# metric -> (heading, format, factor); the paper's metrics first, then the sound ones.
METRICS: dict[str, tuple[str, str, float]] = {
    "match_accuracy": ("correct matches, %", ".1f", 100),
    "relative_euler_rmse_deg": ("rotation RMSE (Euler), deg", ".3g", 1),
    "relative_euler_mae_deg": ("rotation MAE (Euler), deg", ".3g", 1),
    "translation_rmse": ("translation RMSE", ".2g", 1),
    "rotation_error_deg_mean": ("rotation error, mean, deg", ".3g", 1),
    "rotation_error_deg_median": ("rotation error, median, deg", ".3g", 1),
    "recall@5deg_0.05": ("pairs under 5 deg and 0.05, %", ".1f", 100),
    "chamfer": ("Chamfer distance (squared)", ".2g", 1),
    "failed": ("pairs without an answer", ".0f", 1),
}
PANELS = {
    "loss": "training loss",
    "match_accuracy": "correct matches, %",
    "relative_euler_rmse_deg": "rotation RMSE, deg",
    "translation_rmse": "translation RMSE",
}
COLOURS = ("#d62728", "#1f77b4")  # METHOD red, METHOD_corr blue, as in the paper's figures
README_METRICS = (
    "match_accuracy",
    "relative_euler_rmse_deg",
    "rotation_error_deg_median",
    "translation_rmse",
)


def table(record: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Ours beside the paper's: headings and rows of text, one row a metric (and a band)."""
    first, second = record["arms"]
    heads = [
        "",
        f"{first}",
        f"{second}",
        "ratio",
        f"paper {first}",
        f"paper {second}",
        "paper ratio",
    ]
    rows = []
    for name, (label, style, factor) in METRICS.items():
        ours = [_value(record["arms"][arm], name) for arm in (first, second)]
        paper = [_value(record["paper"].get(arm, {}), name) for arm in (first, second)]
        if any(value is not None for value in ours):
            rows.append([label, *_cells(ours, style, factor), *_cells(paper, style, factor)])
    for index, (low, high) in enumerate(_bands(record)):
        for name in ("relative_euler_mae_deg", "match_accuracy"):
            label, style, factor = METRICS[name]
            ours = [_value(record["arms"][arm]["bands"][index], name) for arm in (first, second)]
            paper = [_value(_paper_band(record, arm, index), name) for arm in (first, second)]
            cells = [*_cells(ours, style, factor), *_cells(paper, style, factor)]
            rows.append([f"{low:g} to {high:g} deg: {label}", *cells])
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
    """The README's table: for every record a row an arm, the paper's below those of one id."""
    heads = ["experiment", "data", "arm", *(METRICS[name][0] for name in README_METRICS), "minutes"]
    lines = [_row(heads), "|" + "---|" * len(heads)]
    for identity, group in itertools.groupby(records, key=lambda record: record["id"]):
        same = list(group)
        for record in same:
            for arm, found in record["arms"].items():
                minutes = f"{found['train_seconds'] / 60:.1f}"
                start = [f"{identity} {record['scale']}", record["data"], arm]
                lines.append(_row([*start, *_readme_cells(found), minutes]))
        for arm, found in same[0]["paper"].items():
            cells = _readme_cells(found)
            if any(cells):
                lines.append(_row([f"{identity} paper", "ModelNet40", arm, *cells, ""]))
    return "\n".join(lines)


def _readme_cells(found: Mapping[str, Any]) -> list[str]:
    return [_cell(_value(found, name), *METRICS[name][1:]) for name in README_METRICS]


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
    path.write_text(f"{before}{start}\n{content}\n{end}{after}")


def curves_figure(record: Mapping[str, Any], path: Path) -> None:
    """The paper's four columns: loss, matches, rotation and translation error, both arms.

    Validation metrics against pairs seen; the paper's final values as dotted lines.
    """
    from matplotlib.figure import Figure  # only who draws waits for it

    figure = Figure(figsize=(15, 3.6), layout="constrained")
    figure.suptitle(f"{record['id']}  {record['title']}  ({record['scale']}, {record['data']})")
    for axes, (name, title) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
        factor = METRICS.get(name, ("", "", 1))[2]
        for arm, colour in zip(record["arms"], COLOURS, strict=False):
            curve = record["arms"][arm]["curve"]
            seen = [point["pairs_seen"] for point in curve]
            axes.plot(
                seen, [factor * point[name] for point in curve], color=colour, marker=".", label=arm
            )
            final = _value(record["paper"].get(arm, {}), name)
            if final is not None:
                axes.axhline(
                    factor * final, color=colour, linestyle=":", linewidth=1, label=f"paper, {arm}"
                )
        if name in ("relative_euler_rmse_deg", "translation_rmse"):
            axes.set_yscale("log")
        axes.set(title=title, xlabel="training pairs seen")
        axes.grid(alpha=0.3)
    figure.axes[1].legend(fontsize="small")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def plain(value: Any) -> Any:  # noqa: ANN401
    """Nested settings as dictionaries, lists, numbers and text: what YAML and JSON can say."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def _cells(pair: Sequence[float | None], style: str, factor: float) -> list[str]:
    first, second = pair
    ratio = "" if first is None or not second else f"{first / second:.3g}"
    return [_cell(first, style, factor), _cell(second, style, factor), ratio]


def _cell(value: float | None, style: str, factor: float) -> str:
    return "" if value is None else format(value * factor, style)


def _value(found: Mapping[str, Any], name: str) -> float | None:
    value = found.get(name)
    return None if value is None or math.isnan(value) else float(value)


def _bands(record: Mapping[str, Any]) -> list[tuple[float, float]]:
    edges = record.get("bands_deg") or []
    return list(zip(edges, edges[1:], strict=False))


def _paper_band(record: Mapping[str, Any], arm: str, index: int) -> Mapping[str, Any]:
    bands = record["paper"].get(arm, {}).get("bands", [])
    return bands[index] if index < len(bands) else {}


def _pairs(record: Mapping[str, Any]) -> float:
    return next(iter(record["arms"].values()))["pairs"]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
