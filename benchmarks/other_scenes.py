"""`corrmat register` on scenes that it was not made for: terrain, and rooms without right angles.

    python benchmarks/other_scenes.py          some minutes

Two tiles of a hilly terrain share a half, or four fifths. Pairs of the protocol *rooms* are
sheared, so that their walls meet at other angles than right ones. The record is
results/register/other_scenes.json.
"""

import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from poses import count_verdicts, pose_error
from scipy.spatial.transform import Rotation

from corrmat.data.scan_pairs import make_room_pair
from corrmat.files import replace_json
from corrmat.metrics import RECALL_DEG
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration.register import register
from corrmat.reporting.comparisons import OTHER_SCENES, OtherScenesRow
from corrmat.revision import commit

RESULTS = Path(__file__).resolve().parents[1] / "results"
PAIRS, POINTS = 24, 20_000
WAVES, ROUGHNESS, RELIEF = 60, 1.2, 0.12  # of a terrain; its height in lengths of a tile
NOISE = 0.001  # lengths of a tile
SHIFT = 0.1  # of a source's mean distance from its centroid: farther off is wrong


class Pair(NamedTuple):
    """Two clouds, and the transform (4, 4) of the source onto the target."""

    source: np.ndarray
    target: np.ndarray
    truth: np.ndarray


def terrain(index: int, share: float) -> Pair:
    """Make two square tiles (POINTS, 3) of a terrain that share a part of each."""
    rng = np.random.default_rng(index)
    angles, phases = rng.uniform(0, 2 * np.pi, (2, WAVES))
    frequencies = np.exp(rng.uniform(np.log(0.5), np.log(12), WAVES))
    waves = 2 * np.pi * frequencies * [np.cos(angles), np.sin(angles)]
    amplitudes = frequencies**-ROUGHNESS
    amplitudes *= RELIEF / np.linalg.norm(amplitudes)
    clouds = []
    for start in (0.0, 1 - share):
        ground = rng.uniform(0, 1, (POINTS, 2)) + [start, 0]
        height = np.cos(ground @ waves + phases) @ amplitudes
        cloud = np.column_stack([ground, height])
        clouds.append(cloud + NOISE * rng.normal(size=cloud.shape))
    return turned(Pair(*clouds, np.eye(4)), rng)


def sheared_room(index: int, shear: float) -> Pair:
    """Make two fragments of a room whose walls lean, by a shear of all its points."""
    room = make_room_pair(index, POINTS, "val")
    aligned = room.source @ room.rotation.T + room.translation
    lean = np.eye(3) + shear * np.eye(3)[[1, 2, 0]]
    return turned(Pair(aligned @ lean, room.target @ lean, np.eye(4)), np.random.default_rng(index))


def turned(pair: Pair, rng: np.random.Generator) -> Pair:
    """Put the source of an aligned pair into a random pose."""
    pose = rigid.to_homogeneous(Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3))
    return Pair(rigid.move(pose, pair.source), pair.target, np.linalg.inv(pose))


def measure(name: str, pairs: Iterator[Pair]) -> OtherScenesRow:
    """Register pairs, and count the right ones and the verdicts."""
    right, angles, registrations = 0, [], []
    for pair in track(pairs, name, PAIRS):
        registrations.append(register(pair.source, pair.target))
        angle, shift = pose_error(registrations[-1].transform, pair.truth, pair.source)
        radius = np.linalg.norm(pair.source - pair.source.mean(0), axis=1).mean()
        right += int(angle < RECALL_DEG and shift < SHIFT * radius)
        angles.append(angle)
    return {
        "scenes": name,
        "registrations": PAIRS,
        "right": right,
        "median_deg": round(statistics.median(angles), 3),
        "verdicts": count_verdicts(registrations),
    }


def main() -> None:
    """Measure all kinds of scenes and write the record."""
    code = commit()
    rows = [
        measure(f"terrain, {share:.0%} shared", (terrain(index, share) for index in range(PAIRS)))
        for share in (0.5, 0.8)
    ] + [
        measure(
            f"rooms, sheared by {shear:.0%}",
            (sheared_room(index, shear) for index in range(PAIRS)),
        )
        for shear in (0.1, 0.3)
    ]
    replace_json(RESULTS / OTHER_SCENES, {"commit": code, "rows": rows})
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
