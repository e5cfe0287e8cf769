"""Figures of a record: the paper's curves, and what was matched with what."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from corrmat.ops import rigid
from corrmat.report import METRICS, value_of
from corrmat.types import PairBatch, Prediction

# The columns of the paper's figures 5, 6 and 7: what a curve shows, by the arms' family.
PANELS = {
    "DCP": ("loss", "match_accuracy", "relative_euler_rmse_deg", "translation_rmse"),
    "RPMNet": ("loss", "match_accuracy", "rotation_error_deg_mean", "chamfer"),
    "PCRNet": ("loss", "match_accuracy", "naive_euler_rmse_deg", "rotation_error_deg_mean"),
}
COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd")  # METHOD red, METHOD_corr blue: the paper's
LINES = 150  # matches drawn, at most


def curves_figure(record: Mapping[str, Any], path: Path) -> None:
    """The paper's columns (`PANELS`), all arms.

    Validation metrics against pairs seen; the paper's final values as dotted lines.
    """
    arms = record["arms"]
    panels = PANELS[next(iter(arms)).split("_")[0]]
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


def matches_figure(batch: PairBatch, prediction: Prediction, title: str, path: Path) -> None:
    """The paper's figure 8: a pair before and after, right matches green and wrong ones red.

    Source black, target blue; points called outliers have a ring, red where they are none.

    Args:
        batch: a batch whose first pair is drawn.
        prediction: of that batch.
        title: above the figure.
        path: of the PNG.
    """
    c = prediction.correspondence
    if c is None:
        raise ValueError("this network predicts no correspondence to draw")
    x, y = batch.source[0, :, :3].numpy(), batch.target[0, :, :3].numpy()
    called, match = c.argmax()[0].numpy(), batch.match[0].numpy()
    aligned = rigid.apply(
        prediction.rotation[:1], prediction.translation[:1], batch.source[:1, :, :3]
    )
    outlier = called == len(y)
    right = called == match
    # Seen from the side on, and the target set aside, so that lines do not hide in the clouds.
    aside = np.array([1.2 * (np.ptp(x, 0).max() + np.ptp(y, 0).max()) / 2, 0, 0])
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    share = right[match < len(y)].mean() if (match < len(y)).any() else 1.0
    figure.suptitle(f"{title}: {100 * share:.0f} % of the matches are right")
    for place, (source, target, heading) in enumerate(
        ((x, y + aside, "source, target set aside, matches"), (aligned[0].numpy(), y, "registered"))
    ):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
        axes.scatter(*target.T, s=6, color="#1f77b4", label="target")
        axes.scatter(*source.T, s=6, color="black", label="source")
        if outlier.any():
            rings = np.where(right[outlier], "#2ca02c", "#d62728")
            axes.scatter(
                *source[outlier].T,
                s=60,
                facecolors="none",
                edgecolors=rings,
                label="called outlier",
            )
        for i in np.flatnonzero(~outlier)[:LINES]:
            colour = "#2ca02c" if right[i] else "#d62728"
            axes.plot(*np.stack([source[i], target[called[i]]]).T, color=colour, lw=0.5, alpha=0.6)
        axes.set(title=heading)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.legend(fontsize="x-small", loc="lower left")
    figure.savefig(path, dpi=110, metadata={"Software": None})
