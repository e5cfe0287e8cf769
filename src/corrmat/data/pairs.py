"""A clean cloud becomes a pair of clouds with its ground truth (paper section 5).

Randomness and geometry are separate. `_draw` draws everything random about one pair from
generators keyed by (seed, stream, epoch, index) and purpose. So a pair does not depend on the
batch, worker or machine that makes it, and switching one corruption on does not change another.
All geometry is computed for a whole batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from corrmat.data.clouds import CloudSet
from corrmat.data.normals import estimate_normals
from corrmat.data.visibility import depth_noise, visible_points
from corrmat.errors import CorrmatError, check_choices
from corrmat.ops import rigid
from corrmat.types import MATCH_DISTANCE, PairBatch

Sampling = Literal["identical", "independent", "disjoint"]
Split = Literal["train", "val", "test"]
STREAM: dict[Split, int] = {"train": 0, "val": 1, "test": 2}


@dataclass(frozen=True)
class PairSettings:
    """How pairs are drawn.

    Args:
        num_points: N, points taken of the clean cloud for each of source and target.
        rotation_deg: the angle is uniform in [-rotation_deg, rotation_deg], about an axis
            uniform on the sphere (so 180 is not Haar measure).
        min_rotation_deg: smallest absolute angle (tables 1 and 2).
        translation: uniform in [-translation, translation]^3; clouds have radius 1.
        keep: share of the points kept by a crop with a plane.
        sampling: "identical": both clouds are the same points; "independent": two draws
            that may share points; "disjoint": two draws that share none.
        jitter: standard deviation of Gaussian noise on every coordinate of both clouds.
        outliers: share of points replaced by uniform points of a unit cube.
        outlier_distance: if points may have no match, a source point farther than this from
            every target point is labelled an outlier. None for 0.05 with identical sampling,
            where inliers lie at 0, and else `types.MATCH_DISTANCE`.
        corrupted: which clouds are cropped and get outliers. With "both", a source point whose
            surface the target lacks is labelled an outlier too.
        views: share of the pairs whose clouds are what a depth camera sees, each from its own
            viewpoint, instead of crops with a plane: without what is hidden, and with noise along
            the camera's rays. Needs disjoint sampling, and both clouds corrupted.
        view_deg: largest angle between the two viewpoints of such a pair.
        normals: "given" with the clean cloud, or "estimated" from each corrupted one.
        stretch: augmentation of training shapes: every axis is scaled by a factor between
            1 / stretch and stretch, and half of the shapes are mirrored. 1 switches it off;
            otherwise normals must be estimated.
    """

    num_points: int = 512
    rotation_deg: float = 180.0
    min_rotation_deg: float = 0.0
    translation: float = 0.5
    keep: float = 1.0
    sampling: Sampling = "identical"
    jitter: float = 0.0
    outliers: float = 0.0
    outlier_distance: float | None = None
    corrupted: Literal["source", "both"] = "source"
    views: float = 0.0
    view_deg: float = 60.0
    normals: Literal["given", "estimated"] = "given"
    stretch: float = 1.0

    def __post_init__(self) -> None:
        check_choices(self)
        checks = {
            "num_points": self.num_points >= 3,
            "rotation_deg": 0 <= self.rotation_deg <= 180,
            "min_rotation_deg": 0 <= self.min_rotation_deg <= self.rotation_deg,
            "translation": self.translation >= 0,
            "keep": 0 < self.keep <= 1,
            "jitter": self.jitter >= 0,
            "outliers": 0 <= self.outliers < 1,
            "outlier_distance": self.outlier_distance is None or self.outlier_distance > 0,
            "views": self.views == 0
            or (0 < self.views <= 1 and (self.sampling, self.corrupted) == ("disjoint", "both")),
            "view_deg": 0 <= self.view_deg <= 180,
            "stretch": self.stretch == 1 or (self.stretch > 1 and self.normals == "estimated"),
        }
        for name, valid in checks.items():
            if not valid:
                raise CorrmatError(f"{name} = {getattr(self, name)} is out of range")
        if self.num_source < 3:
            raise CorrmatError(
                f"num_points = {self.num_points}, of which keep = {self.keep} leaves "
                f"{self.num_source}: a rotation needs at least 3"
            )

    @property
    def num_source(self) -> int:
        """Points of the source after the crop: round(keep * N)."""
        return round(self.keep * self.num_points)

    @property
    def min_cloud_points(self) -> int:
        """Points that a clean cloud must have."""
        return (2 if self.sampling == "disjoint" else 1) * self.num_points

    @property
    def has_outliers(self) -> bool:
        """Whether a source point may have no match."""
        return bool(self.outliers) or self.corrupted == "both"

    @property
    def max_match_distance(self) -> float:
        """Distance beyond which a source point has no match; infinite if every point has one."""
        if not self.has_outliers:
            return np.inf
        if self.outlier_distance is not None:
            return self.outlier_distance
        return 0.05 if self.sampling == "identical" else MATCH_DISTANCE


class Key(NamedTuple):
    """Key of a pair: its randomness is a pure function of (seed, stream, epoch, index)."""

    seed: int
    stream: int
    epoch: int
    index: int


class Purpose(IntEnum):
    """What random numbers are drawn for; each purpose has its own stream."""

    GEOMETRY = 0  # transform, crop plane of the source, sampling
    OUTLIERS = 1
    JITTER = 2
    TARGET_CROP = 3
    TARGET_OUTLIERS = 4
    STRETCH = 5
    VIEWS = 6
    SHAPE = 7  # where every epoch has new shapes


class _CloudDraw(NamedTuple):
    """Everything random about one of a pair's clouds; empty where the settings ask for nothing."""

    index: np.ndarray  # (N,) points of the clean cloud
    plane: np.ndarray  # (3,) Gaussian: direction of the crop plane
    replaced: np.ndarray  # (round(outliers * n),) points after the crop
    outliers: np.ndarray  # (..., 6) the points that replace them
    noise: np.ndarray  # (n or N, 3) Gaussian
    camera: np.ndarray  # (3,) in the source's frame
    visible: np.ndarray  # (P / 2,) points of the clean cloud that the camera may see


