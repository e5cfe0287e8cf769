"""Register several scans onto one: all pairs, then the poses on which most of them agree."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from torch import nn

from corrmat.calibration import as_percent, verdict
from corrmat.errors import CorrmatError
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration.preparation import Cloud
from corrmat.registration.register import DOUBTFUL, Refine, register
from corrmat.registration.result import matrix_lines, note_on_confidence

_SWEEPS = 50  # of averaging; poses settle within ten
# How far a registration may be off the poses to agree with them: in degrees, and as a share of the
# median distance of a scan's points from their centroid.
_ANGLE_DEG, _SHARE = 10.0, 0.2


@dataclass(frozen=True, eq=False)
class ScanPose:
    """The pose of one of several scans."""

    transform: np.ndarray  # (4, 4) float64, T_target_scan, in the scans' own units
    confidence: float  # of the weakest registration on the surest way; low if most disagree
    calibrated: bool  # as of a `Registration`
    agree: int  # registrations of this scan that agree with the poses
    verdict: str  # as of a `Registration`


def register_scans(
    scans: Sequence[np.ndarray | Cloud],
    *,
    model: str | Path | nn.Module = "corrmat",
    refine: Refine = "icp",
    seed: int = 0,
) -> list[ScanPose]:
    """Find the rigid transforms that take all scans onto the last.

    Every pair is registered. The surest registrations that connect all scans (a maximum spanning
    tree) give the first poses; averaging over all registrations that agree with them gives the
    rest (chordal rotation averaging, Hartley et al., IJCV 2013).

    Args:
        scans: two or more, each as for `register`; the last is the target.
        model: as for `register`.
        refine: as for `register`.
        seed: as for `register`.

    Returns:
        A pose for each scan but the last.

    Raises:
        CorrmatError: there are fewer than two scans; as for `register`.
    """
    if len(scans) < 2:
        raise CorrmatError(f"{len(scans)} scan: two or more are needed")
    clouds = [
        Cloud.of(scan, f"scan {number} of {len(scans)}", seed)  # so that errors name the right one
        for number, scan in enumerate(scans, 1)
    ]
    edges = []
    pairs = list(itertools.combinations(range(len(scans)), 2))
    for i, j in track(pairs, "registering pairs"):
        result = register(clouds[i], clouds[j], model=model, refine=refine, seed=seed)
        edges.append(_Edge(i, j, result.transform, result.confidence, result.calibrated))
    graph = _PoseGraph(clouds, edges)
    return [graph.pose(index) for index in range(len(scans) - 1)]


def to_text(paths: Sequence[Path], target: Path, poses: Sequence[ScanPose]) -> str:
    """Format poses for people."""
    lines = [f"every scan onto {target} (target = matrix @ scan):"]
    for path, pose in zip(paths, poses, strict=True):
        lines.append(
            f"{path}: {pose.verdict}, confidence {as_percent(pose.confidence)}"
            f"{note_on_confidence(pose.calibrated)}"
        )
        lines += matrix_lines(pose.transform)
    return "\n".join(lines)


def to_json(
    paths: Sequence[Path], target: Path, poses: Sequence[ScanPose], *, model: str, seed: int
) -> str:
    """Format poses, by this model and seed, for programs."""
    scans = [
        {"scan": str(path), **asdict(pose), "transform": pose.transform.tolist()}
        for path, pose in zip(paths, poses, strict=True)
    ]
    content = {"target": str(target), "model": model, "seed": seed, "scans": scans}
    return json.dumps(content, indent=1) + "\n"


@dataclass(frozen=True)
class _Edge:
    """A registration of scan `source` onto scan `target`."""

    source: int
    target: int
    transform: np.ndarray  # (4, 4)
    confidence: float
    calibrated: bool

    def seen_from(self, index: int) -> tuple[int, np.ndarray]:
        """Return the other scan and the transform of scan `index` onto it."""
        if index == self.source:
            return self.target, self.transform
        return self.source, np.linalg.inv(self.transform)


class _PoseGraph:
    """Poses of scans, kept as rotation and image of the centroid: exact far from the origin.

    Args:
        clouds: the last one's pose is the identity.
        edges: registrations of pairs.
    """

    def __init__(self, clouds: Sequence[Cloud], edges: Sequence[_Edge]) -> None:
        self.edges, self.last = edges, len(clouds) - 1
        self.centres = np.stack([cloud.centre for cloud in clouds])
        self.tolerance = _SHARE * float(np.mean([cloud.median for cloud in clouds]))
        self.rotations = np.stack([np.eye(3)] * len(clouds))
        self.images = self.centres.copy()  # of the centroids, in the last scan's frame
        self.confidence = np.ones(len(clouds))
        self._span()
        for _ in range(_SWEEPS):
            for index in range(self.last):
                self._average(index)

    def pose(self, index: int) -> ScanPose:
        """Return the pose of a scan."""
        rotation = self.rotations[index]
        translation = self.images[index] - rotation @ self.centres[index]
        transform = rigid.to_homogeneous(rotation, translation)
        confidence, mine = float(self.confidence[index]), self._edges_of(index)
        agree = sum(self._agrees(index, *self._predict(index, edge)) for edge in mine)
        if 2 * agree < len(mine):
            confidence = min(confidence, DOUBTFUL)
        calibrated = all(edge.calibrated for edge in mine)
        reason = f"{agree} of {len(mine)} registrations agree"
        return ScanPose(transform, confidence, calibrated, agree, verdict(confidence, reason))

    def _edges_of(self, index: int) -> list[_Edge]:
        return [edge for edge in self.edges if index in (edge.source, edge.target)]

    def _predict(self, index: int, edge: _Edge) -> tuple[np.ndarray, np.ndarray]:
        """Predict a scan's rotation and the image of its centroid from the scan across an edge."""
        other, transform = edge.seen_from(index)
        offset = transform[:3, :3] @ self.centres[index] + transform[:3, 3] - self.centres[other]
        rotation = self.rotations[other]
        return rotation @ transform[:3, :3], self.images[other] + rotation @ offset

    def _agrees(self, index: int, rotation: np.ndarray, image: np.ndarray) -> bool:
        """Tell whether a prediction is near a scan's pose."""
        angle = Rotation.from_matrix(rotation @ self.rotations[index].T).magnitude()
        distance = np.linalg.norm(image - self.images[index])
        return bool(np.degrees(angle) < _ANGLE_DEG and distance < self.tolerance)

    def _span(self) -> None:
        """Place the scans one by one, always over the surest registration to a placed one."""
        placed = {self.last}
        while len(placed) <= self.last:
            across = [e for e in self.edges if (e.source in placed) != (e.target in placed)]
            edge = max(across, key=lambda e: e.confidence)
            index = edge.target if edge.source in placed else edge.source
            other, _ = edge.seen_from(index)
            self.rotations[index], self.images[index] = self._predict(index, edge)
            self.confidence[index] = min(edge.confidence, self.confidence[other])
            placed.add(index)

    def _average(self, index: int) -> None:
        """Move a scan to the mean of the predictions that agree with its pose, by confidence."""
        predictions = [(*self._predict(index, e), e.confidence) for e in self._edges_of(index)]
        agreeing = [p for p in predictions if self._agrees(index, p[0], p[1])]
        if not agreeing:
            return
        rotations, images, weights = map(np.array, zip(*agreeing, strict=True))
        self.rotations[index] = Rotation.from_matrix(rotations).mean(weights).as_matrix()
        self.images[index] = np.average(images, 0, weights)
