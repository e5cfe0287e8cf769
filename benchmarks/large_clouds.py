"""Dense scans of objects and of rooms: the shipped weights beside RANSAC and KISS-Matcher.

    python benchmarks/large_clouds.py dense       half an hour; needs pip install -e '.[baselines]'
    python benchmarks/large_clouds.py rooms       a little longer

FPFH + RANSAC (Open3D) and KISS-Matcher get the whole clouds on a voxel grid. Its size is chosen on
other pairs. `phase` is the highest peak of phase correlation between the Manhattan frames, without
any network. All are refined by the same generalised ICP, coarse to fine. The record is
results/register/<protocol>-procedural-20000.json. `choice` in it says, on those other pairs, what
the candidates of large clouds, and the weights of their measures, are worth
(`registration/choice.py`; the weights were chosen on further ones).
"""

import argparse
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest import mock

import numpy as np
import open3d as o3d

from corrmat.baselines import FpfhSettings, KissSettings, fpfh_ransac, kiss_matcher
from corrmat.calibration import Scores
from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG
from corrmat.progress import track
from corrmat.registration import benchmark, choice
from corrmat.registration.choice import (
    CHOICE_WEIGHTS,
    LARGE_CLOUDS,
    CandidateSearch,
    ChoiceWeights,
    Measures,
    choose,
)
from corrmat.registration.hypotheses import NetworkHypotheses
from corrmat.registration.preparation import prepare_clouds
from corrmat.registration.scoring import (
    AlignmentScorer,
    refine_coarse_to_fine,
    scorers_of_levels,
)
from corrmat.reporting.model_results import ModelResult, write_comparison
from corrmat.revision import commit
from corrmat.types import PairBatch
from corrmat.weights import load_model

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register"
POINTS, TEST_PAIRS, OTHER_PAIRS = 20_000, 120, 60
VOXELS = {  # metres, or radii of an object
    "rooms": {
        "ransac": (0.08, 0.12, 0.18, 0.27, 0.4), "kiss": (0.035, 0.05, 0.07, 0.1, 0.15),
    },
    "dense": {
        "ransac": (0.02, 0.03, 0.045, 0.07, 0.1), "kiss": (0.015, 0.02, 0.03, 0.045, 0.07),
    },
}  # fmt: skip
WEIGHTS = {
    "those of small clouds": CHOICE_WEIGHTS,
    "without verification": LARGE_CLOUDS._replace(verification=0.0),
    "without correlation in the score": LARGE_CLOUDS._replace(correlation=0.0),
    "without coherence": LARGE_CLOUDS._replace(coherence=0.0),
    "in use": LARGE_CLOUDS,
}


def refined(transform: np.ndarray, scorers: Sequence[AlignmentScorer]) -> tuple[np.ndarray, float]:
    """Refine a transform on all points; return it and its agreement."""
    transform = refine_coarse_to_fine(transform, scorers)
    return transform, scorers[-1].alignment(transform).agreement


def ransac(source: np.ndarray, target: np.ndarray, voxel: float) -> tuple[np.ndarray, float]:
    """Run RANSAC over FPFH features of voxelised clouds, with Open3D's customary ratios."""
    clouds = []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        clouds.append(np.hstack([cloud.points, cloud.normals]))
    settings = FpfhSettings(feature_radius=5 * voxel, inlier_threshold=1.5 * voxel)
    transform = fpfh_ransac(*clouds, [0], settings)[0]
    return refined(transform, scorers_of_levels(source, target))


def kiss(source: np.ndarray, target: np.ndarray, voxel: float) -> tuple[np.ndarray, float]:
    """Run KISS-Matcher with its defaults."""
    transform = kiss_matcher(source, target, KissSettings(voxel), voxel_sampling=True)
    return refined(transform, scorers_of_levels(source, target))


def phase(source: np.ndarray, target: np.ndarray, voxel: float) -> tuple[np.ndarray, float]:
    """Run phase correlation between the Manhattan frames alone, on a grid of its own."""
    clouds = prepare_clouds(source, target, 0)
    (peak,) = clouds.scorers[1].phase_correlation.peaks(np.empty((0, 3, 3)), 1)
    transform, agreement = refined(peak, clouds.scorers)
    return clouds.to_original_units(transform), agreement