class _Draw(NamedTuple):
    """Everything random about a pair."""

    source: _CloudDraw
    target: _CloudDraw
    axis: np.ndarray  # (3,) Gaussian: direction of the rotation axis
    uniform: np.ndarray  # (5,) in [0, 1): angle, its sign, translation
    stretch: np.ndarray  # (4,) in [0, 1): factors of the axes, mirror; or empty


_NOTHING = np.empty(0, np.float32)


def make_pairs(
    clouds: CloudSet, shapes: Sequence[int], keys: Sequence[Key], settings: PairSettings
) -> PairBatch:
    """Draw one pair of each shape.

    Args:
        clouds: the clean clouds.
        shapes: B positions in `clouds`.
        keys: B keys.
        settings: how pairs are drawn.

    Returns:
        B pairs; source and target carry normals behind the coordinates.
    """
    draws = [_draw(settings, clouds.num_points, key) for key in keys]
    sides = [draw.source for draw in draws], [draw.target for draw in draws]
    clean = clouds.rows[np.asarray(shapes)]
    if settings.stretch > 1:
        clean = _stretch(clean, _stack(draws, "stretch"), settings.stretch)
    (source, source_index), (target, target_index) = (
        _sample(clean, side, settings) for side in sides
    )
    if settings.sampling == "identical" and not settings.has_outliers:
        match = _same_points(source_index, target_index, clouds.num_points)
    else:
        match = _nearest(source[..., :3], target[..., :3], settings.max_match_distance)
    for cloud, side in zip((source, target), sides, strict=True):
        if settings.jitter:
            _add_noise(cloud, side, settings.jitter)
        if settings.normals == "estimated":
            for rows in cloud:
                rows[:, 3:] = estimate_normals(rows[:, :3])

    axis, uniform = _stack(draws, "axis"), _stack(draws, "uniform")
    rotation, translation = _transform(axis, uniform, settings)
    # Points and normals rotate alike: one product over (B, 2N, 3); only points are translated.
    moved = torch.from_numpy(target).view(len(draws), -1, 3) @ rotation.mT
    moved = moved.view(target.shape)
    moved[..., :3] += translation.unsqueeze(1)
    return PairBatch(
        source=torch.from_numpy(source),
        target=moved,
        rotation=rotation,
        translation=translation,
        match=torch.from_numpy(match),
        clean=torch.from_numpy(clean)[..., :3],
        shape=torch.as_tensor(shapes, dtype=torch.int64),
    )


