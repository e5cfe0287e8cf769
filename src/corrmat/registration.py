"""Two clouds -> the rigid motion between them, its matches, and how far to trust it."""

import functools
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import small_gicp
from scipy.spatial import KDTree

from corrmat.aligners import CLASSICAL, Aligner, Learned
from corrmat.data.normals import estimate
from corrmat.errors import CorrmatError
from corrmat.weights import load_model, shipped_about

Refine = Literal["icp", "none"]
SIZE = 1024  # points of either cloud that an aligner sees
CHOICE = 2048  # that its guesses are compared on
FULL = 20_000  # that the best guess is refined on
MEDIAN = 0.6  # what the median distance from the centroid is scaled to: a radius of about one
TRUST = 0.5  # confidence from where on the verdict is "aligned"
LONGEST_NORMAL = 1.01  # given ones are units, or zero
_FLAT = 1e-6  # thinner than this against its length, a cloud is a line


@dataclass(frozen=True)
class Registration:
    """How a source lies on a target."""

    transform: np.ndarray  # (4, 4) float64, T_target_source in the clouds' own units
    matches: np.ndarray  # (K, 2) int64 rows of source and target; K = 0 for models without
    match_confidence: np.ndarray  # (K,) in [0, 1]; neighbours of the same point share it
    match_agrees: np.ndarray  # (K,) bool: whether the motion takes one end near the other
    agreement: float  # in [0, 1]: how much of either cloud lies on the other
    support: float  # in [0, 1]: how much of the matches the motion explains; 1 without any
    confidence: float  # in [0, 1]: calibrated chance that the clouds are aligned
    rmse: float  # of aligned source points that have a target point in reach, own units
    overlap: float  # share of source points that have one
    verdict: str  # "aligned", or "doubtful: " and why
    model: str
    seed: int
    seconds: float

    @property
    def rotation_deg(self) -> float:
        """The angle of the rotation."""
        cosine = (np.trace(self.transform[:3, :3]) - 1) / 2
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def register(
    source: np.ndarray,
    target: np.ndarray,
    *,
    model: str | Path = "corrmat",
    refine: Refine = "icp",
    seed: int = 0,
) -> Registration:
    """Find the rigid motion that takes the source onto the target.

    Any units and any common size; the clouds may overlap in part, share no point, and hold
    outliers. The same points in any order, with the same seed, give the same matrix.

    Args:
        source: (N, 3), or (N, 6) with unit normals.
        target: (M, 3), or (M, 6).
        model: "corrmat" for the shipped weights; "icp", "ransac" or "fgr" for the classical
            pipelines; or a checkpoint file.
        refine: "icp" on up to 20,000 points of each cloud after the model's guess, or "none".
        seed: of subsampling and of whatever a model draws.

    Returns:
        The registration, in the units of the clouds.

    Raises:
        CorrmatError: points that are no cloud, or that do not determine a rotation; an
            unknown model.
    """
    if refine not in ("icp", "none"):
        raise CorrmatError(f"refine = {refine!r}; known: icp, none")
    if seed < 0:
        raise CorrmatError(f"seed = {seed} is negative")
    aligner: Aligner = CLASSICAL.get(str(model)) or _learned(str(model))
    began = time.perf_counter()
    x, y = Cloud.of(source, "source", seed), Cloud.of(target, "target", seed)
    scale = 2 * MEDIAN / (x.median + y.median)
    few = x.with_normals(scale, SIZE), y.with_normals(scale, SIZE)
    guesses = aligner(*few, seed)
    judge = Judge(x.points(scale, CHOICE), y.points(scale, CHOICE))
    transforms = guesses.transforms
    if refine == "icp":
        transforms = np.stack([judge.icp(transform) for transform in transforms])
    agreements = [judge.agreement(transform) for transform in transforms]
    supports = [guesses.support(transform, *few) for transform in transforms]
    chosen = int(np.argmax(np.multiply(agreements, supports)))
    best, agreement, support = transforms[chosen], agreements[chosen], supports[chosen]
    full = Judge(x.points(scale, FULL), y.points(scale, FULL))
    if refine == "icp":
        best = full.icp(best)
    confidence = calibrated(agreement, support if len(guesses.matches) else None)
    overlap, rmse = full.fit(best)
    return Registration(
        transform=_in_own_units(best, scale, x.centre, y.centre),
        matches=np.stack([c.rows[m] for c, m in zip((x, y), guesses.matches.T, strict=True)], 1),
        match_confidence=guesses.confidence,
        match_agrees=guesses.explained(transforms[chosen], *few) > 0,
        agreement=agreement,
        support=support,
        confidence=confidence,
        rmse=rmse / scale,
        overlap=overlap,
        verdict=_verdict(confidence, overlap),
        model=str(model),
        seed=seed,
        seconds=time.perf_counter() - began,
    )


