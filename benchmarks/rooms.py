"""Fragments of rooms: the shipped weights beside RANSAC and KISS-Matcher, at their own settings.

    python benchmarks/rooms.py        minutes; needs pip install -e '.[baselines]'

FPFH + RANSAC (Open3D) and KISS-Matcher get the whole clouds on a voxel grid. Its size is chosen on
other rooms. All are refined by the same generalised ICP, coarse to fine. The record is
results/register/rooms-procedural-20000.json.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
from rich.progress import track

from corrmat.baselines import FpfhSettings, KissSettings, fpfh_ransac, kiss_matcher
from corrmat.registration import benchmark
from corrmat.registration.scoring import refine_coarse_to_fine, scorers_of_levels
from corrmat.reporting.model_results import ModelResult, write_comparison
from corrmat.revision import commit
from corrmat.types import PairBatch

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register"
POINTS, TEST_ROOMS, TUNING_ROOMS = 20_000, 60, 60
VOXELS_M = {"ransac": (0.08, 0.12, 0.18, 0.27, 0.4), "kiss": (0.035, 0.05, 0.07, 0.1, 0.15)}


def ransac(source: np.ndarray, target: np.ndarray, voxel: float) -> np.ndarray:
    """Run RANSAC over FPFH features of voxelised clouds, with Open3D's customary ratios."""
    clouds = []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        clouds.append(np.hstack([cloud.points, cloud.normals]))
    settings = FpfhSettings(feature_radius=5 * voxel, inlier_threshold=1.5 * voxel)
    return fpfh_ransac(*clouds, [0], settings)[0]


def kiss(source: np.ndarray, target: np.ndarray, voxel: float) -> np.ndarray:
    """Run KISS-Matcher with its defaults."""
    return kiss_matcher(source, target, KissSettings(voxel), voxel_sampling=True)


PIPELINES: dict[str, Callable[[np.ndarray, np.ndarray, float], np.ndarray]] = {
    "ransac": ransac, "kiss": kiss,
}  # fmt: skip


def run(pairs: PairBatch, name: str, voxel: float) -> ModelResult:
    """Register all pairs with one pipeline, refined on all points."""
    outcomes = []
    for index in track(range(len(pairs)), f"{name}, {voxel} m", transient=True):
        source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
        start = time.perf_counter()
        scorers = scorers_of_levels(source, target)
        transform = refine_coarse_to_fine(PIPELINES[name](source, target, voxel), scorers)
        ms = 1e3 * (time.perf_counter() - start)
        angle, adds = benchmark.errors(pairs, index, transform)
        outcomes.append(
            benchmark.Outcome(angle, adds, ms, scorers[-1].alignment(transform).agreement, 1.0)
        )
    return benchmark.summarise(pairs, outcomes)


def main() -> None:
    """Choose the voxels, then compare."""
    code = commit()
    tuning = benchmark.frozen_pairs("rooms", points=POINTS, count=TUNING_ROOMS, split="val")
    tried = {
        name: {voxel: run(tuning, name, voxel).recall_5deg for voxel in voxels}
        for name, voxels in VOXELS_M.items()
    }
    print(tried)
    pairs = benchmark.frozen_pairs("rooms", points=POINTS, count=TEST_ROOMS)
    results = benchmark.compare(pairs, ["corrmat"])
    for name, recalls in tried.items():
        results[name] = run(pairs, name, max(recalls, key=recalls.__getitem__))
    print(benchmark.to_table(results))
    about = {"protocol": "rooms", "data": "procedural", "points": POINTS, "pairs": len(pairs)}
    path = RESULTS / f"rooms-procedural-{POINTS}.json"
    write_comparison(path, results, about | {"commit": code, "tuning": tried})


if __name__ == "__main__":
    main()
