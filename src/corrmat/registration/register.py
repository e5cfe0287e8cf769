"""Register two clouds: the rigid transform between them, its matches and its confidence."""

import functools
import json
import operator
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from torch import nn

from corrmat.calibration import Calibration, shipped_calibration, verdict
from corrmat.data.normals import estimate_normals
from corrmat.errors import CorrmatError
from corrmat.registration.em_icp import WIDTHS, em_icp
from corrmat.registration.hypotheses import (
    CLASSICAL,
    Hypotheses,
    HypothesisGenerator,
    NetworkHypotheses,
)
from corrmat.registration.scoring import AlignmentScorer
from corrmat.weights import load_model

Refine = Literal["icp", "none"]
MODEL_POINTS = 1024  # points of either cloud for the model
SELECTION_POINTS = 2048  # to select among its hypotheses
FULL_POINTS = 20_000  # to refine the selected one
# A candidate scores agreement + these times coherence, unmatched loss and support;
# benchmarks/choice.py.
CHOICE_WEIGHTS = 4.0, -1.0, 0.2
WITHOUT_MATCHABILITIES = 1.5, 0.0, 0.0  # for models that have none: no unmatched loss
CANDIDATE_STEPS = 5  # of generalised ICP, for each candidate; EM-ICP with matches does the rest
STEPS_WITHOUT_MATCHES = 30  # the same for models that have none
SAME_TRANSFORM = 0.1  # difference of two matrices: a turn by 4 degrees, or a shift by 0.1
COARSE_POINTS = 400  # of either cloud, for EM-ICP's first pass
FINE_ITERATIONS = 4  # of its second pass, on all points of a model with matches
MEDIAN = 0.6  # median distance from the centroid after scaling: a radius of about one
NORMAL_TOLERANCE = 0.01  # by which the length of a given normal may differ from one
FAR = 30.0  # median distances from the middle: a point beyond is a stray one and left out
# Unrelated clouds of fewer points may lie on each other: they are "doubtful" at best.
FEW_POINTS, FEW_CONFIDENCE = 30, 0.49
OTHER_SIZE = 8.0  # times as large: two such clouds may have different units
_LINE = 1e-6  # a cloud that is thinner, relative to its length, is a line


