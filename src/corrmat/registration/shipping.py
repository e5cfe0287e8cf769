"""A trained checkpoint becomes the weights of the package: tensors and a calibration."""

import json
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from corrmat import weights
from corrmat.metrics import ADDS_THRESHOLD
from corrmat.registration import benchmark
from corrmat.reporting.provenance import commit

CALIBRATION_PAIRS = 300


def ship(checkpoint: Path) -> None:
    """Calibrate the confidence of a checkpoint and write its weights into the package.

    Nothing is written before the calibration is done.

    Args:
        checkpoint: of `corrmat fit`.
    """
    _, hparams, network = weights.checkpoint_network(checkpoint)
    calibration = calibrate(checkpoint)
    path = weights.ship_network(
        "corrmat", "Invariant_corr", hparams, network,
        commit=str(commit()), calibration=json.dumps(calibration),
    )  # fmt: skip
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def calibrate(checkpoint: Path) -> dict[str, list[float]]:
    """Fit the chance that a pair is aligned to its agreement and support.

    Logistic regression on validation pairs of two difficulties; `weights.Calibration` applies it.

    Args:
        checkpoint: of the model.

    Returns:
        Coefficients over (agreement, support, 1) and over (agreement, 1).
    """
    scores, aligned = [], []
    for protocol in ("real", "clean"):
        pairs = benchmark.frozen_pairs(protocol, count=CALIBRATION_PAIRS // 2, split="val")
        result = benchmark.compare(pairs, [str(checkpoint)])[str(checkpoint)].per_pair
        scores += zip(result["agreement"], result["support"], strict=True)
        aligned += [distance < ADDS_THRESHOLD for distance in result["adds"]]
    x = np.column_stack([np.array(scores), np.ones(len(scores))])
    y = np.array(aligned, float)
    return {"both": _fit_logistic(x, y), "agreement": _fit_logistic(x[:, [0, 2]], y)}


def _fit_logistic(x: np.ndarray, y: np.ndarray) -> list[float]:
    """Fit the coefficients of a logistic curve, with slight shrinkage for separable classes."""

    def loss(coefficients: np.ndarray) -> float:
        logit = x @ coefficients
        return float(np.mean(np.logaddexp(0, logit) - y * logit) + 1e-4 * (coefficients**2).sum())

    return minimize(loss, np.zeros(x.shape[1])).x.tolist()
