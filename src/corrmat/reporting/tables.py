"""Records become tables. Every number comes from results/."""

import itertools
from collections.abc import Sequence

from corrmat.reporting.record import ArmResult, Record, Subset

# metric -> (heading, format, factor); the sound ones first, then the paper's.
METRICS: dict[str, tuple[str, str, float]] = {
    "match_accuracy": ("correct matches, %", ".1f", 100),
    "rotation_error_deg_mean": ("rotation error, mean, deg", ".3g", 1),
    "rotation_error_deg_median": ("rotation error, median, deg", ".3g", 1),
    "translation_rmse": ("translation RMSE", ".2g", 1),
    "outlier_precision": ("outlier class, precision, %", ".1f", 100),
    "outlier_recall": ("outlier class, recall, %", ".1f", 100),
    "outlier_r_precision": ("outlier class, precision = recall (R-precision), %", ".1f", 100),
    "recall@5deg_0.05": ("pairs under 5 deg and 0.05, %", ".1f", 100),
    "chamfer": ("Chamfer distance (squared)", ".2g", 1),
    "failed": ("pairs without an answer", ".0f", 1),
    "relative_euler_rmse_deg": ("rotation RMSE (Euler), deg", ".3g", 1),
    "relative_euler_mae_deg": ("rotation MAE (Euler), deg", ".3g", 1),
    "naive_euler_rmse_deg": ("rotation RMSE (naive Euler), deg", ".3g", 1),
    "transposed_match_accuracy": ("matches as released (transposed), %", ".1f", 100),
}
BAND_METRICS = ("relative_euler_mae_deg", "match_accuracy", "chamfer")
SWEEP_METRICS = (
    "match_accuracy", "rotation_error_deg_median", "relative_euler_rmse_deg",
    "outlier_precision", "outlier_recall", "outlier_r_precision",
)  # fmt: skip
# Numbers that the paper cannot mean, as (experiment, arm, subset, metric): in table 2 this Chamfer
# distance is a fifth of its neighbours'.
MISPRINTS = {("2.4", "RPMNet_corr", "120 to 150 deg", "chamfer")}
# Which of them the paper calls its rotation error, by family.
PAPER_METRIC = {
    "DCP": "relative_euler_rmse_deg",
    "RPMNet": "rotation_error_deg_mean",
    "PCRNet": "naive_euler_rmse_deg",
}


def paper_metric(record: Record) -> str:
    """Return what the paper calls a record's rotation error; the sound metric for new networks."""
    if record.bands_deg:
        return "relative_euler_mae_deg"  # of both tables
    return PAPER_METRIC.get(record.family, "rotation_error_deg_mean")


def table(record: Record) -> tuple[list[str], list[list[str]]]:
    """Build the table of ours beside the paper's: headings, and a row a metric (and subset)."""
    heads = ["", *record.arms, "ratio", *record.baselines]
    heads += [f"paper {arm}" for arm in record.as_printed]
    heads += ["paper ratio"] if record.paper else []
    groups = record.arms, record.baselines, record.as_printed
    rows = [
        row
        for name, (heading, _, _) in METRICS.items()
        if (row := _row_of(record, heading, name, [list(g.values()) for g in groups]))
    ]
    for part, names in (("bands", BAND_METRICS), ("sweep", SWEEP_METRICS)):
        subsets: list[Subset] = getattr(next(iter(record.arms.values())), part)
        for index, subset in enumerate(subsets):
            results = [[_subset(r, part, index) for r in group.values()] for group in groups]
            for name in names:
                heading = f"{subset.label}: {METRICS[name][0]}"
                if row := _row_of(record, heading, name, results):
                    rows.append(_mark_misprints(record, heads, row, subset.label, name))
    return heads, rows


def _mark_misprints(
    record: Record, heads: Sequence[str], row: list[str], subset: str, name: str
) -> list[str]:
    """Append "(misprint)" to the paper's numbers in `MISPRINTS`."""
    wrong = {f"paper {a}" for a in record.paper if (record.id, a, subset, name) in MISPRINTS}
    return [f"{c} (misprint)" if h in wrong else c for h, c in zip(heads, row, strict=True)]


def _subset(result: ArmResult, part: str, index: int) -> ArmResult:
    """Return one band (or share of outliers) of a result as a result of its own."""
    subsets: list[Subset] = getattr(result, part)
    return ArmResult(subsets[index].metrics if index < len(subsets) else {})


