"""From the scores of a registration to a confidence, and from a confidence to words."""

import json
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from corrmat.weights import shipped_metadata

Verdict = Literal["aligned", "probably aligned", "doubtful"]
# Least confidence of the verdicts "aligned" and "probably aligned". `make calibration` says how
# many of the held-out pairs are called "aligned" wrongly: about 2 % at most should be.
SURE, LIKELY = 0.94, 0.5
_LEAST_CORRELATION = 0.02  # unrelated clouds have some, too


def verdict(confidence: float, reason: str) -> str:
    """Put a confidence into words, with the reason unless they are "aligned"."""
    words = verdict_words(confidence)
    return words if words == "aligned" else f"{words}: {reason}"


def verdict_words(confidence: float) -> Verdict:
    """Put a confidence into words, without a reason."""
    if confidence >= SURE:
        return "aligned"
    return "probably aligned" if confidence >= LIKELY else "doubtful"


def as_percent(confidence: float) -> str:
    """Format a confidence, rounded down, so that it never looks like a better verdict."""
    return f"{int(100 * confidence)}%"


class Scores(NamedTuple):
    """What the confidence of a registration is computed from."""

    agreement: float  # in [0, 1]: how much of each cloud lies on the other
    support: float | None  # in [0, 1]: share of the matches that the transform explains, if any
    coherence: float | None = None  # None unless both clouds have more than 2,048 points
    correlation: float | None = None  # likewise, their phase correlation

    def of_large_clouds(self) -> tuple[float, float, float] | None:
        """Return what the curve of two large clouds is over, of order one; None for others.

        Agreement is not among it: two rooms that have nothing in common agree well, too.
        """
        if self.support is None or self.coherence is None or self.correlation is None:
            return None
        height = float(np.log(max(self.correlation, _LEAST_CORRELATION)))
        return self.support, 4 * self.coherence, height


@dataclass(frozen=True)
class Calibration:
    """Logistic curves from the scores of a registration to the chance that it is right.

    Coefficients are over (agreement, support, 1); over (`Scores.of_large_clouds`, 1) for large
    clouds; and over (agreement, 1) for models without matches. `registration.calibrate` fits them.
    """

    both: list[float]
    large: list[float]
    agreement: list[float]

    def confidence(self, scores: Scores) -> float:
        """Compute the chance that a registration is right."""
        of_large = scores.of_large_clouds()
        if scores.support is None:
            logit = np.dot(self.agreement, [scores.agreement, 1.0])
        elif of_large is None:
            logit = np.dot(self.both, [scores.agreement, scores.support, 1.0])
        else:
            logit = np.dot(self.large, [*of_large, 1.0])
        return float(1 / (1 + np.exp(-logit)))


def shipped_calibration() -> Calibration:
    """Read the calibration of the shipped weights."""
    return Calibration(**json.loads(shipped_metadata()["calibration"]))
