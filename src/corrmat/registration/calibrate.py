"""Fit the confidence of a registration on held-out pairs, related and unrelated ones."""

import itertools
from dataclasses import asdict, replace

import numpy as np
from scipy.optimize import minimize

from corrmat.calibration import SURE, Calibration, Scores
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.data.pairs import STREAM, Key, make_pairs
from corrmat.data.shapes.dataset import ASSEMBLY
from corrmat.registration import benchmark
from corrmat.types import PairBatch

CALIBRATION_PAIRS = {512: 200, 1024: 100}  # of a protocol, by points of a cloud
CALIBRATION_PROTOCOLS: tuple[benchmark.Protocol, ...] = ("real", "views", "clean")
CALIBRATION_SCANS = 150  # pairs of each protocol of large clouds
CALIBRATION_UNRELATED = 25  # pairs of each kind, one in seven, whose clouds are of two things
SCAN_POINTS = 20_000


def calibrate(model: str) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Fit the chance that a pair is aligned to its agreement and support.

    Logistic regression on held-out pairs of three difficulties, and of large clouds on a curve of
    their own; `Calibration` applies it. Pairs of unrelated clouds are added: without them any two
    rooms, and a third of unrelated objects, would be "probably aligned". The curve over the
    agreement alone, for models without matches, is fitted on ICP's outcomes as well: most of them
    are wrong, where few of the network's are.

    Args:
        model: as `register` takes it.

    Returns:
        The coefficients of a `Calibration`; and the share of each protocol's pairs of 512 points,
        and of large clouds, that are within 5 degrees.
    """
    scores, aligned, recalls = [], [], {}
    icp_scores, icp_aligned = [], []
    for protocol, points in itertools.product(CALIBRATION_PROTOCOLS, CALIBRATION_PAIRS):
        pairs = held_out_pairs(protocol, CALIBRATION_PAIRS[points], seed=0, points=points)
        recall, more, right = _outcomes(pairs, model)
        if points == 512:
            recalls[protocol] = recall
        scores += more
        aligned += right
        _, more, right = _outcomes(pairs, "icp")
        icp_scores += more
        icp_aligned += right
    large_scores, large_aligned = [], []
    for protocol in benchmark.SCANS:
        pairs = benchmark.frozen_pairs(
            protocol, points=SCAN_POINTS, count=CALIBRATION_SCANS, split="val"
        )
        recalls[protocol], more, right = _outcomes(pairs, model)
        large_scores += more
        large_aligned += right
    curve = Calibration(
        both=_fit_logistic(
            np.array([(each.agreement, each.support) for each in scores]), np.array(aligned, float)
        ),
        large=_fit_logistic(
            np.array([each.of_large_clouds() for each in large_scores]),
            np.array(large_aligned, float),
        ),
        agreement=_fit_logistic(
            np.array([[each.agreement] for each in scores + icp_scores]),
            np.array(aligned + icp_aligned, float),
        ),
    )
    for values, right in ((scores, aligned), (large_scores, large_aligned)):
        sure = np.array([curve.confidence(each) >= SURE for each in values])
        wrongly = np.mean(sure & ~np.array(right))
        called = f"{sure.mean():.1%} of {len(values)} held-out pairs, {wrongly:.1%} wrongly"
        print(f'called "aligned": {called}')
    return asdict(curve), recalls


def _outcomes(pairs: PairBatch, model: str) -> tuple[float, list[Scores], list[bool]]:
    """Register pairs, and some of their clouds with unrelated ones.

    Returns:
        The share of the pairs that are within 5 degrees; the scores of all; and
        whether they are aligned, which unrelated clouds never are.
    """
    unrelated_pairs = benchmark.unrelated(pairs, CALIBRATION_UNRELATED)
    result, wrong = (benchmark.compare(each, [model])[model] for each in (pairs, unrelated_pairs))
    aligned = [*result.aligned.tolist(), *[False] * len(unrelated_pairs)]
    return result.recall_5deg, result.scores + wrong.scores, aligned


def held_out_pairs(
    protocol: benchmark.Protocol, count: int, seed: int, points: int = 512
) -> PairBatch:
    """Make pairs of the families' shapes that no training of the network but the first saw.

    Args:
        protocol: one of `benchmark.PROTOCOLS`.
        count: of pairs, spread over the shapes; at most one a shape.
        seed: of crops, noise and poses.
        points: of a cloud before it is cropped.
    """
    # The shapes that runs held out until each pair got a new one.
    clouds = RegistrationDataModule(data="shapes+assemblies").clouds("val")
    families = np.flatnonzero([clouds.names[label] != ASSEMBLY for label in clouds.labels])
    evenly = np.linspace(0, len(families) - 1, min(count, len(families))).round().astype(int)
    chosen = families[evenly].tolist()
    keys = [Key(seed, STREAM["val"], 0, shape) for shape in chosen]
    settings = replace(benchmark.PROTOCOLS[protocol], num_points=points)
    return make_pairs(clouds, chosen, keys, settings)


def _fit_logistic(scores: np.ndarray, y: np.ndarray) -> list[float]:
    """Fit a logistic curve over scores (n, k), with slight shrinkage for separable classes.

    Returns:
        k coefficients and the constant.
    """
    x = np.column_stack([scores, np.ones(len(scores))])

    def loss(coefficients: np.ndarray) -> float:
        logit = x @ coefficients
        return float(np.mean(np.logaddexp(0, logit) - y * logit) + 1e-4 * (coefficients**2).sum())

    return minimize(loss, np.zeros(x.shape[1])).x.tolist()
