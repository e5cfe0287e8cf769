"""The result of a registration, for people and for programs."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from corrmat.calibration import Scores, as_percent
from corrmat.errors import CorrmatError
from corrmat.ops import rigid


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """The rigid transform that takes a source onto a target, and how far to trust it."""

    transform: np.ndarray  # (4, 4) float64, T_target_source in the clouds' own units
    matches: np.ndarray  # (K, 2) int64 rows of source and target; K = 0 for models without
    match_confidence: np.ndarray  # (K,) in [0, 1]; neighbours of the same point share it
    match_agrees: np.ndarray  # (K,) bool: whether the transform takes one end near the other
    scores: Scores  # what the confidence is computed from
    confidence: float  # in [0, 1]: chance that the clouds are aligned
    calibrated: bool  # whether it was fitted to this model and refinement: shipped weights and ICP
    rmse: float  # of aligned source points near a target point, in the clouds' units
    overlap: float  # share of source points near a target point: twice the spacing of points
    slides_along: np.ndarray | None  # (3,) in the target's axes: where its surfaces do not hold it
    turns_about: np.ndarray | None  # (3,) likewise, the axis about which any turn fits as well
    verdict: str  # "aligned", or "probably aligned: " or "doubtful: " and why
    model: str
    seed: int
    seconds: float

    def __repr__(self) -> str:
        """Say the most important, without arrays."""
        return (
            f"Registration({self.verdict!r}, confidence={self.confidence:.2f}, "
            f"rotation_deg={self.rotation_deg:.2f}, model={self.model!r})"
        )

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Move points (N, 3) of the source's frame onto the target: (N, 3)."""
        return rigid.move(self.transform, np.asarray(points, np.float64))

    @property
    def rotation_deg(self) -> float:
        """The rotation's angle."""
        return float(np.degrees(Rotation.from_matrix(self.transform[:3, :3]).magnitude()))


def to_text(registration: Registration) -> str:
    """Format a registration for people."""
    x, y, z = registration.transform[:3, 3]
    lines = [
        "matrix (target = matrix @ source):",
        *matrix_lines(registration.transform),
        f"rotation     {registration.rotation_deg:.3f} deg",
        f"translation  {x:.10g} {y:.10g} {z:.10g}",
        f"overlap      {registration.overlap:.1%} of the source has a target point near",
        f"RMSE         {registration.rmse:.6g} between these points"
        if registration.overlap
        else "",
    ]
    if len(registration.matches):
        agree, matches = registration.match_agrees.sum(), len(registration.matches)
        lines.append(f"matches      {agree} of {matches} agree with the transform")
    lines += [
        f"confidence   {as_percent(registration.confidence)}"
        f"{note_on_confidence(registration.calibrated)}",
        f"verdict      {registration.verdict}",
    ]
    if registration.turns_about is not None:
        axis = direction_text(registration.turns_about)
        lines.append(f"symmetry     the clouds fit as well after any turn about {axis}")
    lines.append(f"({registration.model}, seed {registration.seed}, {registration.seconds:.2f} s)")
    return "\n".join(filter(None, lines))


def read_transform(path: Path) -> np.ndarray:
    """Read a matrix: "transform" of a JSON file such as --json writes, or lines of numbers.

    Raises:
        CorrmatError: the file holds none.
    """
    try:
        text = path.read_text()
        if path.suffix.lower() == ".json":
            return np.array(json.loads(text)["transform"], np.float64)
        return np.loadtxt(text.splitlines(), np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CorrmatError(f"{path} holds no matrix ({type(error).__name__}: {error})") from error


def direction_text(direction: np.ndarray) -> str:
    """Format a unit vector (3,)."""
    x, y, z = direction.round(2) + 0.0
    return f"({x}, {y}, {z})"


def note_on_confidence(calibrated: bool) -> str:
    """Say which confidence was not fitted to its model and refinement."""
    return "" if calibrated else "  (not calibrated: it was fitted to model corrmat with ICP)"


def matrix_lines(transform: np.ndarray) -> list[str]:
    """Format a transform (4, 4), a line a row."""
    return ["  ".join(f"{value: .12g}".rjust(20) for value in row) for row in transform]


def to_json(registration: Registration, source: str, target: str) -> str:
    """Format a registration, of these files, for programs."""
    names = ("confidence", "calibrated", "rmse", "overlap", "verdict", "model", "seed", "seconds")
    values = {name: getattr(registration, name) for name in names}
    if not np.isfinite(registration.rmse):
        values["rmse"] = None
    for name in ("slides_along", "turns_about"):
        direction = getattr(registration, name)
        values[name] = None if direction is None else direction.tolist()
    files = {"source": source, "target": target}
    content = {**files, "transform": registration.transform.tolist(), **values}
    return json.dumps(content, indent=1) + "\n"
