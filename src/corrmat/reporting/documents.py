"""Rewrites the tables of README.md and docs/, and redraws their pictures, from results/."""

import functools
import json
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

from corrmat.errors import CorrmatError
from corrmat.files import replace_bytes, replace_text
from corrmat.reporting.claims import (
    NEAR_PAPER,
    Claim,
    by_paper_metric,
    claims_of,
    count_verdicts,
    headline,
    markdown_claims,
    other_verdicts_by_paper_metric,
    read_evidence,
    summarise_claims,
)
from corrmat.reporting.comparisons import (
    choice_table,
    comparison_summary,
    comparison_table,
    families_table,
    free_motions_table,
    large_choice_table,
    networks_table,
    other_scenes_table,
    real_scans_table,
)
from corrmat.reporting.confidences import confidence_table
from corrmat.reporting.intervals import Estimate, as_text
from corrmat.reporting.matrices import draw_matrices
from corrmat.reporting.overview import draw_overview, longest_records
from corrmat.reporting.record import Record, defined, read_records
from corrmat.reporting.tables import (
    arm_ratio,
    cell,
    markdown_head,
    markdown_row,
    markdown_summary,
    markdown_tables,
)
from corrmat.reporting.training_runs import doubling_summary, draw_training
from corrmat.reporting.writer import draw_record
from corrmat.weights import shipped_metadata, shipped_models

HEADLINES = ("1.2", "1.3", "2.1", "2.2", "3.2", "outliers")  # experiments of README's table


class Results:
    """A folder of records; what several tables need of it is read and judged once.

    Args:
        folder: results/.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @functools.cached_property
    def all_records(self) -> list[Record]:
        """The records of every scale and seed."""
        return read_records(self.folder)

    @functools.cached_property
    def records(self) -> list[Record]:
        """The records of README.md and docs/reproduction.md: every scale but smoke, seed 0."""
        return [r for r in self.all_records if r.scale != "smoke" and r.seed == 0]

    @functools.cached_property
    def claims(self) -> list[Claim]:
        """The ledger, judged by the records of every scale but smoke and of every seed."""
        return claims_of(self.all_records, self.folder)


def headline_table(results: Results) -> str:
    """Build README's table: six experiments, each by the longest training that is recorded.

    Below it stand how the paper's own metric would have it, and the verdicts of the whole ledger.
    """
    heads = [
        "experiment",
        "METHOD",
        "METHOD_corr",
        "RANSAC",
        "ratio of medians",
        "ratio by the paper's metric",
        "the paper's",
        "trained",
        "verdict",
    ]
    lines = markdown_head(heads)
    records = [r for r in longest_records(results.records) if r.id in HEADLINES]
    evidence = [read_evidence(record, results.folder) for record in records]
    lines += [markdown_row(headline(each)) for each in evidence]
    ratios = [
        [arm_ratio(by_paper_metric(record, of)) or math.nan for of in (record.arms, record.paper)]
        for record in records
    ]
    learnt = [each.left_identity(each.baseline) for each in evidence]
    ahead = sum(ours > 1 for ours, _ in ratios)
    near = sum(
        ours >= NEAR_PAPER * theirs
        for (ours, theirs), has_learnt in zip(ratios, learnt, strict=True)
        if has_learnt
    )
    counted = count_verdicts(results.claims)
    return "\n".join(
        [
            *lines,
            "",
            f"By the paper's metric METHOD_corr is ahead in {ahead} of these {len(ratios)} "
            f"experiments, and in {near} of the {sum(learnt)} in which METHOD learnt by at least "
            "half of the paper's ratio.",
            f"All verdicts of [docs/claims.md](docs/claims.md): {counted}.",
        ]
    )


def rates_table(results: Path) -> str:
    """Build the table of the learning-rate sweeps: validation error by rate, the choice in bold."""
    heads = ["experiment", "arm", "pairs", "rate / 3", "starting rate", "3 times the rate"]
    lines = markdown_head(heads)
    for path in sorted(results.glob("rates/*/*/*.json")):
        sweep = json.loads(path.read_text())
        for arm, result in sweep["arms"].items():
            cells = []
            for rate in result["rates"]:
                error = rate["rotation_error_deg_mean"]
                text = f"{rate['lr']:g}: " + ("diverged" if error is None else f"{error:.3g} deg")
                cells.append(f"**{text}**" if rate["lr"] == result["chosen"] else text)
            pairs = f"{max(rate['pairs_seen'] or 0 for rate in result['rates']):,}"
            where = f"{sweep['id']}, {sweep['scale']}, {sweep['data']}"
            lines.append(markdown_row([where, arm, pairs, *cells]))
    return "\n".join(lines)


def slack_table(results: Path) -> str:
    """Build the table of RPMNet_corr in 2.2 with its own alpha and with alpha held."""
    heads = ["network", "alpha", "rotation error, deg", "translation error", "true match, %"]
    lines = markdown_head(heads)
    path = results / "slack.json"
    tests = json.loads(path.read_text()) if path.is_file() else {}
    for name, test in sorted(tests.items()):
        for alpha, medians in test["alpha"].items():
            shown = f"its own, {medians['alpha']:.3g}" if alpha == "its own" else alpha
            degrees, units = medians["rotation_error_deg"], medians["translation_error"]
            share = f"{100 * medians['true_match_prob']:.1f}"
            lines.append(markdown_row([name, shown, f"{degrees:.3g}", f"{units:.2g}", share]))
    return "\n".join(lines)


def low_rate_table(results: Path) -> str:
    """Build the table of RPMNet_corr at RPMNet's steady rate in 2.2, beside the record's arms."""
    heads = ["record", "pairs", "arm and rate", "median rotation error, deg", "correct matches"]
    lines = markdown_head(heads)
    path = results / "low_rate.json"
    tests = json.loads(path.read_text()) if path.is_file() else {}
    for name, test in sorted(tests.items()):
        for arm, values in test["rows"].items():
            degrees = as_text(Estimate(**values["median_deg"]))
            matches = as_text(Estimate(**values["match_accuracy"]), "%")
            lines.append(markdown_row([name, f"{test['pairs_seen']:,}", arm, degrees, matches]))
    for name, test in sorted(tests.items()):
        ratio = as_text(Estimate(**test["ratio_at_the_low_rate"]))
        said = f"{name}: at the same steady rate RPMNet's median is {ratio} times RPMNet_corr's."
        lines += ["", said]
    return "\n".join(lines)


def batch_norm_table(results: Path) -> str:
    """Build the table of DCP's arms under running statistics and under those of each batch."""
    lines = markdown_head(["network", "tested with", "median, deg", "correct matches"])
    path = results / "batch_norm.json"
    tests = json.loads(path.read_text()) if path.is_file() else {}
    for name, test in sorted(tests.items()):
        for statistics, said in (("running", "running statistics"), ("batch", "each batch's")):
            degrees = as_text(Estimate(**test[statistics]["median_deg"]))
            matches = as_text(Estimate(**test[statistics]["match_accuracy"]), "%")
            lines.append(markdown_row([name, said, degrees, matches]))
    return "\n".join(lines)