PIPELINES: dict[str, Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, float]]] = {
    "ransac": ransac, "kiss": kiss, "phase": phase,
}  # fmt: skip


def run(pairs: PairBatch, name: str, voxel: float) -> ModelResult:
    """Register all pairs with one pipeline, refined on all points."""
    outcomes = []
    for index in track(range(len(pairs)), f"{name}, {voxel}"):
        source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
        start = time.perf_counter()
        transform, agreement = PIPELINES[name](source, target, voxel)
        ms = 1e3 * (time.perf_counter() - start)
        angle, adds = benchmark.errors(pairs, index, transform)
        outcomes.append(benchmark.Outcome(angle, adds, ms, Scores(agreement, None)))
    return benchmark.summarise(pairs, outcomes)


def choices(pairs: PairBatch) -> dict[str, dict[str, float]]:
    """Compute recall with the weights of `WEIGHTS`, and without candidates of phase correlation."""
    generate = NetworkHypotheses(load_model())
    rows = [choices_of(pairs, index, generate) for index in track(range(len(pairs)), "choice")]
    recalls = {}
    for name in rows[0]:
        angle, adds = np.array([row[name] for row in rows]).T
        within, aligned = np.mean(angle < RECALL_DEG), np.mean(adds < ADDS_THRESHOLD)
        recalls[name] = {"recall_5deg": float(within), "recall_adds": float(aligned)}
    return recalls


def choices_of(
    pairs: PairBatch, index: int, generate: NetworkHypotheses
) -> dict[str, tuple[float, float]]:
    """Return the errors, degrees and ADD-S, of one pair for every choice."""
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    search = CandidateSearch.start(generate, source, target, 0)
    own = search.refine_a_little(search.hypotheses.transforms)
    own_measures = search.measure(own)
    found, measures = search.find(half_turns=True)
    with mock.patch.object(choice, "MANY_KEPT", 0):  # as if there were no such candidates
        fewer, fewer_measures = search.find(half_turns=True)

    def chosen(among: np.ndarray, measured: list[Measures], weights: ChoiceWeights) -> np.ndarray:
        return among[choose(measured, weights, lambda rows: search.verify(among[rows]))]

    @functools.cache
    def errors(transform: bytes) -> tuple[float, float]:
        matrix = np.frombuffer(transform).reshape(4, 4).copy()
        final = search.clouds.to_original_units(search.refine_chosen(matrix))
        return benchmark.errors(pairs, index, final)

    alone = "the network's candidates, no half turns"
    picked = {
        f"those of small clouds, {alone}": chosen(own, own_measures, CHOICE_WEIGHTS),
        f"in use, {alone}": chosen(own, own_measures, LARGE_CLOUDS),
        "in use, without many matches": chosen(fewer, fewer_measures, LARGE_CLOUDS),
    }
    picked |= {name: chosen(found, measures, weights) for name, weights in WEIGHTS.items()}
    return {name: errors(transform.tobytes()) for name, transform in picked.items()}


def main() -> None:
    """Choose the voxels, then compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("protocol", choices=sorted(VOXELS))
    protocol = parser.parse_args().protocol
    code = commit()
    others = benchmark.frozen_pairs(protocol, points=POINTS, count=OTHER_PAIRS, split="val")
    tried = {
        name: {voxel: run(others, name, voxel).recall_5deg for voxel in voxels}
        for name, voxels in VOXELS[protocol].items()
    }
    print(tried)
    pairs = benchmark.frozen_pairs(protocol, points=POINTS, count=TEST_PAIRS)
    results = benchmark.compare(pairs, ["corrmat"])
    for name, recalls in tried.items():
        results[name] = run(pairs, name, max(recalls, key=recalls.__getitem__))
    results["phase"] = run(pairs, "phase", 0.0)
    print(benchmark.to_table(results))
    about = {"protocol": protocol, "data": "procedural", "points": POINTS, "pairs": len(pairs)}
    path = RESULTS / f"{protocol}-procedural-{POINTS}.json"
    more = {"commit": code, "tuning": tried, "choice": choices(others)}
    write_comparison(path, results, about | more)


if __name__ == "__main__":
    main()
