"""How much coherence and support should count when `corrmat register` chooses a candidate.

    python benchmarks/choice.py        minutes

Candidates are compared by agreement + a * coherence + b * support (`registration/register.py`).
This tries weights on pairs of training shapes that were held out of the training of the network,
and writes results/register/choice.json: the recall at 5 degrees and by ADD-S for each (a, b).
Two more rows say what limits it: the best candidate of every pair, which no choice can exceed; and
the choice where the true transform, after ICP, joins the candidates. The last rows compare how the
chosen one, and the truth, are refined.

`right_matches` is how many of the network's matches, by weight, the true transform explains, for
several numbers of anchors that its points attend to.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import track

from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG
from corrmat.networks.invariant import InvariantNetwork
from corrmat.ops import rigid
from corrmat.registration import benchmark
from corrmat.registration.em_icp import em_icp
from corrmat.registration.hypotheses import Hypotheses, NetworkHypotheses
from corrmat.registration.register import (
    COHERENCE_WEIGHT,
    SUPPORT_WEIGHT,
    choose,
    measure_candidates,
    prepare_clouds,
    to_original_units,
)
from corrmat.registration.shipping import held_out_pairs
from corrmat.revision import commit
from corrmat.types import PairBatch
from corrmat.weights import load_model

PATH = Path(__file__).resolve().parents[1] / "results" / "register" / "choice.json"
WEIGHTS = (
    (0.0, 0.0),
    (0.0, 0.4),
    (1.0, 0.2),
    (1.0, 0.4),
    (1.5, 0.0),
    (1.5, 0.2),
    (1.5, 0.4),
    (1.5, 0.6),
    (2.0, 0.4),
)
IN_USE = COHERENCE_WEIGHT, SUPPORT_WEIGHT
REFINED = "generalised ICP", "EM-ICP without matches", "EM-ICP"
PAIRS = {"real": 400, "views": 300, "clean": 100}
ANCHORS = 64, 128, 256, 1024
_SEED = 5  # of pairs that nothing else uses


class PairTables(NamedTuple):
    """What the candidates of a pair are worth; the last of them is the true transform."""

    candidates: np.ndarray  # (T + 1, 5) agreement, coherence, support, degrees and ADD-S
    refined: np.ndarray  # (3, 2) degrees and ADD-S of the chosen one, refined as in `REFINED`
    refined_truth: np.ndarray  # (3, 2) the same of the true transform
    right_matches: list[float]  # share of the matches, by weight, for each of `ANCHORS`


def tables_of(pairs: PairBatch, index: int, generate: NetworkHypotheses) -> PairTables:
    """Refine and measure the candidates of a pair, and the true transform in the same way."""
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    (x, y), scale, subsamples, scorer = prepare_clouds(source, target, 0)
    hypotheses = generate(*subsamples, 0)
    rotation, translation = pairs.rotation[index].double().numpy(), pairs.translation[index].numpy()
    truth = rigid.to_homogeneous(rotation, scale * (rotation @ x.centre + translation - y.centre))
    hypotheses = hypotheses._replace(transforms=np.stack([*hypotheses.transforms, truth]))
    transforms, measures = measure_candidates(hypotheses, subsamples, scorer)
    chosen = transforms[choose(measures[:-1], IN_USE)]

    def errors_of(transforms: Sequence[np.ndarray]) -> np.ndarray:
        in_units = [to_original_units(t, scale, x.centre, y.centre) for t in transforms]
        return np.array([benchmark.errors(pairs, index, t) for t in in_units])

    def refined(transform: np.ndarray) -> list[np.ndarray]:
        priors = None, hypotheses.prob
        em = [em_icp(transform, *subsamples, prior) for prior in priors]
        return [scorer.refine(transform), *em]

    return PairTables(
        np.hstack([measures, errors_of(list(transforms))]),
        errors_of(refined(chosen)),
        errors_of(refined(truth)),
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


def recalls(tables: Sequence[np.ndarray], weights: tuple[float, float] | None) -> dict[str, float]:
    """Compute the recall of choosing by weights; of the best candidate of each pair if None."""
    chosen = []
    for table in tables:
        best = slice(None) if weights is None else [choose(table[:, :3], weights)]
        chosen.append(table[best, 3:].min(0))
    return shares(chosen)


def shares(errors: Sequence[np.ndarray]) -> dict[str, float]:
    """Compute the recalls of pairs from their degrees and ADD-S (2,)."""
    degrees, adds = np.array(errors).T
    return {
        "recall_5deg": round(float(np.mean(degrees < RECALL_DEG)), 4),
        "recall_adds": round(float(np.mean(adds < ADDS_THRESHOLD)), 4),
    }


def main() -> None:
    """Try all weights on all protocols."""
    generate = NetworkHypotheses(load_model())
    content: dict[str, object] = {"commit": commit(), "points": 512}
    for protocol, count in PAIRS.items():
        pairs = held_out_pairs(protocol, count, _SEED)
        measured = [
            tables_of(pairs, index, generate)
            for index in track(range(len(pairs)), protocol, transient=True)
        ]
        tables = [table.candidates for table in measured]
        without_truth = [table[:-1] for table in tables]
        tried = {f"{a}, {b}": recalls(without_truth, (a, b)) for a, b in WEIGHTS}
        tried["best candidate"] = recalls(without_truth, None)
        in_use = f"{IN_USE[0]}, {IN_USE[1]}"
        tried[f"{in_use}, the truth among the candidates"] = recalls(tables, IN_USE)
        for row, name in enumerate(REFINED):
            tried[f"{in_use}, then {name}"] = shares([table.refined[row] for table in measured])
            tried[f"the truth, after {name}"] = shares(
                [table.refined_truth[row] for table in measured]
            )
        count = float(np.mean([len(table) for table in without_truth]))
        means = np.mean([table.right_matches for table in measured], 0).round(4).tolist()
        right = dict(zip(map(str, ANCHORS), means, strict=True))
        content[protocol] = {
            "pairs": len(pairs), "candidates": count, "weights": tried, "right_matches": right,
        }  # fmt: skip
        print(protocol, json.dumps(content[protocol], indent=1), flush=True)
    PATH.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
