"""Baselines that need no training: a learned network must beat them.

The classical pipelines are Open3D's, over FPFH features (Rusu et al., ICRA 2009). Their lengths are
in units in which a cloud's radius is about one.
"""

import contextlib
import importlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from corrmat.errors import CorrmatError
from corrmat.ops import rigid
from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.types import Prediction

_NEEDS_EXTRA = "needs the extra baselines: pip install -e '.[baselines]' in corrmat's folder"


class Identity(nn.Module):
    """Identity baseline: the error that a method must beat."""

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Predict the identity pose for source (B, N, 3 or more); no correspondence."""
        return Prediction(*rigid.identity(source))


class Radius(nn.Module):
    """Matches points by their distance from the origin alone.

    A rotation about the origin does not change that distance. So without a translation and with
    identical points, this baseline is right up to ties and rounding, knowing nothing of shape.
    """

    SHARPNESS = 1e12  # makes the softmax an argmax, for radii 1e-5 apart

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3].double(), target[..., :3].double()
        r_x, r_y = x.norm(dim=-1, keepdim=True), y.norm(dim=-1, keepdim=True)
        # -(r_x - r_y)^2 as a dot product, up to terms that are constant along a row.
        f_x = (r_x - r_y.mean(1, keepdim=True)) * 2
        f_y = r_y - r_y.mean(1, keepdim=True)
        with_one = nn.functional.pad(f_x, (0, 1), value=1.0)
        with_square = nn.functional.pad(f_y, (0, 1)) - nn.functional.pad(f_y.square(), (1, 0))
        c = SoftCorrespondence(with_one, with_square, self.SHARPNESS)
        rotation, translation = rigid.procrustes(x, c.soft_target(y))
        return Prediction(rotation.to(source.dtype), translation.to(source.dtype), c)


class Ransac(nn.Module):
    """RANSAC over FPFH features, refined by ICP: what a practitioner would try first.

    It gets the normals of the pairs, which are the mesh's own.
    """

    SEED = 0

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 6) to target (B, M, 6), xyz and unit normal; no correspondence."""
        clouds = zip(source.double().cpu().numpy(), target.double().cpu().numpy(), strict=True)
        rows = [fpfh_ransac(x, y, [self.SEED], refine=True) for x, y in clouds]
        # Open3D's last bits depend on where its arrays lie in memory.
        transform = torch.from_numpy(np.concatenate(rows).round(8)).to(source)
        return Prediction(transform[:, :3, :3], transform[:, :3, 3])


class FpfhSettings(NamedTuple):
    """Lengths and counts of the pipelines over FPFH features."""

    feature_radius: float
    inlier_threshold: float
    mutual: bool = True  # RANSAC only: keep matches that are each other's best
    feature_neighbors: int = 100
    iterations: int = 100_000


# The best settings that benchmarks/tune_classical.py tries on validation pairs.
FPFH_RANSAC = FpfhSettings(feature_radius=0.65, inlier_threshold=0.12)
FPFH_FGR = FpfhSettings(feature_radius=0.65, inlier_threshold=0.05)


def fpfh_ransac(
    source: np.ndarray,
    target: np.ndarray,
    seeds: Sequence[int],
    settings: FpfhSettings = FPFH_RANSAC,
    *,
    refine: bool = False,
) -> np.ndarray:
    """Run RANSAC over matches of FPFH features.

    Args:
        source: (N, 6), xyz and unit normal.
        target: (M, 6).
        seeds: of the draws; one run each.
        settings: lengths and counts.
        refine: run point-to-point ICP after it.

    Returns:
        The transforms (T, 4, 4) of source onto target, one a seed.

    Raises:
        CorrmatError: Open3D cannot be imported.
    """
    o3d, clouds, features = _fpfh(source, target, settings)
    registration = o3d.pipelines.registration
    point_to_point = registration.TransformationEstimationPointToPoint(False)
    checks = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        registration.CorrespondenceCheckerBasedOnDistance(settings.inlier_threshold),
    ]
    criteria = registration.RANSACConvergenceCriteria(settings.iterations, 0.999)
    transforms = []
    for seed in seeds:
        with _repeatable(o3d, seed):
            result = registration.registration_ransac_based_on_feature_matching(
                *clouds, *features, settings.mutual, settings.inlier_threshold, point_to_point, 3,
                checks, criteria,
            )  # fmt: skip
            if refine:
                result = registration.registration_icp(
                    *clouds, settings.inlier_threshold, result.transformation, point_to_point
                )
        transforms.append(np.array(result.transformation))
    return np.stack(transforms)


