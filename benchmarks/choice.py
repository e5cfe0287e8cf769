"""How much coherence and support should count when `corrmat register` chooses a candidate.

    python benchmarks/choice.py        minutes

Candidates are compared by agreement + a * coherence + b * support (`registration/register.py`).
This tries weights on pairs of training shapes that were held out of the training of the network,
and writes results/register/choice.json: the recall at 5 degrees and by ADD-S for each (a, b), and
that of the best candidate of every pair, which no choice can exceed.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import track

from corrmat.data.datamodule import RegistrationDataModule
from corrmat.data.pairs import STREAM, Key, make_pairs
from corrmat.metrics import ADDS_THRESHOLD, RECALL_DEG
from corrmat.registration import benchmark
from corrmat.registration.hypotheses import NetworkHypotheses
from corrmat.registration.register import measure_candidates, prepare_clouds, to_original_units
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
PAIRS = {"real": 400, "views": 300, "clean": 100}
_SEED = 5  # of pairs that nothing else uses


def held_out_pairs(protocol: benchmark.Protocol, count: int) -> PairBatch:
    """Make pairs of the families' shapes that `make weights` holds out for validation."""
    clouds = RegistrationDataModule(data="shapes+assemblies").clouds("val")
    families = np.flatnonzero([clouds.names[label] != "assembly" for label in clouds.labels])
    chosen = families[np.linspace(0, len(families) - 1, count).round().astype(int)].tolist()
    keys = [Key(_SEED, STREAM["val"], 0, shape) for shape in chosen]
    return make_pairs(clouds, chosen, keys, replace(benchmark.PROTOCOLS[protocol], num_points=512))


def candidates(pairs: PairBatch, index: int, generate: NetworkHypotheses) -> np.ndarray:
    """Compute agreement, coherence, support, degrees and ADD-S of a pair's candidates (T, 5)."""
    source, target = (c[index].double().numpy() for c in (pairs.source, pairs.target))
    (x, y), scale, subsamples, scorer = prepare_clouds(source, target, 0)
    transforms, measures = measure_candidates(generate(*subsamples, 0), subsamples, scorer)
    in_units = [to_original_units(t, scale, x.centre, y.centre) for t in transforms]
    return np.hstack([measures, [benchmark.errors(pairs, index, t) for t in in_units]])


def recalls(tables: list[np.ndarray], weights: tuple[float, float] | None) -> dict[str, float]:
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
        pairs = held_out_pairs(protocol, count)
        tables = [
            candidates(pairs, index, generate)
            for index in track(range(len(pairs)), protocol, transient=True)
        ]
        tried = {f"{a}, {b}": recalls(tables, (a, b)) for a, b in WEIGHTS}
        tried["best candidate"] = recalls(tables, None)
        content[protocol] = {"pairs": len(pairs), "weights": tried}
        print(protocol, json.dumps(tried, indent=1), flush=True)
    PATH.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
