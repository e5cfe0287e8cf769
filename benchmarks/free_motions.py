"""What `corrmat register` says of a source that may slide or turn, and of one that may not.

    python benchmarks/free_motions.py          some minutes

Two pieces of a wall, an L, a U and a pipe, each two thirds of which the other shows too, fit at any
place along their axis. Two scans of a whole bottle, a cone, a bowl and a vase fit after any turn
about theirs. Held-out pairs of the protocols have one right pose; what is said of them is a false
alarm, unless a shape is such a thing itself. The record is results/register/free_motions.json.
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
from corrmat.reporting.comparisons import FREE_MOTIONS, FreeMotionsRow
from corrmat.revision import commit

RESULTS = Path(__file__).resolve().parents[1] / "results"
NOISE = 0.001, 0.003, 0.01  # of the length
POINTS = 1000, 8000
SEEDS = 4
PAIRS = 60
LENGTH = 3.0
ANGLE_DEG = 10.0  # between the direction that is said and the true one
# Corners of the cross-sections; the wall slides in its plane, the others along their axis.
SECTIONS = {
    "wall": [(-1, 0), (1, 0)],
    "L": [(0, 2), (0, 0), (1.5, 0)],
    "U": [(0, 1), (0, 0), (1.5, 0), (1.5, 0.6)],
    "pipe": [(0.3 * np.cos(a), 0.3 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 65)],
}
# Radii and heights of the outlines of solids of revolution, as shares of their length.
OUTLINES = {
    "bottle": [(0, 0), (0.2, 0), (0.2, 0.6), (0.07, 0.8), (0.07, 1)],
    "cone": [(0, 0), (0.4, 0), (0, 1)],
    "bowl": [(0, 0), (0.35, 0.1), (0.6, 0.4), (0.8, 1)],
    "vase": [(0, 0), (0.2, 0), (0.35, 0.3), (0.12, 0.75), (0.25, 1)],
}


def profile(
    corners: np.ndarray, low: float, count: int, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """Sample a profile between z = `low` and `LENGTH` above it, (count, 3)."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    edge = rng.choice(len(lengths), count, p=lengths / lengths.sum())
    share = rng.random((count, 1))
    section = (1 - share) * corners[edge] + share * corners[edge + 1]
    points = np.column_stack([section, rng.uniform(low, low + LENGTH, count)])
    return points + rng.normal(0, noise * LENGTH, points.shape)


def solid(outline: np.ndarray, count: int, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Sample the surface that an outline sweeps about z, (count, 3)."""
    starts, ends = outline[:-1], outline[1:]
    areas = np.linalg.norm(ends - starts, axis=1) * (starts + ends)[:, 0]
    of = rng.choice(len(areas), 8 * count, p=areas / areas.sum())
    share = rng.random((8 * count, 1))
    radius, height = ((1 - share) * starts[of] + share * ends[of]).T
    widest = np.maximum(starts, ends)[of, 0]
    kept = np.flatnonzero(rng.random(8 * count) < radius / widest)[:count]  # the wider, the more
    angle = rng.uniform(0, 2 * np.pi, count)
    circle = np.stack([np.cos(angle), np.sin(angle)], 1) * radius[kept, None]
    points = LENGTH * np.column_stack([circle, height[kept]])
    return points + rng.normal(0, noise * LENGTH, points.shape)


def is_along(direction: np.ndarray | None, axis: np.ndarray) -> bool:
    """Tell whether a direction (3,) is said, and is that of the axis, of either sign."""
    return direction is not None and bool(abs(direction @ axis) > np.cos(np.deg2rad(ANGLE_DEG)))


def is_across(direction: np.ndarray | None, normal: np.ndarray) -> bool:
    """Tell whether a direction (3,) is said, and lies in the plane of this normal."""
    return direction is not None and bool(abs(direction @ normal) < np.sin(np.deg2rad(ANGLE_DEG)))


def pieces(name: str, count: int, noise: float, seed: int) -> tuple[Registration, bool]:
    """Register two pieces of a profile; tell whether the right direction is said."""
    rng = np.random.default_rng(seed)
    corners = np.array(SECTIONS[name], float)
    source, target = (profile(corners, low, count, noise, rng) for low in (0, LENGTH / 3))
    rotation = Rotation.random(rng=rng).as_matrix()
    result = register(source, target @ rotation.T)
    if name == "wall":
        return result, is_across(result.slides_along, rotation[:, 1])
    return result, is_along(result.slides_along, rotation[:, 2])


def solids(name: str, count: int, noise: float, seed: int) -> tuple[Registration, bool]:
    """Register two scans of a solid of revolution; tell whether the right axis is said."""
    rng = np.random.default_rng(seed)
    source, target = (solid(np.array(OUTLINES[name]), count, noise, rng) for _ in range(2))
    rotation = Rotation.random(rng=rng).as_matrix()
    result = register(source, target @ rotation.T)
    return result, is_along(result.turns_about, rotation[:, 2])


def row(clouds: str, results: list[Registration], right: int | None) -> FreeMotionsRow:
    """Count what was said of some registrations."""
    return FreeMotionsRow(
        clouds=clouds,
        registrations=len(results),
        slides=sum(result.slides_along is not None for result in results),
        turns=sum(result.turns_about is not None for result in results),
        right=right,
        aligned=sum(result.verdict == "aligned" for result in results),
    )


def main() -> None:
    """Register profiles and solids of revolution, then held-out pairs."""
    code, rows = commit(), []
    for kind, make, names in (
        ("profiles", pieces, SECTIONS), ("solids of revolution", solids, OUTLINES)
    ):  # fmt: skip
        for noise in NOISE:
            cases = list(itertools.product(names, POINTS, [noise], range(SEEDS)))
            outcomes = [make(*case) for case in track(cases, f"{kind}, noise {noise}")]
            results, right = zip(*outcomes, strict=True)
            rows.append(row(f"{kind}, noise {noise:.1%} of the length", list(results), sum(right)))
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
    replace_json(RESULTS / FREE_MOTIONS, {"commit": code, "rows": rows})


if __name__ == "__main__":
    main()