def fpfh_fgr(
    source: np.ndarray, target: np.ndarray, seed: int, settings: FpfhSettings = FPFH_FGR
) -> np.ndarray:
    """Run Fast Global Registration (Zhou et al., ECCV 2016); see `fpfh_ransac`."""
    o3d, clouds, features = _fpfh(source, target, settings)
    registration = o3d.pipelines.registration
    option = registration.FastGlobalRegistrationOption(
        maximum_correspondence_distance=settings.inlier_threshold
    )
    with _repeatable(o3d, seed):
        result = registration.registration_fgr_based_on_feature_matching(*clouds, *features, option)
    return np.array(result.transformation)


@contextlib.contextmanager
def _repeatable(o3d: Any, seed: int) -> Iterator[None]:  # noqa: ANN401
    """Seed Open3D and keep it to one thread: on several, RANSAC is not the same twice.

    Its warnings, of few matches for example, would stand between the lines of a result.
    """
    o3d.utility.random.seed(seed % 2**31)
    threadpoolctl: Any = importlib.import_module("threadpoolctl")
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with quiet, threadpoolctl.threadpool_limits(1):
        yield


class KissSettings(NamedTuple):
    """Lengths of KISS-Matcher, which derives all of its radii and bounds from one."""

    voxel_size: float


KISS = KissSettings(voxel_size=0.17)


def kiss_matcher(
    source: np.ndarray,
    target: np.ndarray,
    settings: KissSettings = KISS,
    *,
    voxel_sampling: bool = False,
) -> np.ndarray:
    """Run KISS-Matcher (Lim et al., ICRA 2025), on all points or on its own voxel grid.

    See `fpfh_ransac`. It estimates its own normals and draws nothing at random.
    """
    try:
        package: Any = importlib.import_module("kiss_matcher")
    except ImportError as error:
        raise CorrmatError(f"KISS-Matcher {_NEEDS_EXTRA} ({error})") from error
    config = package.KISSMatcherConfig(
        voxel_size=settings.voxel_size, use_voxel_sampling=voxel_sampling
    )
    clouds = (list(points[:, :3].astype(np.float32)) for points in (source, target))
    solution = package.KISSMatcher(config).estimate(*clouds)
    return rigid.to_homogeneous(solution.rotation, np.ravel(solution.translation))


def _open3d() -> Any:  # noqa: ANN401
    """Import Open3D, which not everybody has, and what keeps it to one thread."""
    try:
        importlib.import_module("threadpoolctl")
        return importlib.import_module("open3d")
    except ImportError as error:
        raise CorrmatError(f"Open3D, for ransac and fgr, {_NEEDS_EXTRA} ({error})") from error


def _fpfh(
    source: np.ndarray, target: np.ndarray, settings: FpfhSettings
) -> tuple[Any, list[Any], list[Any]]:
    """Compute Open3D's clouds and FPFH features; return them behind the open3d module."""
    o3d = _open3d()
    clouds, features = [], []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[:, :3].astype(float)))
        cloud.normals = o3d.utility.Vector3dVector(points[:, 3:].astype(float))
        search = o3d.geometry.KDTreeSearchParamHybrid(
            settings.feature_radius, settings.feature_neighbors
        )
        clouds.append(cloud)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, search))
    return o3d, clouds, features


BASELINES: dict[str, type[nn.Module]] = {
    "identity": Identity, "radius": Radius, "ransac": Ransac,
}  # fmt: skip
UNTRAINED = "untrained"  # the baseline that is the arms' own network before training
OPTIONAL = {"ransac": ("open3d", "threadpoolctl")}  # packages of the extra `baselines`


def is_available(name: str) -> bool:
    """Tell whether the packages that a baseline needs can be imported."""
    try:
        for package in OPTIONAL.get(name, ()):
            importlib.import_module(package)
    except ImportError:
        return False
    return True
