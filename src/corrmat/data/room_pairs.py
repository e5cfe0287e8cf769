"""Pairs of fragments of procedural rooms, as indoor scans come: in metres, overlapping in part."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from corrmat.data.pairs import STREAM, Split
from corrmat.data.shapes.rooms import room

NOISE_M = 0.005  # standard deviation of every coordinate
OVERLAP = (0.3, 0.7)  # share of the source's area that the target shows too
_SAMPLES_PER_POINT = 8  # samples of the whole room for each point of a fragment


class RoomPair(NamedTuple):
    """Two fragments of a room and their truth."""

    source: np.ndarray  # (N, 3), metres
    target: np.ndarray  # (N, 3)
    rotation: np.ndarray  # (3, 3), takes source onto target
    translation: np.ndarray  # (3,)
    overlap: float  # share of the source that the target shows too


def make_room_pair(index: int, points: int, split: Split) -> RoomPair:
    """Make the fragments of one room: a pure function of index and split.

    Each shows what lies within a radius of a place in the room. They share no point.

    Args:
        index: of the room.
        points: of each fragment.
        split: "test", or "val" to choose settings on.
    """
    key = np.array([7, STREAM[split] << 32 | index], np.uint64)
    rng = np.random.Generator(np.random.Philox(key=key))
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
    pose = Rotation.random(rng=rng).as_matrix()
    shift = rng.uniform(-2, 2, 3)
    # Each fragment lies in the frame of its own scanner.
    frame = Rotation.random(rng=rng).as_matrix()
    return RoomPair(source @ frame.T, target @ pose.T + shift, pose @ frame.T, shift, overlap)
