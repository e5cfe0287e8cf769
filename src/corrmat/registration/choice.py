"""The choice among a model's candidates, and the refinement of the chosen one."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from corrmat.calibration import Scores
from corrmat.ops import rigid
from corrmat.registration.em_icp import WIDTHS, em_icp
from corrmat.registration.hypotheses import Hypotheses, HypothesisGenerator, from_many_matches
from corrmat.registration.phase_correlation import PhaseCorrelation
from corrmat.registration.preparation import (
    MODEL_POINTS,
    Cloud,
    PreparedClouds,
    prepare_clouds,
)
from corrmat.registration.scoring import (
    COARSE_POINTS,
    LEVELS,
    refine_coarse_to_fine,
)
from corrmat.registration.verification import verify


class ChoiceWeights(NamedTuple):
    """Weights of a candidate's score: its agreement plus the weighted sum of these."""

    coherence: float
    unmatched_loss: float
    support: float
    correlation: float
    verification: float  # of the network's logit, for those that are best by the others alone


class Measures(NamedTuple):
    """What a candidate's score weighs, without the verification."""

    agreement: float  # see `scoring.Alignment`
    coherence: float  # likewise
    unmatched_loss: float  # see `Hypotheses`; 0 without matchabilities
    support: float  # likewise; 1 without matches
    correlation: float  # phase correlation; 0 unless both clouds are large

    def weigh(self, weights: ChoiceWeights) -> float:
        """Sum the measures to a score, without the verification."""
        return (
            self.agreement
            + weights.coherence * self.coherence
            + weights.unmatched_loss * self.unmatched_loss
            + weights.support * self.support
            + weights.correlation * self.correlation
        )


CHOICE_WEIGHTS = ChoiceWeights(4.0, -1.0, 0.2, 0.0, 0.05)  # benchmarks/choice.py
LARGE_CLOUDS = ChoiceWeights(8.0, 0.0, 0.0, 5.0, 0.05)  # benchmarks/large_clouds.py
WITHOUT_MATCHABILITIES = ChoiceWeights(1.5, 0.0, 0.0, 0.0, 0.0)  # for other models
PEAKS = 16  # candidates from phase correlation
MANY_KEPT = 24  # candidates at most of those from many more matches
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


def choose(
    measures: Sequence[Measures],
    weights: ChoiceWeights,
    verified: Callable[[np.ndarray], np.ndarray],
) -> int:
    """Choose the candidate of the highest score; only the best by measures are verified.

    Args:
        measures: of T candidates.
        weights: of the measures.
        verified: what `verify` says of the candidates at (n,) indices.
    """
    best = best_by_measures(measures, weights, VERIFIED)
    if len(best) == 1:
        return int(best[0])
    scores = [measures[index].weigh(weights) for index in best]
    return int(best[np.argmax(scores + weights.verification * verified(best))])


def best_by_measures(
    measures: Sequence[Measures], weights: ChoiceWeights, count: int
) -> np.ndarray:
    """Return the indices of the candidates whose measures weigh most, best first."""
    scores = np.array([each.weigh(weights) for each in measures])
    return np.argsort(-scores, kind="stable")[:count]


