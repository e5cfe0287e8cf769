"""A clean cloud becomes a pair of clouds with its truth (SPEC: 2, paper section 5).

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
        }
        for name, fine in checks.items():
            if not fine:
                raise CorrmatError(f"{name} = {getattr(self, name)} is out of range")

    @property
    def num_source(self) -> int:
        """Points of the source after the crop: round(keep * N)."""
        return round(self.keep * self.num_points)


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
    source = _gather(clouds, shapes, source_index)
    target = _gather(clouds, shapes, target_index)

    if how.num_source < how.num_points:
        kept = _crop(source[..., :3], _stack(draws, "normal")[:, 1], how.num_source)
        source = np.take_along_axis(source, kept[..., None], 1)
        source_index = np.take_along_axis(source_index, kept, 1)
    if how.outliers:
        batch = np.arange(len(draws))[:, None]
        source[batch, _stack(draws, "outlier")] = _stack(draws, "outlier_at")
    if how.sampling == "identical" and not how.outliers:
        match = _same_points(source_index, target_index, size)
    else:
        match = _nearest(source[..., :3], target[..., :3], how)
    if how.jitter:
        noise = how.jitter * _stack(draws, "noise")
        source[..., :3] += noise[:, : how.num_source]
        target[..., :3] += noise[:, how.num_source :]

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
        clean=torch.from_numpy(clouds.rows[list(shapes)])[..., :3],
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
        outlier = rng.choice(kept, round(how.outliers * kept), replace=False)
        outlier_at = rng.random((len(outlier), 6), np.float32) - np.float32(0.5)
        outlier_at[:, 3:] /= np.linalg.norm(outlier_at[:, 3:], axis=1, keepdims=True)
    if how.jitter:
        noise = rng.standard_normal((kept + n, 3), np.float32)
    return _Draw(source, target, normal, uniform, noise, outlier, outlier_at)


def _motion(axis: np.ndarray, uniform: np.ndarray, how: PairSettings) -> tuple[Tensor, Tensor]:
    """The true motions: rotation (B, 3, 3) and translation (B, 3), float32."""
    angle = how.min_rotation_deg + (how.rotation_deg - how.min_rotation_deg) * uniform[:, 0]
    angle = np.deg2rad(np.where(uniform[:, 1] < 0.5, angle, -angle))
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    rotation = rigid.axis_angle_to_matrix(torch.from_numpy(axis), torch.from_numpy(angle))
    translation = how.translation * (2 * uniform[:, 2:] - 1)
    return rotation.float(), torch.from_numpy(translation).float()


def _gather(clouds: CloudSet, shapes: Sequence[int], index: np.ndarray) -> np.ndarray:
    return np.stack([clouds.rows[s].take(i, axis=0) for s, i in zip(shapes, index, strict=True)])


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
    reach = how.outlier_distance if how.outliers else np.inf
    pairs = zip(source, target, strict=True)
    found = [KDTree(y).query(x, distance_upper_bound=reach)[1] for x, y in pairs]
    return np.stack(found).astype(np.int64)


def _stack(draws: list[_Draw], name: str) -> np.ndarray:
    return np.stack([getattr(draw, name) for draw in draws])
