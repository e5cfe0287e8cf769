"""All experiments in one figure: small multiples of rotation error against training."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogFormatter, NullLocator

from corrmat.errors import CorrmatError
from corrmat.reporting.figures import GREEN, GREY, arm_colours, to_png
from corrmat.reporting.record import ArmResult, Record, defined

METRIC = "rotation_error_deg_mean"
COLUMNS = 4


def longest_records(records: Sequence[Record]) -> list[Record]:
    """Choose the record of each experiment with most training pairs; of equals, that on shapes.

    Records of the smoke scale and of other seeds than 0 are left out.
    """
    best: dict[str, Record] = {}
    documented = [r for r in records if r.scale != "smoke" and r.seed == 0]
    for record in sorted(documented, key=lambda r: (_training_pairs(r), r.data == "shapes")):
        best[record.id] = record
    return [best[identity] for identity in sorted(best)]


def _training_pairs(record: Record) -> int:
    return record.arms[record.treatment].pairs_seen


def draw_overview(records: Sequence[Record]) -> bytes:
    """Draw one panel an experiment, as a PNG: METHOD red, METHOD_corr blue, identity dashed.

    Validation against pairs seen; for the experiments that only test (1.4 and 2.4), the test
    against the initial misalignment.

    Args:
        records: one of each experiment.

    Raises:
        CorrmatError: there are none.
    """
    if not records:
        raise CorrmatError("no record to draw: make exp1.2 writes one (smoke runs are not drawn)")
    rows = -(-len(records) // COLUMNS)
    figure = Figure(figsize=(8.2, 1.95 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, squeeze=False).flatten()
    for axes, record in zip(panels, records, strict=False):
        _draw_panel(axes, record)
    for axes in panels[len(records) :]:
        axes.set_axis_off()
    figure.supylabel("mean rotation error, deg", fontsize="medium")
    figure.supxlabel("training pairs seen", fontsize="medium")
    named = {str(line.get_label()): line for axes in figure.axes for line in axes.lines}
    figure.legend(
        list(named.values()), list(named), loc="outside upper center", ncols=4, fontsize="small"
    )
    return to_png(figure)


def _draw_panel(axes: Axes, record: Record) -> None:
    """Draw the arms of one experiment and the identity guess."""
    colours, seen = arm_colours(record), []
    for arm, result in record.arms.items():
        x, y = _band_points(result) if result.bands else _curve_points(result)
        if not x:
            continue
        role = {record.baseline: "METHOD", record.treatment: "METHOD_corr"}.get(arm, "controls")
        colour, width = (GREEN, 0.8) if role == "controls" else (colours[arm], 1.6)
        axes.plot(x, y, color=colour, linewidth=width, label=role)
        seen += x
    identity = record.baselines.get("identity", ArmResult({})).metrics.get(METRIC)
    if identity:
        axes.axhline(identity, color=GREY, linestyle="--", linewidth=1, label="identity guess")
    trained = any(not result.bands for result in record.arms.values())
    if trained:
        axes.set_xscale("log")
        axes.set_xticks([min(seen), max(seen)] if seen else [])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    else:
        axes.set_xlabel("initial misalignment, deg", fontsize="x-small")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    # Labels between the powers of ten, where there are few of these.
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.3, 0.6)))
    axes.tick_params(which="minor", labelsize="xx-small")
    axes.tick_params(labelsize="x-small")
    axes.grid(alpha=0.3)
    axes.set_title(
        f"{record.id} {record.family}\n{record.scale}, {record.data}", fontsize="x-small"
    )


def _curve_points(result: ArmResult) -> tuple[list[float], list[float]]:
    """Return pairs seen and the metric on validation."""
    points = [(p["pairs_seen"], defined(p.get(METRIC))) for p in result.curve]
    kept = [(x, y) for x, y in points if y is not None and y > 0]
    return [x for x, _ in kept], [y for _, y in kept]


def _band_points(result: ArmResult) -> tuple[list[float], list[float]]:
    """Return the middles of the rotation bands and the metric in each."""
    points = [(band.position, defined(band.metrics.get(METRIC))) for band in result.bands]
    kept = [(x, y) for x, y in points if y is not None]
    return [x for x, _ in kept], [y for _, y in kept]
