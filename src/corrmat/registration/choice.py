"""The choice among a model's candidates, and the refinement of the chosen one."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from corrmat.ops import rigid
from corrmat.registration.em_icp import WIDTHS, em_icp
from corrmat.registration.hypotheses import Hypotheses
from corrmat.registration.phase_correlation import PhaseCorrelation
from corrmat.registration.preparation import MODEL_POINTS, PreparedClouds
from corrmat.registration.scoring import (
    COARSE_POINTS,
    LEVELS,
    AlignmentScorer,
    refine_coarse_to_fine,
)


class ChoiceWeights(NamedTuple):
    """A candidate scores its agreement + these times what the fields name.

    All but the last are in the order of `measure`'s columns, whose first is the agreement.
    """

    coherence: float
    unmatched_loss: float
    support: float
    correlation: float  # phase correlation
    verification: float  # the logit of the verification network, for the best of the others' sum


CHOICE_WEIGHTS = ChoiceWeights(4.0, -1.0, 0.2, 0.0, 0.05)  # benchmarks/choice.py
LARGE_CLOUDS = ChoiceWeights(8.0, 0.0, 0.0, 5.0, 0.05)  # benchmarks/large_clouds.py
WITHOUT_MATCHABILITIES = ChoiceWeights(1.5, 0.0, 0.0, 0.0, 0.0)  # for other models
PEAKS = 16  # candidates from phase correlation
HALF_TURNED = 3  # candidates at most
VERIFIED = 8  # candidates at most
CANDIDATE_STEPS = 5  # of generalised ICP, for each candidate; EM-ICP with matches does the rest
SAME_TRANSFORM = 0.1  # difference of two matrices: a turn by 4 degrees, or a shift by 0.1
FINE_ITERATIONS = 4  # of EM-ICP's second pass, on all points of a model with matches


def distinct(transforms: np.ndarray) -> np.ndarray:
    """Drop each transform that is nearly an earlier one: (T, 4, 4) to (D, 4, 4)."""
    kept = transforms[:1]
    for transform in transforms[1:]:
        if np.linalg.norm(kept - transform, axis=(1, 2)).min() > SAME_TRANSFORM:
            kept = np.concatenate([kept, transform[None]])
    return kept


def phase_correlation(hypotheses: Hypotheses, clouds: PreparedClouds) -> PhaseCorrelation | None:
    """Return the phase correlation of two clouds, for models with matches; else None.

    Its grid is too fine for two small clouds: there it is None as well.
    """
    if hypotheses.prob is None or len(clouds.scorers) == 1:
        return None
    return clouds.scorers[1].phase_correlation


def correlation_of_large(hypotheses: Hypotheses, clouds: PreparedClouds) -> PhaseCorrelation | None:
    """Return the phase correlation if both clouds are large; else None.

    Where one is small, it finds candidates, but says little of how good they are.
    """
    full = clouds.scorers[-1]
    large = min(len(full.source), len(full.target)) > LEVELS[0]
    return phase_correlation(hypotheses, clouds) if large else None


def weights_for(hypotheses: Hypotheses, clouds: PreparedClouds) -> ChoiceWeights:
    """Return the weights of the choice among a model's candidates."""
    if correlation_of_large(hypotheses, clouds):
        return LARGE_CLOUDS
    return WITHOUT_MATCHABILITIES if hypotheses.unmatched_nll is None else CHOICE_WEIGHTS