def weights_table(records: Sequence[Record]) -> str:
    """Build the table of the trained arms that ship: names for `load_model`, and their records."""
    lines = markdown_head(["name", "record", "training pairs", "correct matches, %"])
    by_place = {record.place.as_posix(): record for record in records}
    for model in shipped_models():
        about = shipped_metadata(model)
        record = by_place.get(about["record"])
        if record is None:
            continue
        arm = record.arms[about["arm"]]
        share = cell(defined(arm.metrics.get("match_accuracy")), "match_accuracy")
        lines.append(markdown_row([f"`{model}`", about["record"], f"{arm.pairs_seen:,}", share]))
    return "\n".join(lines)


def seeds_table(results: Results) -> str:
    """Build the table of experiments that were trained from several seeds: medians of each."""
    groups: dict[tuple[str, str, str], dict[int, Record]] = defaultdict(dict)
    for record in results.all_records:
        if record.scale != "smoke":
            groups[record.id, record.scale, record.data][record.seed] = record
    heads = ["experiment", "arm", "median rotation error by seed, deg", "correct matches, %"]
    lines = markdown_head(heads)
    for (identity, scale, data), by_seed in sorted(groups.items()):
        if len(by_seed) < 2:
            continue
        for arm in by_seed[min(by_seed)].arms:
            results_of_arm = [by_seed[seed].arms[arm].metrics for seed in sorted(by_seed)]
            degrees = [f"{m['rotation_error_deg_median']:.3g}" for m in results_of_arm]
            shares = [defined(m.get("match_accuracy")) for m in results_of_arm]
            matches = [f"{100 * share:.1f}" for share in shares if share is not None]
            name = f"{identity}, {scale}, {data}"
            lines.append(markdown_row([name, arm, ", ".join(degrees), ", ".join(matches)]))
    return "\n".join(lines)


def bench_table(results: Path) -> str:
    """Build the table of docs/speed.md: every row of the last `make bench`."""
    path = results / "bench" / "bench.json"
    if not path.is_file():
        return "No benchmark is recorded."
    bench = json.loads(path.read_text())
    heads = ["what", "ms", "peak memory, MB", "share of the matrix product's GFLOP/s"]
    lines = markdown_head([*heads, "time of the other way / ours"])
    lines += [_bench_row(row) for row in bench["rows"] if "not_measured" not in row]
    lines += [""] + [
        f"- {what}, one pair of N points: time grows with N^{by['seconds']} (from N = 1024 on), "
        f"memory with N^{by['peak_mb']} (from N = 4096 on, where no matrix is whole)."
        for what, by in bench["exponents"].items()
    ]
    lines += ["", "Minutes of training an arm at laptop scale, estimated from some steps:", ""]
    for recipe, arms in bench["recipes"].items():
        lines.append(f"- {recipe}: " + ", ".join(f"{arm} {m}" for arm, m in arms.items()))
    machine = f"{bench['threads']} threads ({bench['instructions']}), torch {bench['torch']}"
    return "\n".join([f"Measured with {machine}.", "", *lines])