@dataclass(frozen=True, eq=False)
class Registration:
    """The rigid transform that takes a source onto a target, and how far to trust it."""

    transform: np.ndarray  # (4, 4) float64, T_target_source in the clouds' own units
    matches: np.ndarray  # (K, 2) int64 rows of source and target; K = 0 for models without
    match_confidence: np.ndarray  # (K,) in [0, 1]; neighbours of the same point share it
    match_agrees: np.ndarray  # (K,) bool: whether the transform takes one end near the other
    agreement: float  # in [0, 1]: how much of either cloud lies on the other
    support: float  # in [0, 1]: share of the matches that the transform explains; 1 without any
    confidence: float  # in [0, 1]: chance that the clouds are aligned, calibrated for "corrmat"
    rmse: float  # of aligned source points near a target point, in the clouds' units
    overlap: float  # share of source points near a target point: twice the spacing of points
    verdict: str  # "aligned", or "probably aligned: " or "doubtful: " and why
    model: str
    seed: int
    seconds: float

    @property
    def rotation_deg(self) -> float:
        """The rotation's angle."""
        cosine = (np.trace(self.transform[:3, :3]) - 1) / 2
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def register(
    source: np.ndarray,
    target: np.ndarray,
    *,
    model: str | Path | nn.Module = "corrmat",
    refine: Refine = "icp",
    seed: int = 0,
) -> Registration:
    """Find the rigid transform that takes the source onto the target.

    The clouds may be in any units, overlap in part, share no point, and have outliers. Stray
    points, more than thirty median distances from the middle, are left out. The same points in any
    order, with the same seed, give the same matrix.

    Args:
        source: (N, 3), or (N, 6) with unit normals.
        target: (M, 3), or (M, 6).
        model: "corrmat" for the shipped weights; "icp", or where they are installed "ransac",
            "ransac17", "fgr" or "kiss", for the classical pipelines; whatever else `load_model`
            takes; or a network, or a method, of your own.
        refine: "icp": generalised ICP of all candidates of the model, EM-ICP of the best; or
            "none": the candidates as they are.
        seed: of subsampling and of the model's random draws.

    Returns:
        The registration, in the units of the clouds.

    Raises:
        CorrmatError: the points are not a cloud, or do not determine a rotation; the model is
            unknown.
    """
    if refine not in ("icp", "none"):
        raise CorrmatError(f"refine = {refine!r}; choices: icp, none")
    seed = operator.index(seed)  # an integer of NumPy is one too
    if not 0 <= seed < 2**63:
        raise CorrmatError(f"seed = {seed} is not between 0 and 2^63")
    if isinstance(model, nn.Module):
        network = getattr(model, "network", None)  # of a method
        generate: HypothesisGenerator = NetworkHypotheses(
            network if isinstance(network, nn.Module) and hasattr(network, "min_points") else model
        )
        model = type(model).__name__
    else:
        generate = CLASSICAL.get(str(model)) or _load_network(str(model))
    start = time.perf_counter()
    (x, y), scale, subsamples, scorer = prepare_clouds(source, target, seed)
    hypotheses = generate(*subsamples, seed)
    weights = WITHOUT_MATCHABILITIES if hypotheses.unmatched_nll is None else CHOICE_WEIGHTS

    candidates = hypotheses.transforms
    if refine == "icp":
        steps = STEPS_WITHOUT_MATCHES if hypotheses.prob is None else CANDIDATE_STEPS
        candidates = distinct(np.stack([scorer.refine(t, steps) for t in candidates]))
    transform = candidates[choose(measure(candidates, hypotheses, subsamples, scorer), weights)]
    full = scorer
    if max(len(x.rows), len(y.rows)) > SELECTION_POINTS:
        full = AlignmentScorer(x.points(scale, FULL_POINTS), y.points(scale, FULL_POINTS))
    if refine == "icp":
        transform = refine_chosen(transform, hypotheses, subsamples, full)
    agreement = scorer.alignment(transform).agreement
    support = hypotheses.support(transform, *subsamples)
    agrees = hypotheses.match_support(transform, *subsamples) > 0
    confidence = _calibration().confidence(agreement, support if len(agrees) else None)
    fewest = min(len(x.rows), len(y.rows))
    if fewest < FEW_POINTS:
        confidence = min(confidence, FEW_CONFIDENCE)
    overlap, rmse = full.overlap_and_rmse(transform)
    rows = [cloud.rows[m] for cloud, m in zip((x, y), hypotheses.matches.T, strict=True)]
    return Registration(
        transform=to_original_units(transform, scale, x.centre, y.centre),
        matches=np.stack(rows, 1),
        match_confidence=hypotheses.confidence,
        match_agrees=agrees,
        agreement=agreement,
        support=support,
        confidence=confidence,
        rmse=rmse / scale,
        overlap=overlap,
        verdict=verdict(confidence, _reason(agrees, overlap, x.median / y.median, fewest)),
        model=str(model),
        seed=seed,
        seconds=time.perf_counter() - start,
    )


def _reason(agrees: np.ndarray, overlap: float, size: float, fewest: int) -> str:
    """Say what a confidence that is not high rests on.

    Args:
        agrees: (K,) bool, whether the transform explains each match.
        overlap: share of the source that lies on the target.
        size: of the source, relative to the target.
        fewest: points of the smaller cloud.
    """
    reasons = [f"{agrees.sum()} of {len(agrees)} matches agree"] if len(agrees) else []
    reasons.append(f"{overlap:.0%} of the source lies on the target")
    if fewest < FEW_POINTS:
        reasons.append(f"a cloud has only {fewest} points")
    if max(size, 1 / size) > OTHER_SIZE:
        times = f"{max(size, 1 / size):,.0f} times as large"
        reasons.append(f"one cloud is {times} as the other: do both have the same unit?")
    return ", ".join(reasons)


