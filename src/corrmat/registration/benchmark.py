"""Compare models on the same frozen pairs: what `corrmat compare` prints."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from corrmat.calibration import Scores
from corrmat.data.pairs import STREAM, Key, PairSettings, Split, make_pairs
from corrmat.data.registry import load_clouds
from corrmat.data.scan_pairs import ScanPair, make_object_pair, make_room_pair
from corrmat.errors import CorrmatError
from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG, rotation_error_deg
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration.register import register
from corrmat.reporting.model_results import ModelResult
from corrmat.types import PairBatch

Protocol = Literal["paper", "real", "views", "clean", "dense", "rooms"]
# Two scans: no shared point, noise, both clouds cropped, outliers, normals estimated.
_SCANS = PairSettings(
    keep=0.7,
    sampling="disjoint",
    jitter=0.01,
    outliers=0.05,
    corrupted="both",
    normals="estimated",
)
PROTOCOLS: dict[Protocol, PairSettings] = {
    # Experiment 1.2: the same points, the source without 30 %, the mesh's own normals.
    "paper": PairSettings(keep=0.7),
    "real": _SCANS,
    # What two depth cameras see of one object, up to 60 degrees apart.
    "views": replace(_SCANS, views=1.0),
    # Two scans without crop and outliers.
    "clean": PairSettings(sampling="disjoint", jitter=0.01, normals="estimated"),
}
# Dense scans: of single objects, and of rooms in metres.
SCANS: dict[Protocol, Callable[[int, int, Split], ScanPair]] = {
    "dense": make_object_pair, "rooms": make_room_pair,
}  # fmt: skip
TABLE_POINTS: dict[Protocol, tuple[int, ...]] = {  # of a cloud, in the tables of the documents
    "real": (512, 1024), "views": (512,), "clean": (512, 1024), "dense": (20_000,),
    "rooms": (20_000,),
}  # fmt: skip
COLUMNS = {
    "mean_deg": "mean °",
    "median_deg": "median °",
    "recall_5deg": "recall at 5°",
    "recall_adds": "recall ADD-S",
    "ms": "ms a pair",
}


class Outcome(NamedTuple):
    """What a model made of one pair."""

    angle_deg: float
    adds: float
    ms: float
    scores: Scores


def frozen_pairs(
    protocol: Protocol,
    data: str = "shapes",
    root: Path | None = None,
    points: int = 512,
    count: int = 120,
    split: Split = "test",
) -> PairBatch:
    """Draw the pairs of a protocol: every model gets the same, on every machine.

    Args:
        protocol: one of `PROTOCOLS` or of `SCANS`, which need no data set.
        data: name of the data set.
        root: folder of the data set.
        points: of a cloud before it is cropped.
        count: of pairs, spread over the shapes of the split.
        split: "test"; or "val", training shapes, to tune what was not trained on them.

    Raises:
        CorrmatError: the data set cannot be read, or has too few points.
    """
    if protocol in SCANS:
        return _pair_scans([SCANS[protocol](index, points, split) for index in range(count)])
    clouds = load_clouds(data, "test" if split == "test" else "train", None, root)
    settings = replace(PROTOCOLS[protocol], num_points=points)
    if settings.min_cloud_points > clouds.num_points:
        raise CorrmatError(
            f"points = {points}: {protocol} pairs need shapes of {settings.min_cloud_points} "
            f"points, not {clouds.num_points}"
        )
    chosen = np.linspace(0, len(clouds) - 1, min(count, len(clouds))).round().astype(int)
    keys = [Key(0, STREAM[split], 0, int(index)) for index in chosen]
    return make_pairs(clouds, chosen.tolist(), keys, settings)


def _pair_scans(pairs: Sequence[ScanPair]) -> PairBatch:
    """Put scans into a batch, without normals; their `clean` clouds are of the sources.

    A scan that has fewer points than the largest one repeats some: points that are there more than
    once count once.
    """
    source, target = (
        np.stack([_repeated(getattr(pair, name), most) for pair in pairs])
        for name in ("source", "target")
        for most in [max(len(getattr(pair, name)) for pair in pairs)]
    )
    rotation, translation = (
        np.stack([getattr(pair, name) for pair in pairs]) for name in ("rotation", "translation")
    )
    none = torch.full(source.shape[:2], target.shape[1])
    source, target, rotation, translation = map(
        torch.from_numpy, (source, target, rotation, translation)
    )
    index = torch.arange(len(pairs))
    return PairBatch(source, target, rotation, translation, none, source[:, :2048], index)


def _repeated(points: np.ndarray, count: int) -> np.ndarray:
    """Repeat the points of a cloud (N, 3) to `count`."""
    return points[np.arange(count) % len(points)]


def unrelated(pairs: PairBatch, count: int) -> PairBatch:
    """Put sources beside targets of other pairs, a third of the batch further on: no pose is right.

    Neighbours in a batch may be of one family. The true transforms of the result mean nothing.

    Args:
        pairs: of related clouds.
        count: of sources, spread evenly over them; at most all.
    """
    chosen = torch.linspace(0, len(pairs) - 1, min(count, len(pairs))).round().long()
    fields_of = {field.name: getattr(pairs, field.name) for field in fields(pairs)}
    related = {name: value[chosen] for name, value in fields_of.items()}
    others = (chosen + max(len(pairs) // 3, 1)) % len(pairs)
    return PairBatch(**related | {"target": pairs.target[others]})


def compare(pairs: PairBatch, models: Sequence[str]) -> dict[str, ModelResult]:
    """Register every pair with every model.

    Args:
        pairs: from `frozen_pairs`; the models get their normals.
        models: as `register` takes them.
    """
    for model in models:  # a model that cannot be loaded fails before the others have worked
        _register_pair(pairs, 0, model)
    return {
        model: summarise(
            pairs,
            [_register_pair(pairs, index, model) for index in track(range(len(pairs)), model)],
        )
        for model in models
    }


def summarise(pairs: PairBatch, outcomes: Sequence[Outcome]) -> ModelResult:
    """Compute a model's result from its outcome on every pair."""
    angle, adds, ms = map(np.array, zip(*(outcome[:3] for outcome in outcomes), strict=True))
    scores = zip(*(outcome.scores for outcome in outcomes), strict=True)
    return ModelResult(
        mean_deg=float(angle.mean()),
        median_deg=float(np.median(angle)),
        recall_5deg=float((angle < RECALL_DEG).mean()),
        recall_adds=float((adds < ADDS_THRESHOLD).mean()),
        ms=statistics.median(ms.tolist()),
        per_pair={
            "shape": pairs.shape.tolist(),
            "rotation_error_deg": np.round(angle, 4).tolist(),
            "adds": np.round(adds, 5).tolist(),
            **{
                name: [None if value is None else round(value, 4) for value in values]
                for name, values in zip(Scores._fields, scores, strict=True)
                if any(value is not None for value in values)
            },
        },
    )


