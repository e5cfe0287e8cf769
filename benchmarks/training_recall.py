"""Recall of every network that `corrmat register` shipped, against the pairs it was trained on.

    python benchmarks/training_recall.py        minutes

git keeps the weights of earlier runs of `make weights`. All are tested on the same held-out pairs,
with the candidates, choice and refinement of today, but without the verification network, which
belongs to the newest weights alone; `validation` in results/register/training.json is written anew.
"""

import itertools
import json
import subprocess
import tempfile
from pathlib import Path

import safetensors

from corrmat.files import replace_json
from corrmat.registration import benchmark, hypotheses
from corrmat.registration.calibrate import (
    CALIBRATION_PAIRS,
    CALIBRATION_PROTOCOLS,
    held_out_pairs,
)

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = "src/corrmat/shipped/corrmat.safetensors"
TRAINING = ROOT / "results" / "register" / "training.json"
POINTS = 512


def git(*words: str) -> bytes:
    """Run git in the repository and return what it prints."""
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True).stdout


def extract_weights(folder: Path) -> dict[int, Path]:
    """Write the newest weights of each number of training pairs into a folder."""
    weights: dict[int, Path] = {}
    commits = git("log", "--format=%H", "--", WEIGHTS).decode().split()
    committed = (git("show", f"{commit}:{WEIGHTS}") for commit in commits)
    for number, content in enumerate(itertools.chain([(ROOT / WEIGHTS).read_bytes()], committed)):
        path = folder / f"{number}.safetensors"
        path.write_bytes(content)
        with safetensors.safe_open(path, framework="pt") as file:
            pairs = (file.metadata() or {}).get("pairs")
        if pairs is None:
            break  # older weights do not say
        weights.setdefault(int(pairs), path)
    return weights


def main() -> None:
    """Test all networks and write their recalls."""
    runs = json.loads(TRAINING.read_text())
    hypotheses.load_verification = lambda _: None
    tests = {
        protocol: held_out_pairs(protocol, CALIBRATION_PAIRS[POINTS], 0, POINTS)
        for protocol in CALIBRATION_PROTOCOLS
    }
    with tempfile.TemporaryDirectory() as folder:
        weights = extract_weights(Path(folder))
        for run in runs:
            model = str(weights[run["pairs"]])
            run["validation"] = {
                protocol: benchmark.compare(pairs, [model])[model].recall_5deg
                for protocol, pairs in tests.items()
            }
            print(f"{run['pairs']:,} pairs", run["validation"], flush=True)
    replace_json(TRAINING, runs)


if __name__ == "__main__":
    main()
