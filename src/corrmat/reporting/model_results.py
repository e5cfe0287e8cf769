"""Records of `corrmat compare`: what every model made of the same frozen pairs."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from corrmat.calibration import Scores
from corrmat.files import replace_json
from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG


@dataclass(frozen=True)
class ModelResult:
    """A model's errors on all pairs; keys of the record's JSON."""

    mean_deg: float
    median_deg: float
    recall_5deg: float
    recall_adds: float
    ms: float
    per_pair: dict[str, list[Any]]  # numbers; None where a pair has no such score

    @property
    def within_angle(self) -> np.ndarray:
        """Tell of each pair, (n,) bool, whether its rotation error is under 5 degrees."""
        return np.array(self.per_pair["rotation_error_deg"]) < RECALL_DEG

    @property
    def aligned(self) -> np.ndarray:
        """Tell of each pair, (n,) bool, whether the clouds lie on each other, by ADD-S."""
        return np.array(self.per_pair["adds"]) < ADDS_THRESHOLD

    @property
    def scores(self) -> list[Scores]:
        """Return what the confidence of each pair is computed from."""
        none = [None] * len(self.per_pair["agreement"])
        columns = (self.per_pair.get(name, none) for name in Scores._fields)
        return [Scores(*scores) for scores in zip(*columns, strict=True)]


@dataclass(frozen=True)
class Comparison:
    """A record: the pairs, and the result of every model."""

    protocol: str
    data: str
    points: int  # of a cloud before it is cropped
    models: dict[str, ModelResult]


def write_comparison(
    path: Path, results: Mapping[str, ModelResult], about: Mapping[str, object]
) -> None:
    """Write the record of a comparison.

    Args:
        path: of the JSON file.
        results: by model.
        about: the pairs, and the commit of the code that registered them.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    models = {name: asdict(result) for name, result in results.items()}
    hardware = {"threads": torch.get_num_threads(), "cpu": torch.backends.cpu.get_cpu_capability()}
    content = {**about, "hardware": hardware, "models": models}
    replace_json(path, content)


def read_comparison(path: Path) -> Comparison:
    """Read the record of a comparison."""
    content = json.loads(path.read_text())
    models = {name: ModelResult(**result) for name, result in content["models"].items()}
    # A comparison of several data sets names none.
    data = content.get("data", "")
    return Comparison(content["protocol"], data, content["points"], models)
