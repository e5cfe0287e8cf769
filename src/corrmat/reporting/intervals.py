"""What the pairs of a test say about a method: intervals, and a comparison pair by pair.

Everything here is computed from a record's per_pair.csv, so it needs no network.
"""

import csv
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy import stats

RESAMPLES = 2000
_LARGE = 10_000  # a ratio above it says that one error is of rounding alone
FLIPPED_DEG = 90.0  # a larger rotation error is a flip, not an inaccuracy


@dataclass(frozen=True)
class PairErrors:
    """One arm's errors on n test pairs, in the order of the test."""

    rotation_deg: np.ndarray  # (n,) geodesic; 180 for a pair without an answer
    num_correct: np.ndarray  # (n,) correct matches; NaN for networks without matches
    num_matchable: np.ndarray  # (n,)
    band: np.ndarray  # (n,) int: the rotation band of the test, 0 if there is one only

    @property
    def flipped(self) -> int:
        """How many pairs are off by more than `FLIPPED_DEG`."""
        return int((self.rotation_deg > FLIPPED_DEG).sum())

    @property
    def median_deg(self) -> float:
        """The median rotation error, without its interval."""
        return float(_median(self.rotation_deg))

    def of_band(self, band: int) -> "PairErrors":
        """Return the pairs of one rotation band."""
        inside = self.band == band
        return PairErrors(
            self.rotation_deg[inside], self.num_correct[inside],
            self.num_matchable[inside], self.band[inside],
        )  # fmt: skip


@dataclass(frozen=True)
class Estimate:
    """A statistic and its 95 % interval over test pairs (percentile bootstrap)."""

    value: float
    low: float
    high: float


def as_text(estimate: Estimate, unit: str = "") -> str:
    """Format an estimate with its interval."""
    factor = 100 if unit == "%" else 1
    value, low, high = (factor * x for x in (estimate.value, estimate.low, estimate.high))
    if low > _LARGE:
        return f"more than {_LARGE:,}"
    return f"{value:.3g} [{low:.3g}, {high:.3g}]" + (f" {unit}" if unit else "")


def read_errors(path: Path) -> dict[str, PairErrors]:
    """Read a per_pair.csv: the errors of every arm and baseline."""
    rows: dict[str, list[Mapping[str, object]]] = defaultdict(list)
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            rows[row["arm"]].append(row)

    return {arm: pair_errors(its_rows) for arm, its_rows in rows.items()}


def pair_errors(rows: Sequence[Mapping[str, object]]) -> PairErrors:
    """Build the errors of one arm from its rows of per_pair.csv; see `writer.pair_rows`."""

    def column(name: str) -> np.ndarray:
        return np.array([float(str(row[name]) or "nan") for row in rows])

    return PairErrors(
        np.nan_to_num(column("rotation_error_deg"), nan=180.0),
        column("num_correct"),
        column("num_matchable"),
        column("band").astype(int),
    )


def estimate_median_rotation(errors: PairErrors) -> Estimate:
    """Estimate the median rotation error, in degrees."""
    return _bootstrap([errors.rotation_deg], _median)


def estimate_match_accuracy(errors: PairErrors) -> Estimate:
    """Estimate the share of matchable source points whose match is correct."""
    counts = [errors.num_correct, errors.num_matchable]
    return _bootstrap(counts, lambda correct, matchable: correct.sum(-1) / matchable.sum(-1))


def estimates(errors: PairErrors) -> dict[str, dict[str, float]]:
    """Estimate the median rotation error and the share of correct matches, for a JSON file."""
    both = {
        "median_deg": estimate_median_rotation(errors),
        "match_accuracy": estimate_match_accuracy(errors),
    }
    return {name: asdict(estimate) for name, estimate in both.items()}


def ratio_of_medians(numerator: PairErrors, denominator: PairErrors) -> Estimate:
    """Estimate the ratio of two arms' median rotation errors on the same pairs."""
    errors = [numerator.rotation_deg, denominator.rotation_deg]
    return _bootstrap(errors, lambda a, b: _median(a) / _median(b))


def p_of_equal_errors(one: PairErrors, other: PairErrors) -> float:
    """Return the p value of Wilcoxon's signed-rank test: both arms err alike on the same pairs."""
    difference = one.rotation_deg - other.rotation_deg
    if not difference.any():
        return 1.0
    return float(np.asarray(stats.wilcoxon(difference))[1])


def _median(values: np.ndarray) -> np.ndarray:
    """Compute torch's median, of an even number of values the lower middle one: as in records."""
    middle = (values.shape[-1] - 1) // 2
    return np.partition(values, middle, axis=-1)[..., middle]


def _bootstrap(samples: Sequence[np.ndarray], statistic: Callable[..., np.ndarray]) -> Estimate:
    """Compute a statistic of paired samples (n,), and its interval over resampled pairs."""
    size = len(samples[0])
    chosen = np.random.default_rng(0).integers(0, size, (RESAMPLES, size))
    with np.errstate(divide="ignore", invalid="ignore"):
        resampled = statistic(*(sample[chosen] for sample in samples))
        value = float(statistic(*samples))
    low, high = np.percentile(resampled, [2.5, 97.5])
    return Estimate(value, float(low), float(high))