class PreparedClouds(NamedTuple):
    """Two clouds as the model and the choice among its hypotheses see them."""

    clouds: "tuple[Cloud, Cloud]"
    scale: float  # from the user's units to those in which a cloud's radius is about one
    subsamples: tuple[np.ndarray, np.ndarray]  # (N, 6) and (M, 6), for the model
    scorer: AlignmentScorer


def prepare_clouds(source: np.ndarray, target: np.ndarray, seed: int) -> PreparedClouds:
    """Check, centre, scale and subsample two clouds; see `register`."""
    x, y = Cloud.of(source, "source", seed), Cloud.of(target, "target", seed)
    scale = 2 * MEDIAN / (x.median + y.median)
    subsamples = x.with_normals(scale, MODEL_POINTS), y.with_normals(scale, MODEL_POINTS)
    scorer = AlignmentScorer(x.points(scale, SELECTION_POINTS), y.points(scale, SELECTION_POINTS))
    return PreparedClouds((x, y), scale, subsamples, scorer)


def distinct(transforms: np.ndarray) -> np.ndarray:
    """Drop each transform that is nearly an earlier one: (T, 4, 4) to (D, 4, 4)."""
    kept = transforms[:1]
    for transform in transforms[1:]:
        if np.linalg.norm(kept - transform, axis=(1, 2)).min() > SAME_TRANSFORM:
            kept = np.concatenate([kept, transform[None]])
    return kept


def measure(
    transforms: np.ndarray,
    hypotheses: Hypotheses,
    subsamples: tuple[np.ndarray, np.ndarray],
    scorer: AlignmentScorer,
) -> np.ndarray:
    """Measure what the choice among transforms weighs.

    Args:
        transforms: (T, 4, 4).
        hypotheses: of the model.
        subsamples: the clouds that they were made from.
        scorer: of the clouds to measure the transforms on; their first points are the model's.

    Returns:
        (T, 4): agreement, coherence, unmatched loss, support.
    """
    rows = []
    for transform in transforms:
        agreement, coherence, distances = scorer.alignment(transform)
        support = hypotheses.support(transform, *subsamples)
        rows.append((agreement, coherence, hypotheses.unmatched_loss(distances), support))
    return np.array(rows)


def choose(measures: np.ndarray, weights: tuple[float, float, float]) -> int:
    """Choose the candidate of the highest score.

    Args:
        measures: (T, 4) of `measure`.
        weights: of coherence, unmatched loss and support, beside agreement's 1.
    """
    return int(np.argmax(measures @ [1.0, *weights]))


def refine_chosen(
    transform: np.ndarray,
    hypotheses: Hypotheses,
    subsamples: tuple[np.ndarray, np.ndarray],
    full: AlignmentScorer,
) -> np.ndarray:
    """Refine the chosen transform (4, 4) by EM-ICP, on a few points and then on all of the model's.

    With matches, the last iterations are enough for the second pass. Generalised ICP follows where
    it is more exact: on points that the model has not seen, and on points that both clouds share.

    Args:
        transform: of the source onto the target.
        hypotheses: from which it was chosen.
        subsamples: the clouds that they were made from.
        full: scorer of the clouds, with all their points.
    """
    source, target = (cloud[:COARSE_POINTS] for cloud in subsamples)
    prob = hypotheses.prob
    some = None if prob is None else prob[: len(source), : len(target)]
    transform = em_icp(transform, source, target, some)
    if max(map(len, subsamples)) > COARSE_POINTS:
        widths = WIDTHS if prob is None else WIDTHS[-FINE_ITERATIONS:]
        transform = em_icp(transform, *subsamples, prob, widths)
    more = max(len(full.source), len(full.target)) > MODEL_POINTS
    return full.refine(transform) if more or full.shares_points(transform) else transform


