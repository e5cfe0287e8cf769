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
    # The weights are registered with before anybody knows how far to trust them.
    about["calibration"] = json.dumps({"slope": 1.0, "offset": 0.0})
    replace_bytes(SHIPPED, safetensors.torch.save(state, about))
    about["calibration"] = json.dumps(calibrate())
    replace_bytes(SHIPPED, safetensors.torch.save(state, about))
    print(f"{SHIPPED}: {SHIPPED.stat().st_size / 1e6:.1f} MB")


def calibrate() -> dict[str, float]:
    """Fit the chance that a pair is registered to how much its clouds agree.

    On validation pairs of two difficulties, by logistic regression; `registration.calibrated`
    reads it.

    Returns:
        slope and offset of the logit.
    """
    agreement, right = [], []
    for protocol in ("real", "clean"):
        pairs = comparison.frozen_pairs(protocol, count=CALIBRATION_PAIRS // 2, split="val")
        found = comparison.compare(pairs, ["corrmat"])["corrmat"]["per_pair"]
        agreement += found["agreement"]
        right += [near < comparison.NEAR for near in found["adds"]]
    x, y = np.array(agreement), np.array(right, float)

    def loss(parameters: np.ndarray) -> float:
        logit = parameters[0] * x + parameters[1]
        return float(np.mean(np.logaddexp(0, logit) - y * logit))

    slope, offset = minimize(loss, np.array([1.0, 0.0])).x
    return {"slope": float(slope), "offset": float(offset)}