def find_candidates(
    hypotheses: Hypotheses, clouds: PreparedClouds, *, half_turns: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Refine and measure hypotheses, drop copies, and add what the best may be mistaken for.

    If a cloud is large, the peaks of the phase correlation are hypotheses, too. A thing that is
    nearly symmetric fits itself after half a turn. So the best candidates are turned by 180 degrees
    about each principal axis as well.

    Args:
        hypotheses: of the model.
        clouds: that they were made from.
        half_turns: whether to add them. Only a verification network can tell them from the right
            transform; the measures cannot.

    Returns:
        Transforms (T, 4, 4), half turns last, and their measures (T, 5).
    """
    scorer = clouds.scorers[0]
    correlation = phase_correlation(hypotheses, clouds)
    transforms = hypotheses.transforms
    if correlation:
        peaks = correlation.peaks(transforms[:, :3, :3], PEAKS)
        transforms = np.concatenate([transforms, peaks])
    refined = refine_some(transforms, hypotheses, scorer)
    measures = measure(refined, hypotheses, clouds)
    if not half_turns:
        return refined, measures
    weights = weights_for(hypotheses, clouds)
    best = refined[best_by_measures(measures, weights, HALF_TURNED)]
    turned = np.concatenate([half_turned(each, clouds.subsamples) for each in best])
    candidates = distinct(np.concatenate([refined, refine_some(turned, hypotheses, scorer)]))
    added = measure(candidates[len(refined) :], hypotheses, clouds)
    return candidates, np.concatenate([measures, added])


def refine_some(
    transforms: np.ndarray, hypotheses: Hypotheses, scorer: AlignmentScorer
) -> np.ndarray:
    """Refine transforms (T, 4, 4) by generalised ICP, a little with matches, and drop copies."""
    if hypotheses.prob is None:
        return distinct(np.stack([scorer.refine(each) for each in transforms]))
    return distinct(np.stack([scorer.coarse.refine(each, CANDIDATE_STEPS) for each in transforms]))


def half_turned(transform: np.ndarray, subsamples: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Turn what a transform (4, 4) moves by 180 degrees, about each principal axis of both clouds.

    Args:
        transform: of the source onto the target.
        subsamples: (N, 3 or more) and (M, 3 or more).

    Returns:
        (3, 4, 4).
    """
    source, target = (cloud[:, :3] for cloud in subsamples)
    points = np.concatenate([rigid.move(transform, source), target])
    centre = points.mean(0)
    axes = np.linalg.eigh(np.cov(points.T))[1].T
    rotation = 2 * axes[:, :, None] * axes[:, None] - np.eye(3)
    return rigid.to_homogeneous(rotation, centre - rotation @ centre) @ transform


def measure(transforms: np.ndarray, hypotheses: Hypotheses, clouds: PreparedClouds) -> np.ndarray:
    """Measure what the choice among transforms weighs.

    Args:
        transforms: (T, 4, 4).
        hypotheses: of the model.
        clouds: that they were made from.

    Returns:
        (T, 5): agreement, coherence, unmatched loss, support, and phase correlation (0 unless
        both clouds are large).
    """
    correlation = correlation_of_large(hypotheses, clouds)
    rows = []
    for transform in transforms:
        agreement, coherence, distances = clouds.scorers[0].alignment(transform)
        unmatched = hypotheses.unmatched_loss(distances)
        support = hypotheses.support(transform, *clouds.subsamples)
        height = correlation.at(transform) if correlation else 0.0
        rows.append((agreement, coherence, unmatched, support, height))
    return np.reshape(rows, (-1, 5))


def choose(
    measures: np.ndarray,
    weights: ChoiceWeights,
    verified: Callable[[np.ndarray], np.ndarray],
) -> int:
    """Choose the candidate of the highest score; only the best by measures are verified.

    Args:
        measures: (T, 5) of `measure`.
        weights: beside agreement's 1.
        verified: what `verify` says of the candidates at (n,) indices.
    """
    best = best_by_measures(measures, weights, VERIFIED)
    if len(best) == 1:
        return int(best[0])
    scores = weigh(measures[best], weights) + weights.verification * verified(best)
    return int(best[np.argmax(scores)])


def best_by_measures(measures: np.ndarray, weights: ChoiceWeights, count: int) -> np.ndarray:
    """Return the indices of the candidates of the highest sums of measures (T, 5), best first."""
    return np.argsort(-weigh(measures, weights), kind="stable")[:count]


def weigh(measures: np.ndarray, weights: ChoiceWeights) -> np.ndarray:
    """Sum measures (T, 5) to scores (T,), without the verification."""
    return measures @ [1.0, *weights[:4]]


def refine_chosen(
    transform: np.ndarray, hypotheses: Hypotheses, clouds: PreparedClouds
) -> np.ndarray:
    """Refine the chosen transform (4, 4) by EM-ICP, on a few points and then on all of the model's.

    With matches, the last iterations are enough for the second pass. Generalised ICP follows where
    it is more exact: on points that the model has not seen, and on points that both clouds share.
    In large clouds the model's points are too few, and a candidate slides along the walls of a
    room: there it is shifted to the nearest peak of the phase correlation, and generalised ICP on
    more and more points follows. Where only one cloud is large, or the model has no matches,
    generalised ICP starts from the chosen transform and from EM-ICP's, and what agrees better is
    taken.

    Args:
        transform: of the source onto the target.
        hypotheses: from which it was chosen.
        clouds: that they were made from.
    """
    scorers = clouds.scorers
    correlation = correlation_of_large(hypotheses, clouds)
    if correlation:
        return refine_coarse_to_fine(correlation.shifted(transform), scorers)
    chosen = transform
    source, target = (cloud[:COARSE_POINTS] for cloud in clouds.subsamples)
    prob = hypotheses.prob
    some = None if prob is None else prob[: len(source), : len(target)]
    transform = em_icp(transform, source, target, some)
    if max(map(len, clouds.subsamples)) > COARSE_POINTS:
        widths = WIDTHS if prob is None else WIDTHS[-FINE_ITERATIONS:]
        transform = em_icp(transform, *clouds.subsamples, prob, widths)
    full = scorers[-1]
    if len(scorers) > 1:
        refined = [refine_coarse_to_fine(each, scorers) for each in (chosen, transform)]
        return max(refined, key=lambda each: full.alignment(each).agreement)
    more = max(len(full.source), len(full.target)) > MODEL_POINTS
    return full.refine(transform) if more or full.shares_points(transform) else transform
