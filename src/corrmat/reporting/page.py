"""All records as one HTML page that needs no server and no network."""

import base64
import gzip
import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path

from plotly.offline import get_plotlyjs

from corrmat.reporting import plots
from corrmat.reporting.claims import claims_of
from corrmat.reporting.html import render
from corrmat.reporting.overview import draw_overview, longest_records
from corrmat.reporting.provenance import command, staleness
from corrmat.reporting.record import Record, read_records, read_snapshots
from corrmat.reporting.tables import METRICS, cell, effort, paper_metric, ratio_cell, table

REPOSITORY = Path(__file__).resolve().parents[3]


@dataclass
class Article:
    """What the page shows of one record."""

    name: str  # anchor
    record: Record
    source: str  # file of its numbers
    command: str
    provenance: str
    stale: str
    heads: list[str]
    rows: list[list[str]]
    snapshots: list[tuple[str, str]]  # plot and label


@dataclass
class Section:
    """All records of one experiment."""

    id: str
    title: str
    articles: list[Article] = field(default_factory=list)


def build_page(results: Path) -> str:
    """Build the page of every record below a folder.

    Args:
        results: folder of records.

    Returns:
        HTML with everything in it.
    """
    records = sorted(read_records(results), key=lambda r: (r.id, r.scale, r.data, r.seed))
    longest = longest_records(records)
    figures: dict[str, plots.Plot] = {}
    sections = []
    for identity, group in itertools.groupby(records, key=lambda r: r.id):
        same = list(group)
        title = f"{identity} {same[0].family}: {same[0].title}"
        articles = [_article(record, results, figures) for record in same]
        sections.append(Section(identity, title, articles))
    return render(
        "records.html.j2",
        claims=claims_of(records, results),
        overview=base64.b64encode(draw_overview(longest)).decode() if longest else "",
        summary=[row for record in records for row in _summary_rows(record)],
        sections=sections,
        robustness=_robustness(results, figures),
        plots=_packed(figures),
        plotly=get_plotlyjs(),
    )


def _summary_rows(record: Record) -> list[dict[str, object]]:
    """Build the summary's rows of a record: its matches and the paper's rotation error."""
    rows = []
    for metric in ("match_accuracy", paper_metric(record)):
        roles = record.baseline, record.treatment
        ours, paper = (
            [group[arm].overall(metric) if arm in group else None for arm in roles]
            for group in (record.arms, record.paper)
        )
        rows.append(
            {
                "record": record,
                "heading": METRICS[metric][0],
                "anchor": _name(record),
                "title": f"{metric} in {_source(record)}; {command(record)}",
                "ours": [cell(value, metric) for value in ours],
                "ratio": ratio_cell(ours),
                "paper": [cell(value, metric) for value in paper],
                "paper_ratio": ratio_cell(paper),
            }
        )
    return rows


def _article(record: Record, results: Path, figures: dict[str, plots.Plot]) -> Article:
    """Collect what the page shows of a record, and add its plots to the page's."""
    name, folder = _name(record), results / record.place
    figures[f"{name}-curves"] = plots.curves_plot(record)
    figures[f"{name}-errors"] = plots.errors_plot(folder / "per_pair.csv", record)
    snapshots = []
    for snapshot in read_snapshots(folder):
        key = f"{name}-{snapshot.rank}"
        figures[key] = plots.snapshot_plot(snapshot)
        error = f"{snapshot.rotation_error_deg:.3g} deg"
        snapshots.append((key, f"{snapshot.rank} pair, {error}: {snapshot.arm} in 3-D"))
    heads, rows = table(record)
    return Article(
        name, record, _source(record), command(record), _provenance(record),
        staleness(record, REPOSITORY), heads, rows, snapshots,
    )  # fmt: skip


def _provenance(record: Record) -> str:
    """Say in one paragraph where a record's numbers come from."""
    commits = ", ".join(dict.fromkeys(str(arm.trained_at) for arm in record.arms.values()))
    hardware = record.hardware
    machine = f"{hardware.get('threads', '?')} CPU threads"
    machine += ", a GPU" if hardware.get("gpu") else ""
    machine += f", {hardware['precision']}" if "precision" in hardware else ""
    versions = "".join(f", {name} {version}" for name, version in (record.versions or {}).items())
    return (
        f"commit {record.commit}, seed {record.seed}, {machine}{versions}. {effort(record)}; "
        f"trained at {commits}. File: {_source(record)}"
    )


def _robustness(results: Path, figures: dict[str, plots.Plot]) -> list[dict[str, str]]:
    """Collect figure 2 at every scale, and add its plots to the page's."""
    entries = []
    for path in sorted(results.glob("*/robustness/curve.json")):
        scale, curves = path.parts[-3], json.loads(path.read_text())
        name = f"robustness-{scale}"
        figures[name] = plots.robustness_plot(curves)
        source = f"results/{scale}/robustness/curve.json"
        facts = f"{curves['draws']} draws a point, seed {curves['seed']}. File: {source}"
        entries.append({"name": name, "command": f"make robustness SCALE={scale}", "facts": facts})
    return entries


def _packed(figures: dict[str, plots.Plot]) -> str:
    """Pack the plots for the page: JSON, gzipped, as base64. That is a quarter of the JSON."""
    content = json.dumps(figures, separators=(",", ":")).encode()
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()


def _name(record: Record) -> str:
    return "-".join(record.place.parts)


def _source(record: Record) -> str:
    return f"results/{record.place.as_posix()}/metrics.json"
