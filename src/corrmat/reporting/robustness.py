"""Figure 2: the error of a rotation from wrong matches and from a wrong vector (paper section 3).

The paper leaves two things open. The number of points is a setting here. "p % corruption" of a
rotation vector is Gaussian noise of standard deviation p % of pi on each component; of the forms
tried it is nearest to the paper's chart (docs/robustness.md).
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from corrmat.data.pairs import Key, generator
from corrmat.files import replace_json
from corrmat.metrics import rotation_error_deg
from corrmat.ops.rigid import axis_angle_to_matrix, procrustes
from corrmat.reporting.figures import BLUE, RED, save

PERCENT = (1, 5, 10, 15, 20, 25, 30, 40, 50, 60, 70, 80, 90, 95, 99)
SIZES = (64, 512, 1024, 4096)
SHOWN = 1024  # the number of points that the paper's chart agrees with
STREAM = 4  # random stream; smaller numbers are the data's
# Read off the paper's figure 2, in degrees.
PAPER: dict[str, dict[int, float]] = {
    "matches": {50: 3, 70: 5.5, 80: 9, 90: 18, 99: 80},
    "rotation vector": {
        10: 28, 20: 57, 25: 70, 30: 80, 40: 97, 50: 112, 70: 121, 80: 120, 90: 118, 99: 112,
    },
}  # fmt: skip


@dataclass(frozen=True)
class RobustnessCurve:
    """Rotation error against per cent corrupted: mean and quartiles over draws, in degrees."""

    mean: list[float]
    low: list[float]
    high: list[float]


@dataclass(frozen=True)
class Robustness:
    """Content of curve.json."""

    percent: list[int]
    draws: int
    seed: int
    curves: dict[str, RobustnessCurve]
    expected: dict[str, list[float]]  # first-order mean errors, degrees
    points_for_5_deg_at_40_percent: int
    paper: dict[str, dict[int, float]]


def wrong_matches(n: int, percent: float, draws: int, seed: int = 0) -> torch.Tensor:
    """Compute errors of Horn's rotation when p % of the matches are wrong.

    Args:
        n: points, uniform in a unit cube.
        percent: p; that share of the points is matched with another point, uniform among the
            wrong ones. (The points are exchangeable, so the first ones are taken.)
        draws: number of clouds, rotations and corruptions.
        seed: of the draws.

    Returns:
        (draws,) float64, degrees.
    """
    rng = generator(Key(seed, STREAM, n, round(1000 * percent)))
    wrong = round(percent / 100 * n)
    errors = []
    for count in _slices(draws, max(1, 2**18 // n)):
        x = rng.random((count, n, 3))
        rotation = _rotations(rng, count)
        match = np.tile(np.arange(n), (count, 1))
        match[:, :wrong] = (match[:, :wrong] + rng.integers(1, n, (count, wrong))) % n
        source = torch.from_numpy(x)
        target = torch.from_numpy(np.take_along_axis(x, match[..., None], 1)) @ rotation.mT
        errors.append(rotation_error_deg(procrustes(source, target)[0], rotation))
    return torch.cat(errors)


def wrong_vector(percent: float, draws: int, seed: int = 0) -> torch.Tensor:
    """Compute errors of a rotation whose rotation vector is off by p %.

    Args:
        percent: p; each component gets Gaussian noise of standard deviation p / 100 * pi.
        draws: number of draws.
        seed: of the draws.

    Returns:
        (draws,) float64, degrees.
    """
    rng = generator(Key(seed, STREAM, 0, round(1000 * percent)))
    vector = _unit(rng, draws) * rng.uniform(0, math.pi, (draws, 1))
    noisy = vector + percent / 100 * math.pi * rng.standard_normal((draws, 3))
    rotations = (torch.from_numpy(Rotation.from_rotvec(v).as_matrix()) for v in (noisy, vector))
    return rotation_error_deg(*rotations)


def expected_deg(n: int, percent: float) -> float:
    """Compute the first-order mean error of `wrong_matches`: sqrt(4 p / (pi n)) / (1 - p) rad.

    Right matches give the covariance (1 - p) s^2 R, wrong ones add noise of standard
    deviation s^2 sqrt(p / n) to each of its entries (s^2 = 1/12, the cube's variance). The
    rotation follows the antisymmetric part, three Gaussians of standard deviation
    sqrt(p / 2n) / (1 - p) radians; their norm has mean sqrt(8 / pi) times that.
    """
    p = percent / 100
    return math.degrees(math.sqrt(4 * p / (math.pi * n)) / (1 - p))


def run(folder: Path, draws: int = 400, seed: int = 0) -> Robustness:
    """Compute every curve, write curve.json and curve.png into a folder.

    Args:
        folder: created if missing.
        draws: of every point of every curve.
        seed: of the draws.
    """
    curves = {
        f"{n} points": _curve([wrong_matches(n, p, draws, seed) for p in PERCENT]) for n in SIZES
    }
    curves["rotation vector"] = _curve([wrong_vector(p, draws, seed) for p in PERCENT])
    result = Robustness(
        percent=list(PERCENT),
        draws=draws,
        seed=seed,
        curves=curves,
        expected={f"{n} points": [round(expected_deg(n, p), 3) for p in PERCENT] for n in SIZES},
        points_for_5_deg_at_40_percent=points_for(5.0, 40.0),
        paper=PAPER,
    )
    folder.mkdir(parents=True, exist_ok=True)
    draw_figure(result, folder / "curve.png")
    replace_json(folder / "curve.json", asdict(result))
    return result


def points_for(error_deg: float, percent: float) -> int:
    """Compute how many points `expected_deg` needs for this mean error."""
    return round((expected_deg(1, percent) / error_deg) ** 2)


def draw_figure(result: Robustness, path: Path) -> None:
    """Draw the paper's figure 2, its chart as crosses, and wrong matches by number of points."""
    from matplotlib.figure import Figure

    percent = result.percent
    canvas = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = canvas.subplots(1, 2)
    main = (
        (f"{SHOWN} points", BLUE, "matches", f"correspondence matrix ({SHOWN} points)"),
        ("rotation vector", RED, "rotation vector", "rotation vector"),
    )
    for name, colour, paper, label in main:
        curve = result.curves[name]
        left.plot(percent, curve.mean, color=colour, label=label)
        left.fill_between(percent, curve.low, curve.high, color=colour, alpha=0.2, lw=0)
        points = result.paper[paper]
        left.plot(
            [float(p) for p in points], list(points.values()), "x", color=colour,
            label=f"paper's chart, {paper}",
        )  # fmt: skip
    left.set(title="Figure 2: mean and quartiles", ylim=(0, 180))
    for index, n in enumerate(SIZES):
        curve = result.curves[f"{n} points"]
        right.plot(percent, curve.mean, color=f"C{index}", label=f"{n} points")
        expected = result.expected[f"{n} points"]
        near = [i for i, value in enumerate(expected) if value < 60]
        right.plot(
            [percent[i] for i in near], [expected[i] for i in near], ":", color=f"C{index}", lw=2.5
        )
    right.plot([40], [5], "k*", markersize=12, label='paper\'s text: "about 5 deg"')
    right.set(title="Wrong matches; dotted: first order", yscale="log")
    for axes in (left, right):
        axes.set(xlabel="per cent corrupted", ylabel="rotation error, deg")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    save(canvas, path)


def terminal_table(result: Robustness) -> str:
    """Format mean errors in degrees, a column a curve; the last is the first-order value."""
    names = [*result.curves, f"first order, {SHOWN}"]
    columns = [c.mean for c in result.curves.values()] + [result.expected[f"{SHOWN} points"]]
    lines = ["  ".join(["  %", *(f"{name:>18s}" for name in names)])]
    for i, percent in enumerate(result.percent):
        lines.append("  ".join([f"{percent:3g}", *(f"{column[i]:18.2f}" for column in columns)]))
    return "\n".join(lines)


def _curve(errors: Sequence[torch.Tensor]) -> RobustnessCurve:
    """Summarise the errors of each percentage by mean and quartiles."""

    def rounded(values: list[torch.Tensor]) -> list[float]:
        return [round(float(value), 3) for value in values]

    return RobustnessCurve(
        rounded([e.mean() for e in errors]),
        rounded([e.quantile(0.25) for e in errors]),
        rounded([e.quantile(0.75) for e in errors]),
    )


def _rotations(rng: np.random.Generator, count: int) -> torch.Tensor:
    axis, angle = torch.from_numpy(_unit(rng, count)), torch.from_numpy(rng.random(count))
    return axis_angle_to_matrix(axis, math.pi * angle)


def _unit(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _slices(total: int, size: int) -> list[int]:
    return [min(size, total - start) for start in range(0, total, size)]
