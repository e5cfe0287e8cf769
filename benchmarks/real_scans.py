"""`corrmat register` on real scans, beside classical pipelines.

    python benchmarks/real_scans.py FOLDER     some minutes; needs pip install -e '.[baselines]'

The scans are not ours and are not part of this repository. FOLDER has three folders:

- or_pcd: of the wheel or-pcd 0.0.1b7 (`pip download --no-deps or-pcd==0.0.1b7`). Range scans of the
  Armadillo on a turntable, by the Stanford Computer Graphics Laboratory; the files' names give its
  angle.
- small_gicp: small-gicp 1.0.1's source distribution (`pip download --no-deps --no-binary small-gicp
  small-gicp==1.0.1`), unpacked. Two sweeps of a car's LiDAR, with the author's estimate of the
  pose.
- pcl: the sources of PCL 1.15.0 (its repository, or `apt-get source --download-only pcl`). Two
  range scans of the Stanford bunny, thinned to 400 points; frames of a depth camera that was held
  by hand, a quarter of a second apart, which are taken to show no motion; keypoints of two scans of
  an office. The first and the last come with poses, in the sources of PCL's tests.

Every source is put into random poses first, the same for all models. RANSAC and KISS-Matcher get
the whole clouds on voxels of five sizes. For each pair the size that is right most often counts,
which nobody could choose beforehand. The record is results/register/real_scans.json.
"""

import argparse
import statistics
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from large_clouds import PIPELINES, VOXELS
from scipy.spatial.transform import Rotation

from corrmat.calibration import Verdict, verdict_words
from corrmat.data.scans import read_scan
from corrmat.files import replace_json
from corrmat.metrics import RECALL_DEG
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration.preparation import prepare_clouds
from corrmat.registration.register import register
from corrmat.reporting.comparisons import OURS, REAL_SCANS, RealScansRow
from corrmat.revision import commit

RESULTS = Path(__file__).resolve().parents[1] / "results"
POSES = 5
SHIFT = 0.1  # radii: mean distance that a right transform's points have from their true place
AT_ONCE = "ransac17", "fgr", "icp"  # models of `register`; they get at most 1,024 points a cloud


def turned(axis: str, degrees: float, shift: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return a turn about an axis, and a shift: (4, 4)."""
    rotation = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return rigid.to_homogeneous(rotation, np.array(shift))


class Scans(NamedTuple):
    """Two scans."""

    name: str
    source: str  # a file in the folder
    target: str
    truth: np.ndarray | None  # (4, 4); None where they show nothing in common


def all_scans(folder: Path) -> list[Scans]:
    """List the pairs of scans, those that show nothing in common last."""
    lidar, frames = "small_gicp/data", "pcl/test/grabber_sequences/pcd/frame_20121214T1422"
    back = "or_pcd/data/ArmadilloBack_{}.ply"
    views = (30, 0), (330, 0), (60, 30), (60, 0), (330, 30)
    armadillos = [
        Scans(
            f"Armadillo, {source} to {target} deg",
            back.format(source),
            back.format(target),
            turned("y", source - target),
        )
        for source, target in views
    ]
    return [
        *armadillos,
        Scans(
            "bunny, 400 points", "pcl/test/bun0.pcd", "pcl/test/bun4.pcd",
            turned("y", -34.38, (0.0373, 0.0, 0.0383)),
        ),
        Scans("depth camera", f"{frames}55.814212.pcd", f"{frames}56.332395.pcd", np.eye(4)),
        Scans(
            "LiDAR of a car", f"{lidar}/source.ply", f"{lidar}/target.ply",
            np.loadtxt(folder / lidar / "T_target_source.txt"),
        ),
        Scans(
            "office, keypoints", "pcl/test/office1_keypoints.pcd", "pcl/test/office2_keypoints.pcd",
            turned("z", 134.0, (-3.635, -2.387, 0.778)),
        ),
        Scans("Armadillo, back and front", back.format(180), back.format(0), None),
        Scans("bunny, Armadillo", "pcl/test/bun0.pcd", back.format(0), None),
        Scans("LiDAR, depth camera", f"{lidar}/source.ply", f"{frames}55.814212.pcd", None),
    ]  # fmt: skip


def measure(scans: Scans, folder: Path) -> RealScansRow:
    """Register two scans from random poses of the source with every model."""
    source, target = (read_scan(folder / name) for name in (scans.source, scans.target))
    scale = prepare_clouds(source, target, 0).scale  # KISS-Matcher wants no small voxels
    source, target = scale * source, scale * target
    rotations = Rotation.random(POSES, random_state=0).as_matrix()
    shifts = np.random.default_rng(0).uniform(-2, 2, (POSES, 3))
    poses = rigid.to_homogeneous(rotations, shifts)
    moved = [rigid.move(pose, source) for pose in poses]

    ours = [register(cloud, target) for cloud in moved]
    verdicts = Counter(verdict_words(each.confidence) for each in ours)
    row: RealScansRow = {
        "scans": scans.name,
        "points": [len(source), len(target)],
        "registrations": POSES,
        "right": None,
        "median_deg": None,
        "verdicts": [verdicts[verdict] for verdict in get_args(Verdict)],
        "seconds": round(statistics.median(each.seconds for each in ours), 2),
    }
    if scans.truth is None:
        return row
    truth = scans.truth.copy()
    truth[:3, 3] *= scale

    def degrees(transforms: Iterable[np.ndarray]) -> np.ndarray:
        """Compute the rotation errors (POSES,)."""
        off = np.stack(list(transforms)) @ poses @ np.linalg.inv(truth)
        return np.degrees(Rotation.from_matrix(off[:, :3, :3]).magnitude())

    def count_right(transforms: Iterable[np.ndarray]) -> int:
        transforms = list(transforms)
        true = rigid.move(truth, source)
        shifts = [
            np.linalg.norm(rigid.move(transform, cloud) - true, axis=1).mean()
            for transform, cloud in zip(transforms, moved, strict=True)
        ]
        return int(((np.array(shifts) < SHIFT) & (degrees(transforms) < RECALL_DEG)).sum())

    right = {OURS: count_right(each.transform for each in ours)}
    for model in AT_ONCE:
        found = (register(cloud, target, model=model) for cloud in moved)
        right[model] = count_right(each.transform for each in found)
    for name, voxels in VOXELS["dense"].items():
        pipeline = PIPELINES[name]
        right[name] = max(
            count_right(pipeline(cloud, target, voxel)[0] for cloud in moved) for voxel in voxels
        )
    median = statistics.median(degrees(each.transform for each in ours))
    return row | {"right": right, "median_deg": round(median, 3)}


def main() -> None:
    """Measure all pairs of scans and write the record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    code = commit()
    rows = [measure(scans, folder) for scans in track(all_scans(folder), "scans")]
    replace_json(RESULTS / REAL_SCANS, {"commit": code, "rows": rows})
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
