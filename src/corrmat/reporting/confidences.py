"""Tables of the shipped weights' confidence: what it promised, and what happened."""

import json
from pathlib import Path
from typing import get_args

import numpy as np

from corrmat.calibration import Verdict, shipped_calibration, verdict_words
from corrmat.reporting.comparisons import OURS, read_comparisons
from corrmat.reporting.model_results import ModelResult
from corrmat.reporting.tables import markdown_head, markdown_row

UNRELATED = Path("register", "unrelated.json")  # below results/: clouds of two different things
_SMALL = "real", "views", "clean"  # clouds of at most 1,024 points
# Protocols of each kind of clouds.
_KINDS = {"small clouds": _SMALL, "dense scans of objects": ("dense",), "rooms": ("rooms",)}
_BINS = 10  # of the expected calibration error
_DRAWS = 1000  # of what chance alone makes of it


def confidence_table(results: Path) -> str:
    """Build the table of verdicts: what their confidence promised, and what was so.

    Below it stands the expected calibration error of each kind of clouds, and what is said of
    unrelated ones.
    """
    heads = ["verdict", "data", "pairs", "promised", "aligned", "wrong"]
    lines, summaries = markdown_head(heads), []
    comparisons, unrelated = read_comparisons(results), _read_unrelated(results)
    for what, protocols in _KINDS.items():
        both = []
        records = [c for c in comparisons if c.protocol in protocols]
        for data in sorted({c.data for c in records}, reverse=True):
            ours = [c.models[OURS] for c in records if c.data == data]
            promised = np.concatenate([_confidence(result) for result in ours])
            aligned = np.concatenate([result.aligned for result in ours])
            both.append((promised, aligned))
            verdicts = _verdicts(promised)
            for words in get_args(Verdict):
                inside = verdicts == words
                if inside.any():
                    means = [f"{values[inside].mean():.0%}" for values in (promised, aligned)]
                    counts = [str(number) for number in (inside.sum(), (inside & ~aligned).sum())]
                    about = data if protocols == _SMALL else protocols[0]
                    lines.append(markdown_row([words, about, counts[0], *means, counts[1]]))
        if both:
            promised, aligned = map(np.concatenate, zip(*both, strict=True))
            error = expected_calibration_error(promised, aligned)
            text = f"expected calibration error over {_BINS} bins {error:.3f}"
            low, high = calibration_error_by_chance(promised)
            perfect = f"a perfect confidence would show {low:.3f} to {high:.3f} on so many"
            summaries += ["", f"{len(promised)} pairs of {what}: {text} ({perfect})."]
        of_unrelated = [result for protocol, result in unrelated if protocol in protocols]
        if of_unrelated:
            confidence = np.concatenate([_confidence(result) for result in of_unrelated])
            verdicts = _verdicts(confidence).tolist()
            counts = ", ".join(f"{verdicts.count(words)} {words}" for words in get_args(Verdict))
            summaries += ["", f"{len(verdicts)} unrelated pairs of {what}: {counts}."]
    return "\n".join(lines + summaries)


def expected_calibration_error(promised: np.ndarray, happened: np.ndarray) -> float:
    """Compute the mean gap between promise and outcome over bins of equal width, by pairs.

    Args:
        promised: (n,) chances in [0, 1].
        happened: (n,) bool.
    """
    bins = np.minimum((promised * _BINS).astype(int), _BINS - 1)
    gaps = [abs((promised - happened)[bins == b].sum()) for b in range(_BINS)]
    return float(sum(gaps) / len(promised))


def calibration_error_by_chance(promised: np.ndarray) -> tuple[float, float]:
    """Compute the calibration error that a perfect confidence (n,) shows by chance.

    Returns:
        Its 90 % interval.
    """
    rng = np.random.default_rng(0)
    drawn = rng.random((_DRAWS, len(promised))) < promised
    low, high = np.percentile([expected_calibration_error(promised, d) for d in drawn], [5, 95])
    return float(low), float(high)


def _read_unrelated(results: Path) -> list[tuple[str, ModelResult]]:
    """Read what our model makes of unrelated clouds, by protocol."""
    path = results / UNRELATED
    content = json.loads(path.read_text())["pairs"] if path.is_file() else []
    return [(entry["protocol"], ModelResult(**entry["result"])) for entry in content]


def _verdicts(confidence: np.ndarray) -> np.ndarray:
    """Return the verdicts (n,) of confidences (n,), without their reasons."""
    return np.array([verdict_words(each) for each in confidence])


def _confidence(result: ModelResult) -> np.ndarray:
    """Compute what the shipped calibration promised for each pair."""
    calibration = shipped_calibration()
    return np.array([calibration.confidence(scores) for scores in result.scores])
