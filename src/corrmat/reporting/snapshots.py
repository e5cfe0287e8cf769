"""One pair of a test as plain numbers, and the scene that figures and pages draw of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from torch import Tensor

from corrmat.types import PairBatch, Prediction

Points = list[list[float]]
_CLEAN_POINTS = 600  # kept of the clean cloud


@dataclass(frozen=True)
class SnapshotStep:
    """One iteration of a network on the pair."""

    rotation: Points  # (3, 3)
    translation: list[float]  # (3,)
    matched: list[int]  # (N,) predicted target index; M for an outlier


@dataclass(frozen=True)
class PairSnapshot:
    """A pair of the test and what an arm predicted for it."""

    arm: str
    rank: str  # "easiest", "median" or "hardest" pair of the test
    rotation_error_deg: float
    shape: int
    source: Points  # (N, 3)
    target: Points  # (M, 3)
    match: list[int]  # (N,) true target index; M for an outlier
    steps: list[SnapshotStep]
    clean: Points  # (P, 3) of the whole shape, in the source's frame

    @property
    def match_accuracy(self) -> float:
        """Share of the inliers whose predicted match is right."""
        match, matched = np.asarray(self.match), np.asarray(self.steps[-1].matched)
        inlier = (match >= 0) & (match < len(self.target))
        return float((matched == match)[inlier].mean())

    @staticmethod
    def from_json(content: Mapping[str, object]) -> "PairSnapshot":
        """Read an entry of snapshots.json."""
        steps = cast("Sequence[Mapping[str, object]]", content["steps"])
        fields = dict(content) | {"steps": [SnapshotStep(**step) for step in steps]}  # pyright: ignore[reportArgumentType]
        return PairSnapshot(**fields)  # pyright: ignore[reportArgumentType] (our own file)


class Stage(NamedTuple):
    """A scene to draw: two clouds, and the predicted matches between them."""

    label: str
    source: np.ndarray  # (N, 3), where this stage puts it
    target: np.ndarray  # (M, 3)
    matched: np.ndarray  # (N,) predicted target index; M for an outlier
    correct: np.ndarray  # (N,) bool
    shape: np.ndarray  # (P, 3) the whole shape, where this stage puts the source

    @property
    def called_outlier(self) -> np.ndarray:
        """(N,) bool: source points that the network calls outliers."""
        return self.matched == len(self.target)


def take_snapshot(
    arm: str, rank: str, error_deg: float, batch: PairBatch, prediction: Prediction
) -> PairSnapshot:
    """Take the snapshot of a batch of one pair.

    Args:
        arm: whose prediction.
        rank: "easiest", "median" or "hardest" pair of the test.
        error_deg: its rotation error.
        batch: a batch of this pair alone.
        prediction: of that batch, with a correspondence.
    """
    steps = [
        SnapshotStep(
            _rounded(step.rotation[0], 6),
            _rounded(step.translation[0], 6),
            step.correspondence.argmax()[0].tolist(),
        )
        for step in prediction.steps
        if step.correspondence is not None
    ]
    return PairSnapshot(
        arm=arm,
        rank=rank,
        rotation_error_deg=round(error_deg, 5),
        shape=int(batch.shape[0]),
        source=_rounded(batch.source[0, :, :3], 4),
        target=_rounded(batch.target[0, :, :3], 4),
        match=batch.match[0].tolist(),
        steps=steps,
        clean=thin(batch.clean[0].double().numpy().round(3), _CLEAN_POINTS).tolist(),
    )


def stages(snapshot: PairSnapshot) -> list[Stage]:
    """List the scenes of a pair: before, then after every iteration.

    Before, the target is set aside along x, so that the matches can be seen.
    """
    fields = snapshot.source, snapshot.target, snapshot.match, snapshot.clean
    x, y, match, clean = map(np.asarray, fields)
    gap = 0.6 * (np.ptp(x, 0).max() + np.ptp(y, 0).max())
    last = np.asarray(snapshot.steps[-1].matched)
    scenes = [Stage("before", x, y + [gap, 0, 0], last, last == match, clean)]
    for number, step in enumerate(snapshot.steps, 1):
        moved, shape = (c @ np.asarray(step.rotation).T + step.translation for c in (x, clean))
        matched = np.asarray(step.matched)
        scenes.append(Stage(f"iteration {number}", moved, y, matched, matched == match, shape))
    return scenes


def thin(points: np.ndarray, count: int) -> np.ndarray:
    """Take at most so many of the points (N, 3), evenly over their order."""
    return points[np.linspace(0, len(points) - 1, min(count, len(points))).astype(int)]


def _rounded(values: Tensor, digits: int) -> list:
    return np.round(values.double().numpy(), digits).tolist()
