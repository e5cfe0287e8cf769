"""The correspondence matrices of one pair: what the paper's loss does to a network, at a glance."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from corrmat.reporting.figures import to_png
from corrmat.reporting.record import read_snapshots
from corrmat.weights import load_model, shipped_metadata, shipped_models

LOSSES = {"1.2/DCP": "the transform", "1.2/DCP_corr": "the matrix"}


@torch.no_grad()
def draw_matrices(results: Path) -> bytes | None:
    """Draw the matrices of METHOD and METHOD_corr for the median pair of experiment 1.2, as a PNG.

    Rows are source points and columns target points, sorted so that the true matches are the
    diagonal.

    Args:
        results: folder of records.

    Returns:
        None where the weights do not ship, or their record is missing.
    """
    if not set(LOSSES) <= set(shipped_models()):
        return None
    snapshots = read_snapshots(results / shipped_metadata("1.2/DCP_corr")["record"])
    if not snapshots:
        return None
    pair = snapshots[len(snapshots) // 2]
    source, target = (torch.tensor([cloud]) for cloud in (pair.source, pair.target))
    match = np.asarray(pair.match)
    rows = np.argsort(match)
    rest = np.setdiff1d(np.arange(target.shape[1]), match)
    columns = np.concatenate([match[rows], rest])
    figure = Figure(figsize=(8.2, 2.9), layout="constrained")
    for axes, model in zip(figure.subplots(1, 2), LOSSES, strict=True):
        correspondence = load_model(model)(source, target).correspondence
        prob = correspondence.prob()[0].numpy()[np.ix_(rows, columns)]
        correct = (correspondence.argmax()[0].numpy() == match).mean()
        image = axes.imshow(prob, cmap="magma", vmin=0, vmax=prob.max())
        figure.colorbar(image, ax=axes, label="probability", fraction=0.032)
        name = model.split("/")[1]
        axes.set_title(f"{name}, loss on {LOSSES[model]}: {correct:.0%} right", fontsize="medium")
        axes.set(xlabel="target points", ylabel="source points", xticks=[], yticks=[])
    return to_png(figure)
