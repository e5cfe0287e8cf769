"""What `corrmat register` chooses a candidate by, and what limits its choice.

    python benchmarks/choice.py        minutes

A candidate's score is agreement + a * coherence + b * unmatched loss + c * support + d * the
verification network's logit (`registration/choice.py`). This tests weights and refinements on
pairs of training shapes that no training of the matching network but the first saw, and none of
the verification network. The weights in use were chosen on other pairs of these shapes.
`right_matches` is how many of the network's matches, by weight, the true transform explains, for
several numbers of anchors that its points attend to. It writes results/register/choice.json.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from corrmat.files import replace_json
from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG
from corrmat.networks.invariant import InvariantNetwork
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration import benchmark
from corrmat.registration.calibrate import held_out_pairs
from corrmat.registration.choice import (
    CHOICE_WEIGHTS,
    CandidateSearch,
    ChoiceWeights,
    Measures,
    choose,
)
from corrmat.registration.em_icp import em_icp
from corrmat.registration.hypotheses import Hypotheses, NetworkHypotheses
from corrmat.revision import commit
from corrmat.types import PairBatch
from corrmat.weights import load_model

PATH = Path(__file__).resolve().parents[1] / "results" / "register" / "choice.json"
_COHERENCE, _UNMATCHED, _SUPPORT, _, _VERIFICATION = CHOICE_WEIGHTS
_MEASURED = _COHERENCE, _UNMATCHED, _SUPPORT
# Of coherence, unmatched loss, support and verification; clouds so small have no phase correlation.
TRIED = (
    (0.0, 0.0, 0.0, 0.0), (1.5, 0.0, 0.0, 0.0), (_COHERENCE, 0.0, 0.0, 0.0),
    (0.0, _UNMATCHED, 0.0, 0.0), (0.0, 0.0, _SUPPORT, 0.0), (_COHERENCE, _UNMATCHED, 0.0, 0.0),
    (*_MEASURED, 0.0), (*_MEASURED, _VERIFICATION), (*_MEASURED, _VERIFICATION / 2),
    (*_MEASURED, 2 * _VERIFICATION), (*_MEASURED, 20 * _VERIFICATION),
)  # fmt: skip
PAIRS: dict[benchmark.Protocol, int] = {"real": 200, "views": 120, "clean": 80}
ANCHORS = 64, 256
PRIORS = "without matches", "with matches"  # of EM-ICP
_SEED = 5  # of pairs that nothing else uses


class CandidateTables(NamedTuple):
    """What candidates are worth; the last of them is the true transform."""

    measures: list[Measures]  # of T + 1
    logits: np.ndarray  # (T + 1,) of the verification network
    errors: np.ndarray  # (2, T + 1, 2) degrees and ADD-S, after generalised ICP and after EM-ICP


class PairTables(NamedTuple):
    """What a pair's candidates, and its truth, are worth."""

    candidates: int  # before copies are dropped
    unturned: int  # candidates that are no half turns, the first of them
    tables: CandidateTables  # of the candidates that `register` chooses from
    refined_truth: np.ndarray  # (2, 2) errors of the truth after EM-ICP alone, as `PRIORS`
    right_matches: list[float]  # share of the matches, by weight, for each of `ANCHORS`


