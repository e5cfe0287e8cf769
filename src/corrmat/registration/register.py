"""Register two clouds: the rigid transform between them, its matches and its confidence."""

import functools
import operator
import time
from pathlib import Path
from typing import Literal

import numpy as np
from torch import nn

from corrmat.calibration import Calibration, shipped_calibration, verdict
from corrmat.errors import CorrmatError
from corrmat.registration.choice import CandidateSearch, choose
from corrmat.registration.hypotheses import CLASSICAL, HypothesisGenerator, NetworkHypotheses
from corrmat.registration.preparation import Cloud, as_rigid
from corrmat.registration.result import Registration, direction_text
from corrmat.weights import load_model

Refine = Literal["icp", "none"]
FEW_POINTS = 30  # unrelated clouds of fewer points may lie on each other
FEW_AGREE = 0.02  # share of the matches: fewer that agree are chance
DOUBTFUL = 0.49  # confidence, at most, where one of these holds, or the source may slide
OTHER_SIZE = 8.0  # times as large: two such clouds may have different units


def register(
    source: np.ndarray | Cloud,
    target: np.ndarray | Cloud,
    *,
    model: str | Path | nn.Module = "corrmat",
    refine: Refine = "icp",
    init: np.ndarray | None = None,
    seed: int = 0,
) -> Registration:
    """Find the rigid transform that takes the source onto the target.

    The clouds may be in any unit, the same for both, overlap in part, share no point, and have
    outliers. Stray points, more than thirty median distances from the middle, are left out. The
    same points in any order, with the same seed, give the same matrix.

    Args:
        source: (N, 3), or (N, 6) with unit normals; or a `Cloud` of such points and this seed.
        target: (M, 3), or (M, 6); or a `Cloud`.
        model: "corrmat" for the shipped weights; "icp", or where they are installed "ransac",
            "ransac17", "fgr" or "kiss", for the classical pipelines; whatever else `load_model`
            takes; or a network, or a method, of your own.
        refine: "icp": generalised ICP of all candidates, then EM-ICP of the best, then generalised
            ICP on more and more points where a cloud has more than 2,048 (without EM-ICP if both
            have, and the model has matches). Or "none": the model's own candidates as they are,
            without half turns, and without those of large clouds.
        init: (4, 4), a guess of the transform, such as an odometry's: one more candidate, or with
            model="icp" the only one.
        seed: of subsampling and of the model's random draws.

    Returns:
        The registration, in the units of the clouds.

    Raises:
        CorrmatError: the points are not a cloud, or do not determine a rotation; the model is
            unknown; the guess is not rigid.
    """
    if refine not in ("icp", "none"):
        raise CorrmatError(f"refine = {refine!r}; choices: icp, none")
    seed = operator.index(seed)  # an integer of NumPy is one too
    if not 0 <= seed < 2**63:
        raise CorrmatError(f"seed = {seed} is not between 0 and 2^63")
    guess = None if init is None else as_rigid(init)
    if isinstance(model, nn.Module):
        generate: HypothesisGenerator = NetworkHypotheses(model)
        model = type(model).__name__
    else:
        generate = hypothesis_generator(str(model))
    start = time.perf_counter()
    search = CandidateSearch.start(generate, source, target, seed)
    if guess is not None:
        search.add_guess(guess, alone=model == "icp")
    hypotheses, clouds = search.hypotheses, search.clouds
    if refine == "icp":
        candidates, measures = search.find(half_turns=hypotheses.verification is not None)
    else:
        candidates = hypotheses.transforms
        measures = search.measure(candidates)
    chosen = choose(measures, search.weights, lambda rows: search.verify(candidates[rows]))
    transform = candidates[chosen]
    if refine == "icp":
        transform = search.refine_chosen(transform)
    agrees = hypotheses.match_support(transform, *clouds.subsamples) > 0
    scores = search.scores(transform)
    confidence = _calibration().confidence(scores)
    x, y = clouds.source, clouds.target
    fewest = min(len(x.rows), len(y.rows))
    overlap, rmse, slides_along, turns_about = clouds.scorers[-1].overlap(transform)
    few_agree = len(agrees) > 0 and agrees.mean() < FEW_AGREE
    if fewest < FEW_POINTS or few_agree or slides_along is not None:
        confidence = min(confidence, DOUBTFUL)
    rows = [cloud.rows[m] for cloud, m in zip((x, y), hypotheses.matches.T, strict=True)]
    return Registration(
        transform=clouds.to_original_units(transform),
        matches=np.stack(rows, 1),
        match_confidence=hypotheses.confidence,
        match_agrees=agrees,
        scores=scores,
        confidence=confidence,
        calibrated=hypotheses.verification is not None and refine == "icp",
        rmse=rmse / clouds.scale,
        overlap=overlap,
        slides_along=slides_along,
        turns_about=turns_about,
        verdict=verdict(
            confidence, _reason(agrees, overlap, slides_along, x.median / y.median, fewest)
        ),
        model=str(model),
        seed=seed,
        seconds=time.perf_counter() - start,
    )


def _reason(
    agrees: np.ndarray, overlap: float, slides_along: np.ndarray | None, size: float, fewest: int
) -> str:
    """Say what a confidence that is not high rests on.

    Args:
        agrees: (K,) bool, whether the transform explains each match.
        overlap: share of the source that lies on the target.
        slides_along: (3,), the direction in which the target does not hold the source.
        size: of the source, relative to the target.
        fewest: points of the smaller cloud.
    """
    reasons = [f"{agrees.sum()} of {len(agrees)} matches agree"] if len(agrees) else []
    reasons.append(f"{overlap:.0%} of the source lies on the target")
    if slides_along is not None:
        along = direction_text(slides_along)
        reasons.append(f"the aligned surfaces do not keep it from sliding along {along}")
    if fewest < FEW_POINTS:
        reasons.append(f"a cloud has only {fewest} points")
    if max(size, 1 / size) > OTHER_SIZE:
        times = f"{max(size, 1 / size):,.0f} times as large"
        reasons.append(
            f"one cloud is {times} as the other: do both have the same unit, or is it a part?"
        )
    return ", ".join(reasons)


def hypothesis_generator(model: str) -> HypothesisGenerator:
    """Return the classical pipeline of this name, or load a network.

    Raises:
        CorrmatError: there is no such model.
    """
    return CLASSICAL.get(model) or _load_network(model)


def _load_network(model: str) -> NetworkHypotheses:
    """Load a model, kept in memory until its file changes.

    Raises:
        CorrmatError: there is no such model.
    """
    path = Path(model)
    path = path / "model.safetensors" if path.is_dir() else path  # what `corrmat export` wrote
    stat = path.stat() if path.is_file() else None
    try:
        return _cached_network(
            model, stat and (str(path.resolve()), stat.st_mtime_ns, stat.st_size)
        )
    except CorrmatError as error:
        if path.exists() or model.startswith("hf:"):
            raise
        raise CorrmatError(f"{error}; classical pipelines: {', '.join(CLASSICAL)}") from error


@functools.cache
def _calibration() -> Calibration:
    return shipped_calibration()


@functools.lru_cache(maxsize=4)
def _cached_network(model: str, file: tuple[str, int, int] | None) -> NetworkHypotheses:
    return NetworkHypotheses(load_model(model))
