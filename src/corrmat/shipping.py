"""A trained checkpoint becomes the weights of the package: tensors, calibration, model card."""

import json
from pathlib import Path

import numpy as np
import safetensors.torch
from scipy.optimize import minimize

from corrmat import comparison, record
from corrmat.files import replace_bytes
from corrmat.weights import SHIPPED, own_checkpoint

CALIBRATION_PAIRS = 300


def ship(checkpoint: Path) -> None:
    """Write the weights into the package, and calibrate their confidence.

    Args:
        checkpoint: of `corrmat fit`, its settings.yaml beside it.
    """
    method, hparams, network = own_checkpoint(checkpoint)
    state = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    about = {"method": method, "network": json.dumps(hparams), "commit": str(record.commit())}
    SHIPPED.parent.mkdir(exist_ok=True)
    before = SHIPPED.read_bytes() if SHIPPED.is_file() else None
    try:
        # The weights are registered with before anybody knows how far to trust them.
        about["calibration"] = json.dumps({"both": [1, 1, -1], "agreement": [1, -0.5]})
        replace_bytes(SHIPPED, safetensors.torch.save(state, about))
        about["calibration"] = json.dumps(calibrate())
        replace_bytes(SHIPPED, safetensors.torch.save(state, about))
    except BaseException:  # Ctrl-C as well: weights that nobody has judged are not left there
        if before is not None:
            replace_bytes(SHIPPED, before)
        raise
    print(f"{SHIPPED}: {SHIPPED.stat().st_size / 1e6:.1f} MB")


def calibrate() -> dict[str, list[float]]:
    """Fit the chance that a pair is registered to agreement and support.

    On validation pairs of two difficulties, by logistic regression; `registration.calibrated`
    reads it.

    Returns:
        Coefficients over (agreement, support, 1) and over (agreement, 1).
    """
    rows, right = [], []
    for protocol in ("real", "clean"):
        pairs = comparison.frozen_pairs(protocol, count=CALIBRATION_PAIRS // 2, split="val")
        found = comparison.compare(pairs, ["corrmat"])["corrmat"]["per_pair"]
        rows += zip(found["agreement"], found["support"], strict=True)
        right += [near < comparison.NEAR for near in found["adds"]]
    x = np.column_stack([np.array(rows), np.ones(len(rows))])
    y = np.array(right, float)
    return {"both": _logistic(x, y), "agreement": _logistic(x[:, [0, 2]], y)}


def _logistic(x: np.ndarray, y: np.ndarray) -> list[float]:
    """Coefficients of a logit, with a breath of shrinkage where the classes part cleanly."""

    def loss(coefficients: np.ndarray) -> float:
        logit = x @ coefficients
        return float(np.mean(np.logaddexp(0, logit) - y * logit) + 1e-4 * (coefficients**2).sum())

    return minimize(loss, np.zeros(x.shape[1])).x.tolist()