def tables_of(pairs: PairBatch, index: int, generate: NetworkHypotheses) -> PairTables:
    """Refine and measure the candidates of a pair, and the true transform in the same way."""
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    search = CandidateSearch.start(generate, source, target, 0)
    hypotheses, clouds = search.hypotheses, search.clouds
    subsamples = clouds.subsamples
    truth = rigid.to_homogeneous(pairs.rotation[index], pairs.translation[index])
    truth = clouds.from_original_units(truth)

    def errors_of(transforms: Iterable[np.ndarray]) -> np.ndarray:
        in_units = map(clouds.to_original_units, transforms)
        return np.array([benchmark.errors(pairs, index, t) for t in in_units])

    found, measures = search.find(half_turns=True)
    true = search.refine_a_little(truth[None])
    candidates = np.concatenate([found, true])
    gicp = [clouds.scorers[0].refine(each) for each in candidates]
    em = [search.refine_chosen(each) for each in candidates]
    return PairTables(
        len(hypotheses.transforms),
        len(search.refine_a_little(hypotheses.transforms)),
        CandidateTables(
            measures + search.measure(true),
            search.verify(candidates),
            np.stack([errors_of(each) for each in (gicp, em)]),
        ),
        errors_of(em_icp(truth, *subsamples, prior) for prior in (None, hypotheses.prob)),
        [matches_of(generate, count, subsamples).support(truth, *subsamples) for count in ANCHORS],
    )


def matches_of(
    generate: NetworkHypotheses, anchors: int, subsamples: tuple[np.ndarray, np.ndarray]
) -> Hypotheses:
    """Match two clouds whose points attend to so many anchors."""
    network = generate.network
    assert isinstance(network, InvariantNetwork)
    usual, network.test_anchors = network.test_anchors, anchors
    try:
        return generate(*subsamples, 0)
    finally:
        network.test_anchors = usual


def outcomes(table: PairTables) -> dict[str, np.ndarray]:
    """Return the errors (2,) of one pair for all weights and refinements."""
    measures, logits, (gicp, em) = table.tables

    def chosen(weights: ChoiceWeights, count: int) -> int:
        return choose(measures[:count], weights, logits.__getitem__)

    found = len(measures) - 1
    rows = {
        ", ".join(f"{weight:g}" for weight in tried): em[
            chosen(ChoiceWeights(*tried[:3], 0.0, tried[3]), found)
        ]
        for tried in TRIED
    }
    rows["in use, without half turns"] = em[chosen(CHOICE_WEIGHTS, table.unturned)]
    rows["best candidate"] = em[:-1].min(0)
    rows["best candidate, without half turns"] = em[: table.unturned].min(0)
    rows["in use, the truth among the candidates"] = em[chosen(CHOICE_WEIGHTS, found + 1)]
    rows["in use, generalised ICP alone"] = gicp[chosen(CHOICE_WEIGHTS, found)]
    rows["the truth, after generalised ICP"] = gicp[-1]
    for prior, errors in zip(PRIORS, table.refined_truth, strict=True):
        rows[f"the truth, after EM-ICP {prior}"] = errors
    return rows


def shares(errors: Sequence[np.ndarray]) -> dict[str, float]:
    """Compute the recalls of pairs from their degrees and ADD-S (2,)."""
    degrees, adds = np.array(errors).T
    return {
        "recall_5deg": round(float(np.mean(degrees < RECALL_DEG)), 4),
        "recall_adds": round(float(np.mean(adds < ADDS_THRESHOLD)), 4),
    }


def main() -> None:
    """Try all weights and refinements on all protocols."""
    generate = NetworkHypotheses(load_model())
    content: dict[str, object] = {"commit": commit(), "points": 512}
    for protocol, count in PAIRS.items():
        pairs = held_out_pairs(protocol, count, _SEED)
        tables = [tables_of(pairs, index, generate) for index in track(range(len(pairs)), protocol)]
        rows = [outcomes(table) for table in tables]
        means = np.mean([table.right_matches for table in tables], 0).round(4).tolist()
        content[protocol] = {
            "pairs": len(tables),
            "candidates": float(np.mean([table.candidates for table in tables])),
            "distinct": float(np.mean([len(table.tables.measures) - 1 for table in tables])),
            "weights": {name: shares([row[name] for row in rows]) for name in rows[0]},
            "right_matches": dict(zip(map(str, ANCHORS), means, strict=True)),
        }
    print(json.dumps(content, indent=1))
    replace_json(PATH, content)


if __name__ == "__main__":
    main()
