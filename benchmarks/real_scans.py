"""`corrmat register` on real scans, beside classical pipelines.

    python benchmarks/real_scans.py FOLDER     some minutes; needs pip install -e '.[baselines]'

The scans are not ours and are not part of this repository. FOLDER has three folders, which you
unpack, and rename where they have other names:

- or_pcd: from the wheel or-pcd 0.0.1b7 (`pip download --no-deps or-pcd==0.0.1b7`). Range scans of
  the Armadillo on a turntable, by the Stanford Computer Graphics Laboratory; the files' names give
  its angle.
- small_gicp: small-gicp 1.0.1's source distribution (`pip download --no-deps --no-binary small-gicp
  small-gicp==1.0.1`), unpacked. Two sweeps of a car's LiDAR, with the author's estimate of the
  pose.
- pcl: the sources of PCL 1.15.0 (of its repository, or of a Linux distribution). Two range scans of
  the Stanford bunny, thinned to 400 points; frames of a depth camera that was held by hand, half a
  second apart, which are taken to show no motion; keypoints of two scans of an office. The first
  and the last come with poses, in the sources of PCL's tests.

Every source is put into random poses first, the same for all models. RANSAC and KISS-Matcher get
the whole clouds on voxels of five sizes. For each pair the size that is right most often counts,
which nobody could choose beforehand. The record is results/register/real_scans.json, and beside it
lies a picture of some.
"""

import argparse
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from large_clouds import PIPELINES, VOXELS
from matplotlib.figure import Figure
from poses import count_verdicts, pose_error
from scipy.spatial.transform import Rotation

from corrmat.data.scans import read_scan
from corrmat.files import replace_json
from corrmat.metrics import RECALL_DEG
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration.preparation import prepare_clouds
from corrmat.registration.register import register
from corrmat.reporting.comparisons import OURS, REAL_SCANS, RealScansRow
from corrmat.reporting.figures import BLUE, RED, principal_axes, save
from corrmat.revision import commit

RESULTS = Path(__file__).resolve().parents[1] / "results"
POSES = 5
SHIFT = 0.1  # radii: mean distance that a right transform's points have from their true place
DRAWN = "Armadillo, 60 to 0 deg", "bunny, 400 points", "depth camera", "LiDAR of a car"
DOTS = 4000  # of each cloud in the picture
HALF_WIDTH = 1.2  # radii that a panel shows to each side of the target's centroid
MODELS = "ransac17", "fgr", "icp"  # of `register`; they get at most 1,024 points of a cloud


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
    on_head = "or_pcd/data/ArmadilloOnHeadMultiple_{}.ply"
    return [
        *armadillos,
        Scans(
            "Armadillo on its head, 150 to 240 deg", on_head.format(150), on_head.format(240),
            turned("y", 150 - 240),
        ),
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


def load(scans: Scans, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read source (N, 3), target (M, 3) and truth (4, 4), in radii: KISS-Matcher wants no less."""
    source, target = (read_scan(folder / name) for name in (scans.source, scans.target))
    scale = prepare_clouds(source, target, 0).scale
    truth = None
    if scans.truth is not None:
        truth = rigid.to_homogeneous(scans.truth[:3, :3], scale * scans.truth[:3, 3])
    return scale * source, scale * target, truth


def random_poses() -> np.ndarray:
    """Draw the poses (POSES, 4, 4) of every source."""
    rotations = Rotation.random(POSES, rng=np.random.default_rng(0)).as_matrix()
    return rigid.to_homogeneous(rotations, np.random.default_rng(1).uniform(-2, 2, (POSES, 3)))


def measure(scans: Scans, folder: Path) -> RealScansRow:
    """Register two scans from random poses of the source with every model."""
    source, target, truth = load(scans, folder)
    poses = random_poses()
    moved = [rigid.move(pose, source) for pose in poses]

    ours = [register(cloud, target) for cloud in moved]
    row: RealScansRow = {
        "scans": scans.name,
        "points": [len(source), len(target)],
        "registrations": POSES,
        "right": None,
        "median_deg": None,
        "verdicts": count_verdicts(ours),
        "seconds": round(statistics.median(each.seconds for each in ours), 2),
    }
    if truth is None:
        return row

    def errors(transforms: Iterable[np.ndarray]) -> list[tuple[float, float]]:
        found = zip(transforms, poses, strict=True)
        return [pose_error(transform @ pose, truth, source) for transform, pose in found]

    def count_right(transforms: Iterable[np.ndarray]) -> int:
        return sum(angle < RECALL_DEG and shift < SHIFT for angle, shift in errors(transforms))

    right = {OURS: count_right(each.transform for each in ours)}
    for model in MODELS:
        found = (register(cloud, target, model=model) for cloud in moved)
        right[model] = count_right(each.transform for each in found)
    for name, voxels in VOXELS["dense"].items():
        pipeline = PIPELINES[name]
        right[name] = max(
            count_right(pipeline(cloud, target, voxel)[0] for cloud in moved) for voxel in voxels
        )
    median = statistics.median(angle for angle, _ in errors(each.transform for each in ours))
    return row | {"right": right, "median_deg": round(median, 3)}


def draw(pairs: Sequence[Scans], folder: Path) -> None:
    """Draw pairs from the first pose of the source, centre on centre, and aligned."""
    figure, limits = (
        Figure((2.6 * len(pairs), 5.2), layout="constrained"),
        (-HALF_WIDTH, HALF_WIDTH),
    )
    for column, scans in zip(figure.subplots(2, len(pairs)).T, pairs, strict=True):
        source, target, _ = load(scans, folder)
        source = rigid.move(random_poses()[0], source)
        aligned = register(source, target).apply(source)
        centre, axes = target.mean(0), principal_axes(target)
        source += centre - source.mean(0)
        for panel, cloud, title in zip(
            column, (source, aligned), (scans.name, "aligned"), strict=True
        ):
            for points, colour in ((target, BLUE), (cloud, RED)):
                shown = np.random.default_rng(0).permutation(points)[:DOTS]
                x, _, height = ((shown - centre) @ axes).T
                panel.scatter(x, height, s=0.3, color=colour)
            panel.set(title=title, aspect="equal", xlim=limits, ylim=limits)
            panel.axis("off")
    save(figure, RESULTS / REAL_SCANS.with_suffix(".png"))


def main() -> None:
    """Measure all pairs of scans and write the record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    code = commit()
    pairs = all_scans(folder)
    rows = [measure(scans, folder) for scans in track(pairs, "scans")]
    replace_json(RESULTS / REAL_SCANS, {"commit": code, "rows": rows})
    draw([scans for scans in pairs if scans.name in DRAWN], folder)
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