def _row_of(
    record: Record, heading: str, name: str, groups: Sequence[Sequence[ArmResult]]
) -> list[str]:
    """Build the row of a metric; empty if no arm has it."""
    ours, others, theirs = ([result.get(name) for result in group] for group in groups)
    if all(value is None for value in ours):
        return []
    by_arm = dict(zip(record.arms, ours, strict=True))
    ratio_of_arms = ratio_cell([by_arm[arm] for arm in record.compared])
    texts = [[cell(value, name) for value in group] for group in (ours, others, theirs)]
    row = [heading, *texts[0], ratio_of_arms, *texts[1], *texts[2]]
    return [*row, ratio_cell(theirs)] if record.paper else row


def terminal_table(record: Record) -> str:
    """Format `table` for a terminal, with a line on what was trained and for how long."""
    heads, rows = table(record)
    widths = [max(len(row[i]) for row in [heads, *rows]) for i in range(len(heads))]

    def line(cells: Sequence[str]) -> str:
        first, *rest = cells
        padded = [c.rjust(w) for c, w in zip(rest, widths[1:], strict=True)]
        return "  ".join([first.ljust(widths[0]), *padded])

    num_pairs = int(next(iter(record.arms.values())).metrics["pairs"])
    title = f"{record.id}  {record.title}  ({record.scale}, {record.data}, {num_pairs} test pairs)"
    compared = f"ratio: {' / '.join(record.compared)}" if len(record.compared) > 1 else ""
    lines = ["", title, effort(record), compared, "", line(heads), "-" * len(line(heads))]
    return "\n".join([*lines, *map(line, rows), ""])


def effort(record: Record) -> str:
    """Say how many pairs each arm was trained on, and for how many minutes."""
    return "; ".join(
        f"{arm}: {result.pairs_seen:,} pairs in {result.train_seconds / 60:.1f} min"
        for arm, result in record.arms.items()
    )


def markdown_summary(records: Sequence[Record]) -> str:
    """Build a row a record, "METHOD → METHOD_corr", and the paper's row below each experiment."""
    heads = [
        "experiment", "data", "correct matches, %", "rotation error, mean, deg",
        "rotation error, median, deg", "the paper's rotation error, deg", "minutes",
    ]  # fmt: skip
    lines = markdown_head(heads)
    for identity, group in itertools.groupby(records, key=lambda record: record.id):
        same = list(group)
        for record in same:
            arms = [record.arms[arm] for arm in record.compared]
            minutes = [f"{arm.train_seconds / 60:.1f}" for arm in arms]
            start = [f"{identity} {record.family}, {record.scale}", record.data]
            cells = [*start, *_arrows(record, arms), " → ".join(minutes)]
            lines.append(markdown_row(cells))
        cells = _arrows(same[0], list(same[0].as_printed.values()))
        if any(cells):
            start = [f"{identity} {same[0].family}, the paper", "ModelNet40"]
            lines.append(markdown_row([*start, *cells, ""]))
    return "\n".join(lines)


def _arrows(record: Record, results: Sequence[ArmResult]) -> list[str]:
    """Format cells "METHOD → METHOD_corr"; empty if neither has a number."""
    names = ["match_accuracy", "rotation_error_deg_mean", "rotation_error_deg_median"]
    cells = []
    for name in [*names, paper_metric(record)]:
        texts = [cell(result.overall(name), name) or "-" for result in results]
        cells.append(" → ".join(texts) if set(texts) != {"-"} else "")
    return cells


def markdown_tables(records: Sequence[Record]) -> str:
    """Format `table` of every record as Markdown, each under a heading."""
    parts = []
    for record in records:
        heads, rows = table(record)
        parts.append(f"### {record.id}, {record.title}: {record.scale}, {record.data}\n")
        parts += [*markdown_head(heads), *map(markdown_row, rows), ""]
    return "\n".join(parts).rstrip()


def markdown_head(heads: Sequence[str]) -> list[str]:
    """Build the two lines that begin a Markdown table."""
    return [markdown_row(heads), "|" + "---|" * len(heads)]


def markdown_row(cells: Sequence[str]) -> str:
    """Format a row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def arm_ratio(values: Sequence[float | None]) -> float | None:
    """Compute the ratio of METHOD to METHOD_corr; None if one is missing."""
    if len(values) < 2 or values[0] is None or not values[1]:
        return None
    return values[0] / values[1]


def ratio_cell(values: Sequence[float | None]) -> str:
    """Format the ratio of METHOD to METHOD_corr; empty if one is missing."""
    value = arm_ratio(values)
    return "" if value is None else f"{value:.3g}"


def cell(value: float | None, metric: str) -> str:
    """Format a metric's value; empty if there is none."""
    _, style, factor = METRICS[metric]
    return "" if value is None else format(value * factor, style)
