"""From the scores of a registration to a confidence, and from a confidence to words."""

import json
from dataclasses import dataclass
from typing import Literal

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


@dataclass(frozen=True)
class Calibration:
    """Logistic curves from the scores of a registration to the chance that it is right.

    Coefficients are over (agreement, support, 1); over (`of_large_clouds`, 1) for large clouds; and
    over (agreement, 1) for models without matches. `registration.calibrate` fits them.
    """

    both: list[float]
    large: list[float]
    agreement: list[float]

    def confidence(
        self,
        agreement: float,
        support: float | None,
        coherence: float | None = None,
        correlation: float | None = None,
    ) -> float:
        """Compute the chance that a registration is right.

        Args:
            agreement: of the two clouds, in [0, 1].
            support: of the matches, in [0, 1]; None for a model without matches.
            coherence: of two large clouds; None for others.
            correlation: their phase correlation; None for others.
        """
        if support is None:
            logit = np.dot(self.agreement, [agreement, 1.0])
        elif coherence is None or correlation is None:
            logit = np.dot(self.both, [agreement, support, 1.0])
        else:
            logit = np.dot(self.large, [*of_large_clouds(support, coherence, correlation), 1.0])
        return float(1 / (1 + np.exp(-logit)))


def of_large_clouds(
    support: float, coherence: float, correlation: float
) -> tuple[float, float, float]:
    """Bring the scores of two large clouds to numbers of order one for their curve.

    Agreement is not among them: two rooms that have nothing in common agree well, too.
    """
    return support, 4 * coherence, float(np.log(max(correlation, _LEAST_CORRELATION)))


def shipped_calibration() -> Calibration:
    """Read the calibration of the shipped weights."""
    return Calibration(**json.loads(shipped_metadata()["calibration"]))