class Cloud:
    """At most `FULL_POINTS` points of a user's cloud, in canonical order, and their centroid.

    They are ordered by a hash of coordinates and seed, so that the first n are a random subsample
    that does not depend on the order of the user's rows.
    """

    def __init__(self, rows: np.ndarray, values: np.ndarray) -> None:
        self.rows, self.values = rows, values
        self.centre = values[:, :3].mean(0)
        self.centred = values[:, :3] - self.centre
        self.median = float(np.median(np.linalg.norm(self.centred, axis=1)))

    @classmethod
    def of(cls, cloud: np.ndarray, name: str, seed: int) -> "Cloud":
        """Check a cloud and bring it into canonical order.

        Raises:
            CorrmatError: see `register`.
        """
        if isinstance(cloud, str | Path):
            raise CorrmatError(f"{name}: points are needed; corrmat.read_scan reads a file")
        if isinstance(cloud, np.ma.MaskedArray):
            raise CorrmatError(f"{name}: a masked array; pass the rows that count, or fill it")
        try:
            values = np.asarray(cloud, np.float64)
        except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError is torch's
            raise CorrmatError(f"{name}: not an array of numbers ({error})") from error
        if values.ndim != 2 or values.shape[1] not in (3, 6):
            raise CorrmatError(f"{name}: array of shape {values.shape}, not (N, 3) or (N, 6)")
        if len(values) < 3:
            raise CorrmatError(f"{name}: {len(values)} points; a rotation needs at least 3")
        bad = np.flatnonzero(~np.isfinite(values).all(1))
        if len(bad):
            raise CorrmatError(
                f"{name}: {len(bad)} points are NaN or infinite, the first is row {bad[0]}"
            )
        lengths = np.linalg.norm(values[:, 3:], axis=1)
        if values.shape[1] > 3 and np.abs(lengths - 1).max() > NORMAL_TOLERANCE:
            worst = lengths[np.abs(lengths - 1).argmax()]
            raise CorrmatError(
                f"{name}: columns 4 to 6 are no unit normals (one has length {worst:.3g}); pass "
                "the points alone, (N, 3), and normals are estimated"
            )
        # A point that is there more than once counts once: its copies would shrink the spacing.
        rows = np.unique(_hash(values, seed), return_index=True)[1]
        if values.shape[1] > 3:  # copies may differ in their normals
            first = np.unique(_hash(values[rows, :3], seed), return_index=True)[1]
            rows = rows[np.sort(first)]
        rows = rows[:FULL_POINTS]
        if len(rows) < 3:
            many = f"{len(rows)} different points" if len(rows) > 1 else "all points are equal"
            raise CorrmatError(f"{name}: {many}; the rotation is not determined")
        rows = rows[is_near(values[rows, :3], values[rows, :3], name)]
        if len(rows) < 3:
            raise CorrmatError(f"{name}: {len(rows)} points are left without the stray ones")
        checked = cls(rows, values[rows])
        length, breadth, _ = np.linalg.svd(checked.centred, compute_uv=False)[:3]
        noise = 1e-12 * np.abs(checked.values[:, :3]).max() * np.sqrt(len(rows))
        if length <= noise:
            raise CorrmatError(f"{name}: all points are equal; the rotation is not determined")
        if breadth <= max(_LINE * length, noise):
            raise CorrmatError(
                f"{name}: all points lie on one line; the rotation is not determined"
            )
        return checked

    def points(self, scale: float, count: int) -> np.ndarray:
        """Return the first points, (n, 3), centred and scaled."""
        return self.centred[:count] * scale

    def with_normals(self, scale: float, count: int) -> np.ndarray:
        """Return the first points with normals, (n, 6); missing normals are estimated from them."""
        points = self.points(scale, count)
        given = self.values[:count, 3:]
        return np.hstack([points, given if given.shape[1] else estimate_normals(points)])