def generator(key: Key, purpose: int = Purpose.GEOMETRY) -> np.random.Generator:
    """Return the random generator of a key and purpose: counter-based, equal on every machine."""
    seed = np.array((key.seed, key.stream << 32 | key.epoch), np.uint64)
    counter = np.array((0, 0, purpose, key.index), np.uint64)
    return np.random.Generator(np.random.Philox(key=seed, counter=counter))


def _draw(settings: PairSettings, size: int, key: Key) -> _Draw:
    """Draw what the settings ask for, each purpose from its own stream."""
    rng = generator(key)
    n, both = settings.num_points, settings.corrupted == "both"
    (axis, plane), uniform = rng.standard_normal((2, 3)), rng.random(5)
    source = rng.choice(size, n, replace=False)
    if settings.sampling == "identical":
        target = rng.permutation(source)
    elif settings.sampling == "independent":
        target = rng.choice(size, n, replace=False)
    else:
        rest = np.setdiff1d(np.arange(size), source, assume_unique=True)
        target = rng.choice(rest, n, replace=False)
    nothing = _NOTHING, _NOTHING  # of source and target
    planes = plane, generator(key, Purpose.TARGET_CROP).standard_normal(3) if both else _NOTHING
    outliers = [
        _draw_outliers(key, purpose, settings) if settings.outliers and corrupted else nothing
        for purpose, corrupted in ((Purpose.OUTLIERS, True), (Purpose.TARGET_OUTLIERS, both))
    ]
    noises = cameras = halves = nothing
    if settings.jitter:
        shape = settings.num_source + n, 3
        noise = generator(key, Purpose.JITTER).standard_normal(shape, np.float32)
        noises = np.split(noise, [settings.num_source])
    if settings.views:
        rng = generator(key, Purpose.VIEWS)
        if rng.random() < settings.views:
            cameras = _draw_cameras(rng, settings.view_deg)
            halves = np.array_split(rng.permutation(size), 2)
    stretch = generator(key, Purpose.STRETCH).random(4) if settings.stretch > 1 else _NOTHING
    of_source, of_target = (
        _CloudDraw(index, plane, replaced, rows, noise, camera, half)
        for index, plane, (replaced, rows), noise, camera, half in zip(
            (source, target), planes, outliers, noises, cameras, halves, strict=True
        )
    )
    return _Draw(of_source, of_target, axis, uniform, stretch)


def _draw_cameras(rng: np.random.Generator, view_deg: float) -> np.ndarray:
    """Draw two cameras (2, 3), two and a half to four radii from the centre."""
    toward, side = rng.standard_normal((2, 3))
    toward /= np.linalg.norm(toward)
    side -= (side @ toward) * toward
    side /= np.linalg.norm(side)
    angle, *distances = rng.random(3)
    angle = np.deg2rad(view_deg) * angle
    directions = np.stack([toward, np.cos(angle) * toward + np.sin(angle) * side])
    return directions * (2.5 + 1.5 * np.array(distances))[:, None]