def to_table(results: Mapping[str, ModelResult]) -> str:
    """Format models and columns as plain text."""
    width = max(map(len, results))
    lines = [" " * width + "".join(f"{head:>14s}" for head in COLUMNS.values())]
    for name, result in results.items():
        cells = []
        for column in COLUMNS:
            value = getattr(result, column)
            cells.append(f"{value:14.1%}" if column.startswith("recall") else f"{value:14.2f}")
        lines.append(f"{name:{width}s}" + "".join(cells))
    return "\n".join(lines)


def _register_pair(pairs: PairBatch, index: int, model: str) -> Outcome:
    """Register one pair."""
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    result = register(source, target, model=model)
    angle, adds = errors(pairs, index, result.transform)
    return Outcome(angle, adds, 1e3 * result.seconds, result.scores)


def errors(pairs: PairBatch, index: int, transform: np.ndarray) -> tuple[float, float]:
    """Compute the rotation error in degrees and ADD-S of a transform (4, 4) for one pair."""
    rotation, translation = pairs.rotation[index].double().numpy(), pairs.translation[index].numpy()
    clean = pairs.clean[index].double().numpy()
    truth = clean @ rotation.T + translation
    moved = rigid.move(transform, clean)
    predicted = torch.from_numpy(transform[:3, :3])
    angle = float(rotation_error_deg(predicted[None], pairs.rotation[index, None].double()))
    return angle, float(KDTree(truth).query(moved)[0].mean())