def is_near(points: np.ndarray, different: np.ndarray, name: str = "cloud") -> np.ndarray:
    """Tell which points are no stray ones: (N,) bool.

    Args:
        points: (N, 3).
        different: (M, 3) the same, each once: copies would move the middle.
        name: of the cloud, for the error.

    Raises:
        CorrmatError: coordinates are too large to be squared.
    """
    middle = np.median(different, axis=0)
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(points - middle, axis=1)
        typical = np.median(np.linalg.norm(different - middle, axis=1))
    if not np.isfinite(typical):
        raise CorrmatError(f"{name}: coordinates are too large to compute distances")
    return distance <= FAR * typical


def _hash(values: np.ndarray, seed: int) -> np.ndarray:
    """Hash every row to 64 bits by the finaliser of splitmix64 (Steele et al., 2014)."""
    state = np.full(len(values), seed, np.uint64)
    for column in np.ascontiguousarray((values + 0.0).T).view(np.uint64):  # + 0.0: no minus zero
        state = state * np.uint64(0x9E3779B97F4A7C15) ^ column
        state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return state


def _load_network(model: str) -> NetworkHypotheses:
    """Load a model, kept in memory until its file changes.

    Raises:
        CorrmatError: there is no such model.
    """
    path = Path(model)
    path = path / "model.safetensors" if path.is_dir() else path  # what `corrmat export` wrote
    stat = path.stat() if path.is_file() else None
    try:
        return _cached_network(
            model, stat and (str(path.resolve()), stat.st_mtime_ns, stat.st_size)
        )
    except CorrmatError as error:
        if path.exists() or model.startswith("hf:"):
            raise
        raise CorrmatError(f"{error}; classical pipelines: {', '.join(CLASSICAL)}") from error


@functools.cache
def _calibration() -> Calibration:
    return shipped_calibration()


@functools.lru_cache(maxsize=4)
def _cached_network(model: str, file: tuple[str, int, int] | None) -> NetworkHypotheses:
    return NetworkHypotheses(load_model(model))


def to_text(registration: Registration) -> str:
    """Format a registration for people."""
    x, y, z = registration.transform[:3, 3]
    lines = [
        "matrix (target = matrix @ source):",
        *matrix_lines(registration.transform),
        f"rotation     {registration.rotation_deg:.3f} deg",
        f"translation  {x:.6g} {y:.6g} {z:.6g}",
        f"overlap      {registration.overlap:.1%} of the source has a target point near",
        f"RMSE         {registration.rmse:.6g} of those" if registration.overlap else "",
    ]
    if len(registration.matches):
        agree, matches = registration.match_agrees.sum(), len(registration.matches)
        lines.append(f"matches      {agree} of {matches} agree with the transform")
    fitted = registration.model == "corrmat"
    note = "" if fitted else "  (fitted to the shipped weights, not to this model)"
    lines += [
        f"confidence   {registration.confidence:.0%}{note}",
        f"verdict      {registration.verdict}",
    ]
    lines.append(f"({registration.model}, seed {registration.seed}, {registration.seconds:.2f} s)")
    return "\n".join(filter(None, lines))


def matrix_lines(transform: np.ndarray) -> list[str]:
    """Format a transform (4, 4), a line a row."""
    return ["  ".join(f"{value: .12g}".rjust(20) for value in row) for row in transform]


def to_json(registration: Registration, source: str, target: str) -> str:
    """Format a registration, of these files, for programs."""
    names = ("confidence", "rmse", "overlap", "verdict", "model", "seed", "seconds")
    values = {name: getattr(registration, name) for name in names}
    if not np.isfinite(registration.rmse):
        values["rmse"] = None
    files = {"source": source, "target": target}
    content = {**files, "transform": registration.transform.tolist(), **values}
    return json.dumps(content, indent=1) + "\n"


def to_original_units(
    transform: np.ndarray, scale: float, centre_x: np.ndarray, centre_y: np.ndarray
) -> np.ndarray:
    """Convert a transform of centred, scaled clouds to the user's coordinates."""
    converted = transform.copy()
    converted[:3, 3] = centre_y + transform[:3, 3] / scale - transform[:3, :3] @ centre_x
    return converted
