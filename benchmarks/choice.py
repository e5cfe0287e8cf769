"""How much coherence and support should count when `corrmat register` chooses a candidate.

    python benchmarks/choice.py        minutes

Candidates are compared by agreement + a * coherence + b * support (`registration/register.py`).
This tries weights on pairs of training shapes that were held out of the training of the network,
and writes results/register/choice.json: the recall at 5 degrees and by ADD-S for each (a, b).
Three more rows say what limits it: the best candidate of every pair, which no choice can exceed;
the true transform after ICP, which a symmetric shape slides away from; and the choice where that
joins the candidates.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.progress import track

from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG
from corrmat.registration import benchmark
from corrmat.registration.hypotheses import NetworkHypotheses
from corrmat.registration.register import (
    COHERENCE_WEIGHT,
    SUPPORT_WEIGHT,
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
    (0.0, 0.2),
    (1.0, 0.0),
    (1.0, 0.2),
    (1.5, 0.0),
    (1.5, 0.2),
    (2.0, 0.2),
    (1.5, 0.4),
)
IN_USE = COHERENCE_WEIGHT, SUPPORT_WEIGHT
PAIRS = {"real": 400, "views": 300, "clean": 100}
_SEED = 5  # of pairs that nothing else uses


def candidates(pairs: PairBatch, index: int, generate: NetworkHypotheses) -> np.ndarray:
    """Compute agreement, coherence, support, degrees and ADD-S of a pair's candidates.

    Returns:
        (T + 1, 5): the last row is the true transform, refined as the candidates are.
    """
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    (x, y), scale, subsamples, scorer = prepare_clouds(source, target, 0)
    hypotheses = generate(*subsamples, 0)
    truth = np.eye(4)
    truth[:3, :3] = pairs.rotation[index].double()
    truth[:3, 3] = truth[:3, :3] @ x.centre + pairs.translation[index].double().numpy() - y.centre
    truth[:3, 3] *= scale
    hypotheses = hypotheses._replace(transforms=np.stack([*hypotheses.transforms, truth]))
    transforms, measures = measure_candidates(hypotheses, subsamples, scorer)
    in_units = [to_original_units(t, scale, x.centre, y.centre) for t in transforms]
    return np.hstack([measures, [benchmark.errors(pairs, index, t) for t in in_units]])


def recalls(tables: Sequence[np.ndarray], weights: tuple[float, float] | None) -> dict[str, float]:
    """Compute the recall of choosing by weights; of the best candidate of each pair if None."""
    degrees, adds = [], []
    for table in tables:
        angle, distance = table[:, 3:].T
        best = slice(None) if weights is None else [np.argmax(table[:, :3] @ [1, *weights])]
        degrees.append(angle[best].min())
        adds.append(distance[best].min())
    return {
        "recall_5deg": round(float(np.mean(np.array(degrees) < RECALL_DEG)), 4),
        "recall_adds": round(float(np.mean(np.array(adds) < ADDS_THRESHOLD)), 4),
    }


def main() -> None:
    """Try all weights on all protocols."""
    generate = NetworkHypotheses(load_model())
    content: dict[str, object] = {"commit": commit(), "points": 512}
    for protocol, count in PAIRS.items():
        pairs = held_out_pairs(protocol, count, _SEED)
        tables = [
            candidates(pairs, index, generate)
            for index in track(range(len(pairs)), protocol, transient=True)
        ]
        without_truth = [table[:-1] for table in tables]
        tried = {f"{a}, {b}": recalls(without_truth, (a, b)) for a, b in WEIGHTS}
        tried["best candidate"] = recalls(without_truth, None)
        tried["the truth, after ICP"] = recalls([table[-1:] for table in tables], None)
        tried[f"{IN_USE[0]}, {IN_USE[1]}, the truth among the candidates"] = recalls(tables, IN_USE)
        count = float(np.mean([len(table) for table in without_truth]))
        content[protocol] = {"pairs": len(pairs), "candidates": count, "weights": tried}
        print(protocol, json.dumps(tried, indent=1), flush=True)
    PATH.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