class Cloud:
    """At most FULL points of a user's cloud, in an order of their own, about their centroid.

    The order is that of a hash of coordinates and seed, so that the first n are a random
    subsample that does not depend on the order of the user's rows.
    """

    def __init__(self, rows: np.ndarray, values: np.ndarray) -> None:
        self.rows, self.values = rows, values
        self.centre = values[:, :3].mean(0)
        self.centred = values[:, :3] - self.centre
        self.median = float(np.median(np.linalg.norm(self.centred, axis=1)))

    @classmethod
    def of(cls, cloud: np.ndarray, name: str, seed: int) -> "Cloud":
        """Check a cloud and bring it into order.

        Raises:
            CorrmatError: see `register`.
        """
        values = np.asarray(cloud, np.float64)
        if values.ndim != 2 or values.shape[1] not in (3, 6):
            raise CorrmatError(f"{name}: array of shape {values.shape}, not (N, 3) or (N, 6)")
        if len(values) < 3:
            raise CorrmatError(f"{name}: {len(values)} points; a rotation needs at least 3")
        bad = np.flatnonzero(~np.isfinite(values).all(1))
        if len(bad):
            raise CorrmatError(
                f"{name}: {len(bad)} points are NaN or infinite, the first is row {bad[0]}"
            )
        longest = np.linalg.norm(values[:, 3:], axis=1).max(initial=0)
        if longest > LONGEST_NORMAL:
            raise CorrmatError(
                f"{name}: columns 4 to 6 are no unit normals (one has length {longest:.3g}); pass "
                "the points alone, (N, 3), and normals are estimated"
            )
        rank = _hash(values, seed)
        few = np.argpartition(rank, FULL)[:FULL] if len(rank) > FULL else np.arange(len(rank))
        rows = few[np.argsort(rank[few])]
        found = cls(rows, values[rows])
        length, breadth, _ = np.linalg.svd(found.centred, compute_uv=False)[:3]
        noise = 1e-12 * np.abs(found.values[:, :3]).max() * np.sqrt(len(rows))
        if length <= noise:
            raise CorrmatError(f"{name}: all points are equal; the rotation is not determined")
        if breadth <= max(_FLAT * length, noise):
            raise CorrmatError(
                f"{name}: all points lie on one line; the rotation is not determined"
            )
        if not found.median:
            raise CorrmatError(f"{name}: most points are equal; there is no shape to register")
        return found

    def points(self, scale: float, count: int) -> np.ndarray:
        """The first points, (n, 3), centred and scaled."""
        return self.centred[:count] * scale

    def with_normals(self, scale: float, count: int) -> np.ndarray:
        """The first points with their normals, (n, 6); estimated from these points if not given."""
        points = self.points(scale, count)
        given = self.values[:count, 3:]
        return np.hstack([points, given if given.shape[1] else estimate(points)])