def _draw_outliers(
    key: Key, purpose: Purpose, settings: PairSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Draw which points are replaced, and the points and normals that replace them."""
    rng, n = generator(key, purpose), settings.num_source
    replaced = rng.choice(n, round(settings.outliers * n), replace=False)
    rows = rng.random((len(replaced), 6), np.float32) - np.float32(0.5)
    rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return replaced, rows


def _transform(
    axis: np.ndarray, uniform: np.ndarray, settings: PairSettings
) -> tuple[Tensor, Tensor]:
    """Compute the true transforms: rotation (B, 3, 3) and translation (B, 3), float32."""
    low, high = settings.min_rotation_deg, settings.rotation_deg
    angle = low + (high - low) * uniform[:, 0]
    angle = np.deg2rad(np.where(uniform[:, 1] < 0.5, angle, -angle))
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    rotation = rigid.axis_angle_to_matrix(torch.from_numpy(axis), torch.from_numpy(angle))
    translation = settings.translation * (2 * uniform[:, 2:] - 1)
    return rotation.float(), torch.from_numpy(translation).float()


def _sample(
    clean: np.ndarray, draws: Sequence[_CloudDraw], settings: PairSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Sample clouds (B, n, 6) of clean ones, crop or view them, and replace points by outliers.

    Returns:
        The clouds, and which points of the clean ones they have, (B, n), unless they are views or
        have outliers.
    """
    index = _stack(draws, "index")
    clouds = np.take_along_axis(clean, index[..., None], 1)
    if len(draws[0].plane) and settings.num_source < settings.num_points:
        kept = _crop(clouds[..., :3], _stack(draws, "plane"), settings.num_source)
        clouds = np.take_along_axis(clouds, kept[..., None], 1)
        index = np.take_along_axis(index, kept, 1)
    if settings.views:
        for cloud, shape, draw in zip(clouds, clean, draws, strict=True):
            if len(draw.camera):
                cloud[:] = _seen(shape, draw.visible, draw.camera, len(cloud))
    if len(draws[0].replaced):
        batch = np.arange(len(draws))[:, None]
        clouds[batch, _stack(draws, "replaced")] = _stack(draws, "outliers")
    return clouds, index


def _add_noise(clouds: np.ndarray, draws: Sequence[_CloudDraw], jitter: float) -> None:
    """Add noise to the points of clouds (B, n, 6): of every coordinate, or along a camera's ray."""
    offsets = jitter * _stack(draws, "noise")[:, : clouds.shape[1]]
    for cloud, offset, draw in zip(clouds, offsets, draws, strict=True):
        noise = depth_noise(cloud[:, :3], draw.camera, offset) if len(draw.camera) else offset
        cloud[:, :3] += noise


def _stretch(rows: np.ndarray, uniform: np.ndarray, most: float) -> np.ndarray:
    """Scale clouds (B, P, 6) along their axes, back into the unit sphere; normals become zero."""
    factor = most ** (2 * uniform[:, :3] - 1)
    factor[:, 0] *= np.where(uniform[:, 3] < 0.5, 1, -1)
    points = rows[..., :3] * factor[:, None]
    points /= np.linalg.norm(points, axis=-1).max(1)[:, None, None]
    return np.concatenate([points, np.zeros_like(points)], -1).astype(np.float32)


def _seen(clean: np.ndarray, half: np.ndarray, camera: np.ndarray, count: int) -> np.ndarray:
    """Return `count` rows of a clean cloud (P, 6) that a camera sees, repeated if it sees fewer.

    All points hide each other; those of one half are returned, so that two views share none.
    """
    visible = np.zeros(len(clean), bool)
    visible[visible_points(clean[:, :3], camera)] = True
    return clean[np.resize(half[visible[half]], count)]


def _crop(points: np.ndarray, plane: np.ndarray, keep: int) -> np.ndarray:
    """Select the indices (B, keep), ascending, of the points lowest along the plane's normal."""
    centred = points - points.mean(1, keepdims=True)
    height = (centred @ plane[..., None].astype(points.dtype))[..., 0]
    return np.sort(np.argsort(height, 1, kind="stable")[:, :keep], 1)


def _same_points(source: np.ndarray, target: np.ndarray, size: int) -> np.ndarray:
    """Find the target index of each source point's own copy, by construction."""
    position = np.empty((len(target), size), np.int64)
    np.put_along_axis(position, target, np.arange(target.shape[1])[None], 1)
    return np.take_along_axis(position, source, 1)


def _nearest(source: np.ndarray, target: np.ndarray, max_distance: float) -> np.ndarray:
    """Find the nearest target point of each source point; M if none is within the distance."""
    index = [
        KDTree(y).query(x, distance_upper_bound=max_distance)[1]
        for x, y in zip(source, target, strict=True)
    ]
    return np.stack(index).astype(np.int64)


def _stack(draws: Sequence[_Draw] | Sequence[_CloudDraw], name: str) -> np.ndarray:
    return np.stack([getattr(draw, name) for draw in draws])