class CandidateSearch:
    """The search for the transform of two clouds, from what a model says of them.

    Args:
        hypotheses: of the model.
        clouds: that they were made from.
    """

    def __init__(self, hypotheses: Hypotheses, clouds: PreparedClouds) -> None:
        self.hypotheses, self.clouds = hypotheses, clouds
        self._scorer = clouds.scorers[0]
        self._guesses = np.empty((0, 4, 4))

    @classmethod
    def start(
        cls,
        generate: HypothesisGenerator,
        source: np.ndarray | Cloud,
        target: np.ndarray | Cloud,
        seed: int,
    ) -> "CandidateSearch":
        """Prepare two clouds and ask a model for hypotheses; see `register`."""
        clouds = prepare_clouds(source, target, seed)
        return cls(generate(*clouds.subsamples, seed), clouds)

    def add_guess(self, transform: np.ndarray, *, alone: bool) -> None:
        """Add a guess (4, 4), in the user's coordinates, to the hypotheses, or in their place.

        It may be right already, and the few steps on few points that other hypotheses get would
        take it away. So it is a candidate as it is, too, and refined on more points.
        """
        self._guesses = self.clouds.from_original_units(transform)[None]
        others = self.hypotheses.transforms[: 0 if alone else None]
        transforms = np.concatenate([others, self._guesses])
        self.hypotheses = self.hypotheses._replace(transforms=transforms)

    @property
    def phase_correlation(self) -> PhaseCorrelation | None:
        """The phase correlation of the clouds, for models with matches; else None.

        Its grid is too fine for two small clouds: there it is None as well.
        """
        scorers = self.clouds.scorers
        with_matches = self.hypotheses.prob is not None
        return scorers[1].phase_correlation if with_matches and len(scorers) > 1 else None

    @property
    def correlation_of_large(self) -> PhaseCorrelation | None:
        """The phase correlation if both clouds are large; else None.

        Where one is small, it finds candidates, but says little of how good they are.
        """
        full = self.clouds.scorers[-1]
        large = min(len(full.source), len(full.target)) > LEVELS[0]
        return self.phase_correlation if large else None

    @property
    def weights(self) -> ChoiceWeights:
        """The weights of the choice among the candidates."""
        if self.correlation_of_large:
            return LARGE_CLOUDS
        unmatched = self.hypotheses.unmatched_nll
        return WITHOUT_MATCHABILITIES if unmatched is None else CHOICE_WEIGHTS

    def find(self, *, half_turns: bool) -> tuple[np.ndarray, list[Measures]]:
        """Refine and measure hypotheses, drop copies, and add what the best may be mistaken for.

        If a cloud is large and the model has matches, more hypotheses come from the peaks of the
        phase correlation and from many more matches. A thing that is nearly symmetric fits itself
        after half a turn. So the best candidates are turned by 180 degrees about each principal
        axis as well.

        Args:
            half_turns: whether to add them. Only a verification network can tell them from the
                right transform; the measures cannot.

        Returns:
            Transforms (T, 4, 4), half turns last, and their measures.
        """
        correlation = self.phase_correlation
        transforms = self.hypotheses.transforms
        if correlation:
            peaks = correlation.peaks(transforms[:, :3, :3], PEAKS)
            transforms = np.concatenate([transforms, peaks])
        refined = self.refine_a_little(transforms)
        if correlation:
            refined = distinct(np.concatenate([refined, self._from_many_matches()]))
        if len(self._guesses):
            from_guesses = np.stack([self._scorer.refine(each) for each in self._guesses])
            refined = distinct(np.concatenate([from_guesses, self._guesses, refined]))
        measures = self.measure(refined)
        if not half_turns:
            return refined, measures
        best = refined[best_by_measures(measures, self.weights, HALF_TURNED)]
        turned = np.concatenate([half_turned(each, self.clouds.subsamples) for each in best])
        candidates = distinct(np.concatenate([refined, self.refine_a_little(turned)]))
        return candidates, measures + self.measure(candidates[len(refined) :])

    def _from_many_matches(self) -> np.ndarray:
        """Fit and refine transforms to many more matches, and keep the best: (T, 4, 4)."""
        prob, clouds = self.hypotheses.prob, self.clouds
        assert prob is not None
        refined = self.refine_a_little(from_many_matches(prob, *clouds.subsamples, clouds.seed))
        agreement = np.array([self._scorer.coarse.alignment(each).agreement for each in refined])
        return refined[np.argsort(-agreement, kind="stable")[:MANY_KEPT]]

    def refine_a_little(self, transforms: np.ndarray) -> np.ndarray:
        """Refine transforms (T, 4, 4) by generalised ICP, and drop copies: to (D, 4, 4).

        With matches, few iterations on few points do: EM-ICP follows.
        """
        if self.hypotheses.prob is None:
            refined = [self._scorer.refine(each) for each in transforms]
        else:
            refined = [self._scorer.coarse.refine(each, CANDIDATE_STEPS) for each in transforms]
        return distinct(np.reshape(refined, (-1, 4, 4)))

    def measure(self, transforms: np.ndarray) -> list[Measures]:
        """Measure what the choice among transforms (T, 4, 4) weighs."""
        correlation = self.correlation_of_large
        measures = []
        for transform in transforms:
            agreement, coherence, distances = self._scorer.alignment(transform)
            unmatched = self.hypotheses.unmatched_loss(distances)
            support = self.hypotheses.support(transform, *self.clouds.subsamples)
            height = correlation.at(transform) if correlation else 0.0
            measures.append(Measures(agreement, coherence, unmatched, support, height))
        return measures

    def scores(self, transform: np.ndarray) -> Scores:
        """Compute the scores that the confidence in a transform (4, 4) is computed from."""
        measures = self.measure(transform[None])[0]
        support = measures.support if len(self.hypotheses.matches) else None
        if not self.correlation_of_large:
            return Scores(measures.agreement, support)
        return Scores(measures.agreement, support, measures.coherence, measures.correlation)

    def verify(self, transforms: np.ndarray) -> np.ndarray:
        """Score transforms (T, 4, 4) by the verification network: (T,) logits, zeros without."""
        return verify(transforms, self.hypotheses, self.clouds.subsamples)

    def refine_chosen(self, transform: np.ndarray) -> np.ndarray:
        """Refine the chosen transform (4, 4) by EM-ICP, on a few points, then on all the model's.

        With matches, the last iterations are enough for the second pass. Generalised ICP follows
        where it is more exact: on points that the model has not seen, and on points that both
        clouds share. In large clouds the model's points are too few, and a candidate slides along
        the walls of a room: there it is shifted to the nearest peak of the phase correlation, and
        generalised ICP on more and more points follows. Where only one cloud is large, or the model
        has no matches, generalised ICP starts from the chosen transform and from EM-ICP's, and what
        agrees better is taken.
        """
        scorers, subsamples = self.clouds.scorers, self.clouds.subsamples
        correlation = self.correlation_of_large
        if correlation:
            return refine_coarse_to_fine(correlation.shifted(transform), scorers)
        chosen = transform
        source, target = (cloud[:COARSE_POINTS] for cloud in subsamples)
        prob = self.hypotheses.prob
        some = None if prob is None else prob[: len(source), : len(target)]
        transform = em_icp(transform, source, target, some)
        if max(map(len, subsamples)) > COARSE_POINTS:
            widths = WIDTHS if prob is None else WIDTHS[-FINE_ITERATIONS:]
            transform = em_icp(transform, *subsamples, prob, widths)
        full = scorers[-1]
        if len(scorers) > 1:
            refined = [refine_coarse_to_fine(each, scorers) for each in (chosen, transform)]
            return max(refined, key=lambda each: full.alignment(each).agreement)
        more = max(len(full.source), len(full.target)) > MODEL_POINTS
        return full.refine(transform) if more or full.shares_points(transform) else transform
