"""A clean cloud becomes a pair of clouds with its truth (paper section 5).

Chance and geometry are kept apart. Everything random about one pair is drawn by `draw`
from a generator keyed by (seed, stream, epoch, index), so a pair does not depend on the
batch, worker or machine that makes it; everything geometric is done for a whole batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from corrmat.data.clouds import CloudSet
from corrmat.data.normals import estimate
from corrmat.errors import CorrmatError
from corrmat.ops import rigid
from corrmat.types import PairBatch

Sampling = Literal["identical", "independent", "disjoint"]
Split = Literal["train", "val", "test"]
STREAM: dict[Split, int] = {"train": 0, "val": 1, "test": 2}


@dataclass(frozen=True)
class PairSettings:
    """How a pair is drawn.

    Args:
        num_points: N, points taken of the clean cloud for each of source and target.
        rotation_deg: the angle is uniform in [-rotation_deg, rotation_deg], about an axis
            uniform on the sphere (so 180 is not Haar measure).
        min_rotation_deg: angles nearer to zero than this are left out (tables 1 and 2).
        translation: uniform in [-translation, translation]^3; clouds have radius 1.
        keep: share of the source's points that stay after a crop by a plane.
        sampling: "identical": both clouds are the same points; "independent": two draws
            that may share points; "disjoint": two draws that share none.
        jitter: standard deviation of Gaussian noise on every coordinate of both clouds.
        outliers: share of source points replaced by uniform points of a unit cube.
        outlier_distance: with outliers, a source point farther than this from every target
            point is labelled an outlier. Inliers of identical sampling lie at 0, and a
            random point of the cube lies nearer than this to a surface only where it
            might as well be a surface point.
        spoilt: which clouds are cropped and get outliers. With "both", a source point whose
            surface the target lacks is labelled an outlier too.
        normals: "given" with the clean cloud, or "estimated" from each spoilt one.
        stretch: every axis of a shape is drawn out by a factor of up to this and at least its
            inverse, and half of the shapes are mirrored: other shapes of the same kind, for
            training. 1 leaves them alone; only with estimated normals.
    """

    num_points: int = 512
    rotation_deg: float = 180.0
    min_rotation_deg: float = 0.0
    translation: float = 0.5
    keep: float = 1.0
    sampling: Sampling = "identical"
    jitter: float = 0.0
    outliers: float = 0.0
    outlier_distance: float = 0.05
    spoilt: Literal["source", "both"] = "source"
    normals: Literal["given", "estimated"] = "given"
    stretch: float = 1.0

    def __post_init__(self) -> None:
        checks = {
            "num_points": self.num_points >= 3,
            "rotation_deg": 0 <= self.rotation_deg <= 180,
            "min_rotation_deg": 0 <= self.min_rotation_deg <= self.rotation_deg,
            "translation": self.translation >= 0,
            "keep": 0 < self.keep <= 1 and round(self.keep * self.num_points) >= 3,
            "jitter": self.jitter >= 0,
            "outliers": 0 <= self.outliers < 1,
            "outlier_distance": self.outlier_distance > 0,
            "stretch": self.stretch == 1 or (self.stretch > 1 and self.normals == "estimated"),
        }
        for name, fine in checks.items():
            if not fine:
                raise CorrmatError(f"{name} = {getattr(self, name)} is out of range")

    @property
    def num_source(self) -> int:
        """Points of the source after the crop: round(keep * N)."""
        return round(self.keep * self.num_points)

    @property
    def unmatched(self) -> bool:
        """Whether a source point may have no match."""
        return bool(self.outliers) or self.spoilt == "both"


class Key(NamedTuple):
    """Names one pair: its chance is a pure function of (seed, stream, epoch, index)."""

    seed: int
    stream: int
    epoch: int
    index: int


_NOTHING = np.empty(0, np.float32)


class _Draw(NamedTuple):
    """Everything random about a pair."""

    source: np.ndarray  # (N,) indices into the clean cloud
    target: np.ndarray  # (N,)
    normal: np.ndarray  # (2, 3) Gaussian: directions of the rotation axis and of the crop plane
    uniform: np.ndarray  # (5,) in [0, 1): angle, its sign, translation
    noise: np.ndarray  # (n + N, 3) Gaussian
    outlier: np.ndarray  # (round(outliers * n),) which source points
    outlier_at: np.ndarray  # (..., 6) what they become
    target_plane: np.ndarray  # (3,) Gaussian: direction of the target's crop plane
    target_outlier: np.ndarray  # as outlier and outlier_at, where both clouds are spoilt
    target_outlier_at: np.ndarray
    stretch: np.ndarray  # (4,) in [0, 1): factors of the axes, mirror


def make_pairs(
    clouds: CloudSet, shapes: Sequence[int], keys: Sequence[Key], how: PairSettings
) -> PairBatch:
    """Draw one pair of each shape.

    Args:
        clouds: the clean clouds.
        shapes: B positions in `clouds`.
        keys: B keys of the pairs' chance.
        how: what a pair is.

    Returns:
        B pairs; source and target carry normals behind the coordinates.
    """
    size = clouds.rows.shape[1]
    draws = [_draw(how, size, key) for key in keys]
    source_index, target_index = _stack(draws, "source"), _stack(draws, "target")
    clean = clouds.rows[list(shapes)]
    if how.stretch > 1:
        clean = _stretched(clean, _stack(draws, "stretch"), how.stretch)
    source = np.take_along_axis(clean, source_index[..., None], 1)
    target = np.take_along_axis(clean, target_index[..., None], 1)

    if how.num_source < how.num_points:
        kept = _crop(source[..., :3], _stack(draws, "normal")[:, 1], how.num_source)
        source = np.take_along_axis(source, kept[..., None], 1)
        source_index = np.take_along_axis(source_index, kept, 1)
        if how.spoilt == "both":
            kept = _crop(target[..., :3], _stack(draws, "target_plane"), how.num_source)
            target = np.take_along_axis(target, kept[..., None], 1)
    if how.outliers:
        batch = np.arange(len(draws))[:, None]
        source[batch, _stack(draws, "outlier")] = _stack(draws, "outlier_at")
        if how.spoilt == "both":
            target[batch, _stack(draws, "target_outlier")] = _stack(draws, "target_outlier_at")
    if how.sampling == "identical" and not how.unmatched:
        match = _same_points(source_index, target_index, size)
    else:
        match = _nearest(source[..., :3], target[..., :3], how)
    if how.jitter:
        noise = how.jitter * _stack(draws, "noise")
        source[..., :3] += noise[:, : how.num_source]
        target[..., :3] += noise[:, how.num_source :][:, : target.shape[1]]
    if how.normals == "estimated":
        for cloud in (*source, *target):
            cloud[:, 3:] = estimate(cloud[:, :3])

    rotation, translation = _motion(_stack(draws, "normal")[:, 0], _stack(draws, "uniform"), how)
    # Points and normals turn alike: (B, 2N, 3) for the product, translation for points only.
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


def generator(key: Key) -> np.random.Generator:
    """The generator of a key: counter-based, the same on every machine."""
    seed = np.array((key.seed, key.stream << 32 | key.epoch), np.uint64)
    counter = np.array((0, 0, 0, key.index), np.uint64)
    return np.random.Generator(np.random.Philox(key=seed, counter=counter))


def _draw(how: PairSettings, size: int, key: Key) -> _Draw:
    """Draw in a fixed order, so that settings that are off do not shift those that are on."""
    rng = generator(key)
    n, kept = how.num_points, how.num_source
    normal, uniform = rng.standard_normal((2, 3)), rng.random(5)
    source = rng.choice(size, n, replace=False)
    if how.sampling == "identical":
        target = rng.permutation(source)
    elif how.sampling == "independent":
        target = rng.choice(size, n, replace=False)
    else:
        left = np.setdiff1d(np.arange(size), source, assume_unique=True)
        target = rng.choice(left, n, replace=False)
    outlier = outlier_at = noise = _NOTHING
    if how.outliers:
        outlier, outlier_at = _outliers(rng, how)
    if how.jitter:
        noise = rng.standard_normal((kept + n, 3), np.float32)
    target_plane = target_outlier = target_outlier_at = _NOTHING
    if how.spoilt == "both":
        target_plane = rng.standard_normal(3)
        target_outlier, target_outlier_at = _outliers(rng, how)
    stretch = rng.random(4) if how.stretch > 1 else _NOTHING
    return _Draw(
        source, target, normal, uniform, noise, outlier, outlier_at,
        target_plane, target_outlier, target_outlier_at, stretch,
    )  # fmt: skip


def _outliers(rng: np.random.Generator, how: PairSettings) -> tuple[np.ndarray, np.ndarray]:
    """Which points are replaced, and the points and normals they become."""
    chosen = rng.choice(how.num_source, round(how.outliers * how.num_source), replace=False)
    at = rng.random((len(chosen), 6), np.float32) - np.float32(0.5)
    at[:, 3:] /= np.linalg.norm(at[:, 3:], axis=1, keepdims=True)
    return chosen, at


def _motion(axis: np.ndarray, uniform: np.ndarray, how: PairSettings) -> tuple[Tensor, Tensor]:
    """The true motions: rotation (B, 3, 3) and translation (B, 3), float32."""
    angle = how.min_rotation_deg + (how.rotation_deg - how.min_rotation_deg) * uniform[:, 0]
    angle = np.deg2rad(np.where(uniform[:, 1] < 0.5, angle, -angle))
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    rotation = rigid.axis_angle_to_matrix(torch.from_numpy(axis), torch.from_numpy(angle))
    translation = how.translation * (2 * uniform[:, 2:] - 1)
    return rotation.float(), torch.from_numpy(translation).float()


def _stretched(rows: np.ndarray, uniform: np.ndarray, most: float) -> np.ndarray:
    """Clouds (B, P, 6) drawn out along their axes, back in the unit sphere; normals are lost."""
    factor = most ** (2 * uniform[:, :3] - 1)
    factor[:, 0] *= np.where(uniform[:, 3] < 0.5, 1, -1)
    points = rows[..., :3] * factor[:, None]
    points /= np.linalg.norm(points, axis=-1).max(1)[:, None, None]
    return np.concatenate([points, np.zeros_like(points)], -1).astype(np.float32)


def _crop(points: np.ndarray, plane: np.ndarray, keep: int) -> np.ndarray:
    """Indices (B, keep), ascending, of the points least far on the plane's positive side."""
    centred = points - points.mean(1, keepdims=True)
    height = (centred @ plane[..., None].astype(points.dtype))[..., 0]
    return np.sort(np.argsort(height, 1, kind="stable")[:, :keep], 1)


def _same_points(source: np.ndarray, target: np.ndarray, size: int) -> np.ndarray:
    """Where each source point's own copy went, by construction."""
    place = np.empty((len(target), size), np.int64)
    np.put_along_axis(place, target, np.arange(target.shape[1])[None], 1)
    return np.take_along_axis(place, source, 1)


def _nearest(source: np.ndarray, target: np.ndarray, how: PairSettings) -> np.ndarray:
    """The nearest target point of each source point; M where outliers may be and none is near."""
    reach = how.outlier_distance if how.unmatched else np.inf
    pairs = zip(source, target, strict=True)
    found = [KDTree(y).query(x, distance_upper_bound=reach)[1] for x, y in pairs]
    return np.stack(found).astype(np.int64)


def _stack(draws: list[_Draw], name: str) -> np.ndarray:
    return np.stack([getattr(draw, name) for draw in draws])