def _hash(values: np.ndarray, seed: int) -> np.ndarray:
    """A 64-bit number of every row, by the finaliser of splitmix64 (Steele et al., 2014)."""
    mixed = np.full(len(values), seed, np.uint64)
    for column in np.ascontiguousarray((values + 0.0).T).view(np.uint64):  # + 0.0: no minus zero
        mixed = mixed * np.uint64(0x9E3779B97F4A7C15) ^ column
        mixed = (mixed ^ mixed >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ mixed >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return mixed


class Judge:
    """Refines motions of one cloud onto another, and says how well the two agree.

    Args:
        source: (N, 3), of a radius of about one.
        target: (M, 3).
    """

    def __init__(self, source: np.ndarray, target: np.ndarray) -> None:
        self.source, self.target = source, target
        self.trees = KDTree(source), KDTree(target)
        spacings = [tree.query(tree.data, 2)[0][:, 1] for tree in self.trees]
        # Points of one surface, sampled twice, lie about as far apart as neighbours do.
        self.reach = float(np.clip(2 * np.mean([np.median(s) for s in spacings]), 0.01, 0.2))

    @functools.cached_property
    def _clouds(self) -> tuple[small_gicp.PointCloud, small_gicp.PointCloud, small_gicp.KdTree]:
        clouds = [small_gicp.PointCloud(points) for points in (self.source, self.target)]
        for cloud in clouds:
            small_gicp.estimate_normals_covariances(cloud, num_neighbors=min(12, cloud.size()))
        return clouds[0], clouds[1], small_gicp.KdTree(clouds[1])

    def icp(self, transform: np.ndarray) -> np.ndarray:
        """Generalised ICP (Segal et al., RSS 2009) from a guess (4, 4)."""
        source, target, tree = self._clouds
        found = small_gicp.align(
            target,
            source,
            tree,
            transform,
            registration_type="GICP",
            max_correspondence_distance=self.reach,
            max_iterations=30,
        )
        return np.asarray(found.T_target_source)

    def agreement(self, transform: np.ndarray) -> float:
        """In [0, 1]: how much of either cloud lies on the other, both ways."""
        distances = self._distances(transform)
        return float(
            np.mean([np.clip(1 - (d / self.reach) ** 2, 0, None).mean() for d in distances])
        )

    def fit(self, transform: np.ndarray) -> tuple[float, float]:
        """Share of source points with a target point in reach, and the RMS distance of those."""
        there, _ = self._distances(transform)
        near = there[there < self.reach]
        return len(near) / len(there), float(np.sqrt(np.mean(near**2))) if len(near) else np.nan

    def _distances(self, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rotation, translation = transform[:3, :3], transform[:3, 3]
        moved = self.source @ rotation.T + translation
        back = (self.target - translation) @ rotation
        return self.trees[1].query(moved)[0], self.trees[0].query(back)[0]


def calibrated(agreement: float, support: float | None) -> float:
    """The chance that a registration is right, as `shipping.calibrate` found it.

    Args:
        agreement: of the two clouds.
        support: of the matches; None for a model that has none.
    """
    logit = calibration()["agreement" if support is None else "both"]
    values = np.array([agreement, 1.0] if support is None else [agreement, support, 1.0])
    return float(1 / (1 + np.exp(-np.dot(logit, values))))


@functools.cache
def calibration() -> dict[str, list[float]]:
    """Coefficients of the logit over agreement, support and one; and over agreement and one."""
    return json.loads(shipped_about()["calibration"])


def _learned(model: str) -> Learned:
    """A model, kept in memory for as long as its file stays the same."""
    path = Path(model)
    known = path.stat() if path.is_file() else None
    return _loaded(model, known and (str(path.resolve()), known.st_mtime_ns, known.st_size))


@functools.lru_cache(maxsize=4)
def _loaded(model: str, file: tuple[str, int, int] | None) -> Learned:
    return Learned(load_model(model))


def text(found: Registration) -> str:
    """A registration for people."""
    rows = ["  ".join(f"{value: .12g}".rjust(20) for value in row) for row in found.transform]
    x, y, z = found.transform[:3, 3]
    lines = [
        "matrix (target = matrix @ source):",
        *rows,
        f"rotation     {found.rotation_deg:.3f} deg",
        f"translation  {x:.6g} {y:.6g} {z:.6g}",
        f"overlap      {found.overlap:.1%} of the source has a target point near",
        f"RMSE         {found.rmse:.6g} of those",
    ]
    if len(found.matches):
        agree, matches = found.match_agrees.sum(), len(found.matches)
        lines.append(f"matches      {agree} of {matches} agree with the motion")
    lines += [f"confidence   {found.confidence:.0%}", f"verdict      {found.verdict}"]
    return "\n".join([*lines, f"({found.model}, seed {found.seed}, {found.seconds:.2f} s)"])


def json_text(found: Registration) -> str:
    """A registration for programs."""
    names = ("confidence", "rmse", "overlap", "verdict", "model", "seed", "seconds")
    values = {name: getattr(found, name) for name in names}
    if not np.isfinite(found.rmse):
        values["rmse"] = None
    return json.dumps({"transform": found.transform.tolist(), **values}, indent=1) + "\n"


def _in_own_units(
    transform: np.ndarray, scale: float, centre_x: np.ndarray, centre_y: np.ndarray
) -> np.ndarray:
    """From centred, scaled clouds back to where the user has them."""
    found = transform.copy()
    found[:3, 3] = centre_y + transform[:3, 3] / scale - transform[:3, :3] @ centre_x
    return found


def _verdict(confidence: float, overlap: float) -> str:
    if confidence >= TRUST:
        return "aligned"
    return f"doubtful: {overlap:.0%} of the source lies on the target"