def _bench_row(row: dict[str, float | str]) -> str:
    """Format a row of bench.json."""
    per_pair = "ms_a_pair" in row
    ms = row.get("ms_a_pair", row.get("ms"))
    if ms is None and "seconds" in row:
        ms = float(row["seconds"]) * 1e3
    if ms is None:
        time = f"{row['gflops']} GFLOP/s" if "gflops" in row else ""
    else:
        time = f"{float(ms):.3g}" if float(ms) < 100 else f"{float(ms):,.0f}"
    ratios = [
        f"{value} x ({name.removesuffix('_ratio').replace('_', ' ')})"
        for name, value in row.items()
        if name.endswith("_ratio")
    ]
    if "released_peak_mb" in row:
        ratios.append(f"{row['released_peak_mb']} MB")
    share = f"{float(row['peak_share']):.0%}" if "peak_share" in row else ""
    what = f"{row['what']} (a pair)" if per_pair else str(row["what"])
    return markdown_row([what, time, str(row.get("peak_mb", "")), share, ", ".join(ratios)])


# document, mark in it, and its content
TABLES: tuple[tuple[str, str, Callable[[Results], str]], ...] = (
    ("README.md", "headline", headline_table),
    ("README.md", "register", lambda results: comparison_summary(results.folder)),
    ("docs/reproduction.md", "results", lambda results: markdown_summary(results.records)),
    ("docs/reproduction.md", "rates", lambda results: rates_table(results.folder)),
    ("docs/reproduction.md", "slack", lambda results: slack_table(results.folder)),
    ("docs/reproduction.md", "low_rate", lambda results: low_rate_table(results.folder)),
    ("docs/reproduction.md", "batch_norm", lambda results: batch_norm_table(results.folder)),
    ("docs/reproduction.md", "weights", lambda results: weights_table(results.records)),
    ("docs/reproduction.md", "seeds", seeds_table),
    ("docs/metrics.md", "tables", lambda results: markdown_tables(results.records)),
    ("docs/claims.md", "summary", lambda results: summarise_claims(results.claims)),
    (
        "docs/claims.md",
        "by-paper-metric",
        lambda results: other_verdicts_by_paper_metric(results.claims),
    ),
    ("docs/claims.md", "claims", lambda results: markdown_claims(results.claims)),
    ("docs/register.md", "comparison", lambda results: comparison_table(results.folder)),
    ("docs/how-it-works.md", "choice", lambda results: choice_table(results.folder)),
    ("docs/how-it-works.md", "large-choice", lambda results: large_choice_table(results.folder)),
    ("docs/how-it-works.md", "networks", lambda results: networks_table(results.folder)),
    ("docs/how-it-works.md", "families", lambda results: families_table(results.folder)),
    ("docs/how-it-works.md", "doubling", lambda results: doubling_summary(results.folder)),
    ("docs/register.md", "real_scans", lambda results: real_scans_table(results.folder)),
    ("docs/register.md", "other_scenes", lambda results: other_scenes_table(results.folder)),
    ("docs/register.md", "free_motions", lambda results: free_motions_table(results.folder)),
    ("docs/register.md", "confidence", lambda results: confidence_table(results.folder)),
    ("docs/speed.md", "bench", lambda results: bench_table(results.folder)),
)


def rewrite_documents(folder: Path, root: Path) -> int:
    """Rewrite every table of the documents and redraw the records' pictures.

    Args:
        folder: of records.
        root: folder of README.md and docs/.

    Returns:
        The number of records.

    Raises:
        CorrmatError: a document, or a mark in it, is missing.
    """
    for page, mark, _ in TABLES:
        _split_at_marks(root / page, mark)
    results = Results(folder)
    for record in results.records:
        draw_record(folder / record.place)
    draw_training(folder)
    matrices = draw_matrices(folder)
    if matrices is not None:
        replace_bytes(root / "docs" / "matrices.png", matrices)
    overview = draw_overview(longest_records(results.records))
    replace_bytes(root / "docs" / "overview.png", overview)
    for page, mark, content in TABLES:
        replace_between_marks(root / page, mark, content(results))
    return len(results.records)


def replace_between_marks(path: Path, name: str, content: str) -> None:
    """Replace the text between `<!-- name -->` and `<!-- /name -->` in a file.

    Raises:
        CorrmatError: the file or the marks are missing.
    """
    before, after = _split_at_marks(path, name)
    replace_text(path, f"{before}\n{content}\n{after}")


def _split_at_marks(path: Path, name: str) -> tuple[str, str]:
    """Return a file's text up to `<!-- name -->` and from `<!-- /name -->` on, marks included.

    Raises:
        CorrmatError: the file or the marks are missing.
    """
    if not path.is_file():
        raise CorrmatError(f"no {path} to write into")
    text = path.read_text()
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if start not in text or end not in text:
        raise CorrmatError(f"{path} has no {start} ... {end} to write into")
    before, rest = text.split(start, 1)
    return before + start, end + rest.split(end, 1)[1]
