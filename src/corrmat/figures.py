"""Figures of a record: the paper's curves, and what was matched with what."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from corrmat.report import METRICS, family, value_of

# The columns of the paper's figures 5, 6 and 7: what a curve shows, by the arms' family.
PANELS = {
    "DCP": ("loss", "match_accuracy", "relative_euler_rmse_deg", "translation_rmse"),
    "RPMNet": ("loss", "match_accuracy", "rotation_error_deg_mean", "chamfer"),
    "PCRNet": ("loss", "match_accuracy", "naive_euler_rmse_deg", "rotation_error_deg_mean"),
}
COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd")  # METHOD red, METHOD_corr blue: the paper's
LINES = 150  # matches drawn, at most


def panels_of(record: Mapping[str, Any]) -> tuple[str, ...]:
    """What the curves of a record show: the paper's columns, or those of a network of one's own."""
    own = ("loss", "match_accuracy", "rotation_error_deg_mean", "translation_rmse")
    return PANELS.get(family(record), own)


def curves_figure(record: Mapping[str, Any], path: Path) -> None:
    """The paper's columns (`PANELS`), all arms.

    Validation metrics against pairs seen; the paper's final values as dotted lines.
    """
    arms = record["arms"]
    panels = panels_of(record)
    figure = Figure(figsize=(15, 3.6), layout="constrained")
    figure.suptitle(f"{record['id']}  {record['title']}  ({record['scale']}, {record['data']})")
    for axes, name in zip(figure.subplots(1, len(panels)), panels, strict=True):
        title, _, factor = METRICS.get(name, ("training loss", "", 1))
        for arm, colour in zip(arms, COLOURS, strict=False):
            curve = arms[arm]["curve"]
            values = [value_of(point, name) for point in curve]
            if None not in values:
                seen = [point["pairs_seen"] for point in curve]
                shown = [factor * value for value in values if value is not None]
                axes.plot(seen, shown, color=colour, marker=".", label=arm)
            final = value_of(record["paper"].get(arm, {}), name)
            if final is not None:
                axes.axhline(
                    factor * final, color=colour, linestyle=":", linewidth=1, label=f"paper, {arm}"
                )
        if name not in ("loss", "match_accuracy"):
            axes.set_yscale("log")
        axes.set(title=title, xlabel="training pairs seen")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="x-small")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def matches_figure(view: Mapping[str, Any], title: str, path: Path) -> None:
    """The paper's figure 8: a pair before and after, right matches green and wrong ones red.

    Source black, target blue; points called outliers have a ring, red where they are none.

    Args:
        view: a pair and what was predicted of it; see `record.view`.
        title: above the figure.
        path: of the PNG.
    """
    x, y, match = (np.asarray(view[name]) for name in ("source", "target", "match"))
    last = view["steps"][-1]
    called = np.asarray(last["matched"])
    aligned = x @ np.asarray(last["rotation"]).T + last["translation"]
    outlier, right = called == len(y), called == match
    # The target is set aside, so that lines do not hide in the clouds.
    aside = np.array([0.6 * (np.ptp(x, 0).max() + np.ptp(y, 0).max()), 0, 0])
    figure = Figure(figsize=(11, 5), layout="constrained")
    inlier = (match >= 0) & (match < len(y))
    figure.suptitle(f"{title}: {100 * right[inlier].mean():.0f} % of the matches are right")
    for place, (source, target, heading) in enumerate(
        ((x, y + aside, "source, target set aside, matches"), (aligned, y, "registered"))
    ):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
        axes.scatter(*target.T, s=6, color="#1f77b4", label="target")
        axes.scatter(*source.T, s=6, color="black", label="source")
        if outlier.any():
            rings = np.where(right[outlier], "#2ca02c", "#d62728")
            axes.scatter(
                *source[outlier].T, s=60, facecolors="none", edgecolors=rings,
                label="called outlier",
            )  # fmt: skip
        for i in np.flatnonzero(~outlier)[:LINES]:
            colour = "#2ca02c" if right[i] else "#d62728"
            axes.plot(*np.stack([source[i], target[called[i]]]).T, color=colour, lw=0.5, alpha=0.6)
        axes.set(title=heading)
        axes.set_box_aspect(np.ptp(np.concatenate([source, target]), 0), zoom=1.2)
        axes.view_init(elev=20, azim=-80)
        axes.set_axis_off()
        axes.legend(fontsize="x-small", loc="lower left")
    figure.savefig(path, dpi=110, metadata={"Software": None})
