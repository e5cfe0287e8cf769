"""How often `corrmat register` says that a source may slide: where it may, and where it may not.

    python benchmarks/sliding.py          some minutes

Two pieces of a wall, an L, a U and a pipe, each two thirds of which the other shows too, fit at any
place along their axis. Held-out pairs of the protocols have one right place; what is said of them
is a false alarm, unless a shape is such a profile itself. The record is
results/register/sliding.json.
"""

import itertools
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from corrmat.files import replace_json
from corrmat.progress import track
from corrmat.registration import benchmark
from corrmat.registration.register import register
from corrmat.registration.result import Registration
from corrmat.reporting.comparisons import SLIDING, SlidingRow
from corrmat.revision import commit

RESULTS = Path(__file__).resolve().parents[1] / "results"
NOISE = 0.001, 0.003, 0.01  # of a profile's length
POINTS = 1000, 8000
SEEDS = 4
PAIRS = 60
LENGTH = 3.0
ANGLE_DEG = 10.0  # between the direction that is said and the axis
# Corners of the cross-sections; the wall slides in its plane, the others along their axis.
SECTIONS = {
    "wall": [(-1, 0), (1, 0)],
    "L": [(0, 2), (0, 0), (1.5, 0)],
    "U": [(0, 1), (0, 0), (1.5, 0), (1.5, 0.6)],
    "pipe": [(0.3 * np.cos(a), 0.3 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 65)],
}


def piece(
    corners: np.ndarray, low: float, count: int, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """Sample a profile between z = `low` and `LENGTH` above it, (count, 3)."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    edge = rng.choice(len(lengths), count, p=lengths / lengths.sum())
    share = rng.random((count, 1))
    section = (1 - share) * corners[edge] + share * corners[edge + 1]
    points = np.column_stack([section, rng.uniform(low, low + LENGTH, count)])
    return points + rng.normal(0, noise * LENGTH, points.shape)


def slides(name: str, count: int, noise: float, seed: int) -> tuple[Registration, bool]:
    """Register two pieces of a profile; tell whether the right direction is said."""
    rng = np.random.default_rng(seed)
    corners = np.array(SECTIONS[name], float)
    source, target = (piece(corners, low, count, noise, rng) for low in (0, LENGTH / 3))
    rotation = Rotation.random(rng=rng).as_matrix()
    result = register(source, target @ rotation.T)
    if result.slides_along is None:
        return result, False
    direction = rotation.T @ result.slides_along
    across = abs(direction[1]) if name == "wall" else np.linalg.norm(direction[:2])
    return result, bool(across < np.sin(np.deg2rad(ANGLE_DEG)))


def row(clouds: str, results: list[Registration], right: int | None) -> SlidingRow:
    """Count what was said of some registrations."""
    said = sum(result.slides_along is not None for result in results)
    aligned = sum(result.verdict == "aligned" for result in results)
    return SlidingRow(
        clouds=clouds, registrations=len(results), slides=said, right=right, aligned=aligned
    )


def main() -> None:
    """Register profiles, then held-out pairs."""
    code, rows = commit(), []
    for noise in NOISE:
        cases = list(itertools.product(SECTIONS, POINTS, [noise], range(SEEDS)))
        outcomes = [slides(*case) for case in track(cases, f"noise {noise}")]
        results, right = zip(*outcomes, strict=True)
        rows.append(row(f"profiles, noise {noise:.1%} of the length", list(results), sum(right)))
        print(rows[-1])
    for protocol, sizes in benchmark.TABLE_POINTS.items():
        pairs = benchmark.frozen_pairs(protocol, points=sizes[0], count=PAIRS, split="val")
        clouds = zip(pairs.source, pairs.target, strict=True)
        found = [
            register(source.double().numpy(), target.double().numpy())
            for source, target in track(list(clouds), protocol)
        ]
        rows.append(row(f"*{protocol}*, {sizes[0]:,} points", found, None))
        print(rows[-1])
    replace_json(RESULTS / SLIDING, {"commit": code, "rows": rows})


if __name__ == "__main__":
    main()
