"""Models against each other on the same frozen pairs: what `corrmat evaluate --models` prints."""

import json
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from rich.progress import track
from scipy.spatial import KDTree

from corrmat import record
from corrmat.data import modelnet40, shapes
from corrmat.data.clouds import CloudSet
from corrmat.data.pairs import STREAM, Key, PairSettings, Split, make_pairs
from corrmat.errors import CorrmatError
from corrmat.files import replace_text
from corrmat.metrics import RECALL_DEG, rotation_error_deg
from corrmat.registration import Refine, register
from corrmat.types import PairBatch

Protocol = Literal["paper", "real", "clean"]
PROTOCOLS: dict[str, PairSettings] = {
    # Experiment 1.2: the same points, the source without 30 %, the mesh's own normals.
    "paper": PairSettings(keep=0.7),
    # Two scans: no shared point, noise, either cloud cropped, outliers, normals estimated.
    "real": PairSettings(
        keep=0.7,
        sampling="disjoint",
        jitter=0.01,
        outliers=0.05,
        outlier_distance=0.08,
        spoilt="both",
        normals="estimated",
    ),
    # The same without crop and outliers.
    "clean": PairSettings(sampling="disjoint", jitter=0.01, normals="estimated"),
}
NEAR = 0.03  # of the radius: mean distance below which aligned clean clouds agree (ADD-S)
COLUMNS = {
    "mean_deg": "mean °",
    "median_deg": "median °",
    "recall_5deg": "recall at 5°",
    "recall_adds": "recall ADD-S",
    "ms": "ms a pair",
}


def frozen_pairs(
    protocol: str,
    data: str = "shapes",
    root: Path | None = None,
    points: int = 512,
    count: int = 120,
    split: Split = "test",
) -> PairBatch:
    """Pairs of a protocol: every model sees the same, on every machine.

    Args:
        protocol: one of `PROTOCOLS`.
        data: "shapes" or "modelnet40".
        root: folder of modelnet40.
        points: of a cloud before it is cropped.
        count: of pairs, spread over the shapes of the split.
        split: "test", or "val" (training shapes) to choose settings on.

    Raises:
        CorrmatError: there are no such data, or not so many points.
    """
    clouds = _clouds(data, root, "test" if split == "test" else "train")
    how = replace(PROTOCOLS[protocol], num_points=points)
    known, needed = clouds.rows.shape[1], points * (2 if how.sampling == "disjoint" else 1)
    if needed > known:
        raise CorrmatError(
            f"points = {points}: {protocol} pairs need shapes of {needed} points, not {known}"
        )
    chosen = np.linspace(0, len(clouds) - 1, min(count, len(clouds))).round().astype(int)
    keys = [Key(0, STREAM[split], 0, int(index)) for index in chosen]
    return make_pairs(clouds, chosen.tolist(), keys, how)


def compare(pairs: PairBatch, models: Sequence[str], refine: Refine = "icp") -> dict[str, Any]:
    """Register every pair with every model.

    Args:
        pairs: from `frozen_pairs`; their normals are what the models get.
        models: as `register` knows them.
        refine: the same for all.

    Returns:
        Of every model, the columns of the table and per-pair values.
    """
    for model in models:  # one that cannot be had is known before the others have worked
        _row(pairs, 0, model, refine)
    found = {}
    for model in models:
        rows = [
            _row(pairs, index, model, refine)
            for index in track(range(len(pairs)), f"{model}", transient=True)
        ]
        angle, near, ms, agreement, support = (
            np.array(column) for column in zip(*rows, strict=True)
        )
        found[model] = {
            "mean_deg": float(angle.mean()),
            "median_deg": float(np.median(angle)),
            "recall_5deg": float((angle < RECALL_DEG).mean()),
            "recall_adds": float((near < NEAR).mean()),
            "ms": statistics.median(ms.tolist()),
            "per_pair": {
                "shape": pairs.shape.tolist(),
                "rotation_error_deg": np.round(angle, 4).tolist(),
                "adds": np.round(near, 5).tolist(),
                "agreement": np.round(agreement, 4).tolist(),
                "support": np.round(support, 4).tolist(),
            },
        }
    return found


def write(path: Path, models: dict[str, Any], **about: Any) -> None:  # noqa: ANN401 (as JSON)
    """The record of a comparison."""
    path.parent.mkdir(parents=True, exist_ok=True)
    found = {**about, "commit": record.commit(), "models": models}
    replace_text(path, json.dumps(found, indent=1) + "\n")


def table(models: dict[str, Any]) -> str:
    """Models and columns as plain text."""
    width = max(map(len, models))
    lines = [" " * width + "".join(f"{head:>14s}" for head in COLUMNS.values())]
    for name, found in models.items():
        cells = [
            f"{found[c]:14.1%}" if c.startswith("recall") else f"{found[c]:14.2f}" for c in COLUMNS
        ]
        lines.append(f"{name:{width}s}" + "".join(cells))
    return "\n".join(lines)


def _row(pairs: PairBatch, index: int, model: str, refine: Refine) -> tuple[float, ...]:
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    found = register(source, target, model=model, refine=refine)
    rotation, translation = pairs.rotation[index].double().numpy(), pairs.translation[index].numpy()
    clean = pairs.clean[index].double().numpy()
    truth = clean @ rotation.T + translation
    ours = clean @ found.transform[:3, :3].T + found.transform[:3, 3]
    near = float(KDTree(truth).query(ours)[0].mean())
    turned = torch.from_numpy(found.transform[:3, :3])
    angle = float(rotation_error_deg(turned[None], pairs.rotation[index, None].double()))
    return angle, near, 1e3 * found.seconds, found.agreement, found.support


def _clouds(data: str, root: Path | None, split: str) -> CloudSet:
    if data == "shapes":
        return shapes.load(split)
    if root is None:
        raise CorrmatError("data modelnet40 needs its folder: --root ...")
    return modelnet40.load(root, split)
