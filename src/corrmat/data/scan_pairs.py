"""Pairs of scans of many points: fragments of procedural rooms, and of single objects."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from corrmat.data.pairs import STREAM, Split
from corrmat.data.shapes.families import FAMILIES
from corrmat.data.shapes.rooms import room
from corrmat.data.shapes.solids import merged
from corrmat.data.visibility import depth_noise, visible_points

NOISE_M = 0.005  # standard deviation of every coordinate; of a single object's radius
OVERLAP = (0.3, 0.7)  # share of the source's area that the target shows too
KEEP = 0.7  # share of a single object's points that a crop by a plane leaves
_CAMERA, _MAX_ANGLE_DEG = 3.0, 60.0  # distance of a camera in radii, and angle between two
_SAMPLES_PER_POINT = 8  # samples of the whole room or object for each point of a scan


class ScanPair(NamedTuple):
    """Two scans, each in the frame of its own scanner, that share no point; and their truth."""

    source: np.ndarray  # (N, 3)
    target: np.ndarray  # (M, 3)
    rotation: np.ndarray  # (3, 3), takes source onto target
    translation: np.ndarray  # (3,)
    overlap: float = np.nan  # share of a room's source that the target shows too


def make_room_pair(index: int, points: int, split: Split) -> ScanPair:
    """Make two fragments of one room, in metres: a pure function of index and split.

    Each shows what lies within a radius of a place in the room.

    Args:
        index: of the room.
        points: of each fragment.
        split: "test", or "val" to choose settings on.
    """
    rng = _generator(7, index, split)
    mesh, size = room(rng)
    samples = trimesh.sample.sample_surface(mesh, _SAMPLES_PER_POINT * points, seed=rng)[0]
    halves = samples[::2], samples[1::2]
    while True:  # until the fragments overlap as they should
        radius = rng.uniform(0.3, 0.5) * np.linalg.norm(size)
        places = rng.uniform(-0.5, 0.5, (2, 2)) * size
        inside = [
            np.linalg.norm(half[:, :2] - place, axis=1) < radius
            for half, place in zip(halves, places, strict=True)
        ]
        shared = np.linalg.norm(halves[0][:, :2] - places[1], axis=1) < radius
        overlap = float(shared[inside[0]].mean()) if inside[0].any() else 0.0
        if OVERLAP[0] < overlap < OVERLAP[1] and min(map(np.sum, inside)) >= points:
            break
    source, target = (
        rng.permutation(half[chosen])[:points] + NOISE_M * rng.standard_normal((points, 3))
        for half, chosen in zip(halves, inside, strict=True)
    )
    return _in_own_frames(source, target, 2.0, rng)._replace(overlap=overlap)


def make_object_pair(index: int, points: int, split: Split) -> ScanPair:
    """Make two dense scans of one object of radius one: a pure function of index and split.

    Of the objects, every other one is cropped by a plane, another for each scan; the rest are what
    two depth cameras see, up to 60 degrees apart.

    Args:
        index: of the object.
        points: of each scan.
        split: "test", or "val" to choose settings on.
    """
    rng = _generator(8, index, split)
    families = list(FAMILIES.values())
    mesh = merged(families[index // 2 % len(families)](rng))
    samples = trimesh.sample.sample_surface(mesh, _SAMPLES_PER_POINT * points, seed=rng)[0]
    samples -= samples.mean(0)
    samples /= np.linalg.norm(samples, axis=1).max()
    halves = samples[::2], samples[1::2]
    make = _cropped if index % 2 else _seen
    source, target = (rng.permutation(scan)[:points] for scan in make(halves, rng))
    return _in_own_frames(source, target, 1.0, rng)


def _cropped(halves: tuple[np.ndarray, ...], rng: np.random.Generator) -> list[np.ndarray]:
    """Cut each half (N, 3) by a plane of its own, and add noise."""
    kept = []
    for half in halves:
        height = half @ rng.standard_normal(3)
        scan = half[height <= np.quantile(height, KEEP)]
        kept.append(scan + NOISE_M * rng.standard_normal(scan.shape))
    return kept


def _seen(halves: tuple[np.ndarray, ...], rng: np.random.Generator) -> list[np.ndarray]:
    """Return what a camera sees of each half (N, 3), with depth noise."""
    camera = Rotation.random(rng=rng).apply([0.0, 0.0, _CAMERA])
    axis = np.cross(camera, rng.standard_normal(3))
    angle = np.radians(rng.uniform(0, _MAX_ANGLE_DEG))
    between = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    seen = []
    for half, place in zip(halves, (camera, between.apply(camera)), strict=True):
        scan = half[visible_points(half, place)]
        seen.append(scan + depth_noise(scan, place, NOISE_M * rng.standard_normal(scan.shape)))
    return seen


def _in_own_frames(
    source: np.ndarray, target: np.ndarray, most: float, rng: np.random.Generator
) -> ScanPair:
    """Move each scan (N, 3) and (M, 3) into a random frame; shift the target by at most `most`."""
    pose = Rotation.random(rng=rng).as_matrix()
    shift = rng.uniform(-most, most, 3)
    frame = Rotation.random(rng=rng).as_matrix()
    return ScanPair(source @ frame.T, target @ pose.T + shift, pose @ frame.T, shift)


def _generator(stream: int, index: int, split: Split) -> np.random.Generator:
    """Return the generator of a pair."""
    key = np.array([stream, STREAM[split] << 32 | index], np.uint64)
    return np.random.Generator(np.random.Philox(key=key))
