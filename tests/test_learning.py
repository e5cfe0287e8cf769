"""Slow: does a method learn, by the Trainer, what it is trained on? (make test-slow)"""

import lightning
import pytest
import torch

from corrmat.data.datamodule import RegistrationDataModule
from corrmat.methods import METHODS
from corrmat.metrics import match_accuracy, rotation_error_deg

pytestmark = pytest.mark.slow

DCP = {"width": 64, "feedforward": 128, "edge_channels": (32, 32, 32, 64), "k": 8}
RPMNET = {"width": 32, "k": 12, "annealing_width": 64}
PCRNET = {"width": 128}
INVARIANT = {"width": 32, "heads": 2, "layers": 1, "anchors": 16, "neighbors": 4}


def train(name, network, steps, lr, rotation_deg):
    """Train a small network on eight pairs, again and again.

    Returns:
        Its loss before and after; its pairs' share of right matches (or None) and median rotation
        error in degrees after. All in training mode: DCP's batch norm shares running statistics
        between source and target, so that eight pairs learnt by heart score worse with them.
    """
    lightning.seed_everything(0)
    data = RegistrationDataModule(
        num_points=32, batch_size=8, rotation_deg=rotation_deg, train_shapes=100, test_shapes=8
    )
    pairs = data.test_dataloader()
    batch = next(iter(pairs))
    method = METHODS[name](network, optimizer={"lr": lr, "weight_decay": 0.0}).train()
    before = float(method.loss(method(batch.source, batch.target), batch).detach())
    lightning.Trainer(
        accelerator="cpu", devices=1, max_steps=steps, max_epochs=-1, gradient_clip_val=1.0,
        logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    ).fit(method, pairs)  # fmt: skip
    method.train()
    with torch.no_grad():
        prediction = method(batch.source, batch.target)
        after = float(method.loss(prediction, batch))
    right = None
    if prediction.correspondence is not None:
        right = float(match_accuracy(prediction.correspondence.argmax(), batch.match, 32).mean())
    error = rotation_error_deg(prediction.rotation, batch.rotation).median()
    return before, after, right, float(error)


@pytest.mark.parametrize(
    ("name", "network", "steps", "lr", "rotation_deg", "loss_left", "right", "error_deg"),
    [
        ("DCP_corr", DCP, 300, 1e-3, 180.0, 0.05, 0.95, 1.0),
        ("DCP", DCP, 500, 1e-3, 180.0, 0.05, None, 2.0),
        ("RPMNet_corr", RPMNET, 300, 3e-3, 45.0, 0.01, 0.99, 0.1),
        ("RPMNet", RPMNET, 300, 3e-3, 45.0, 0.05, None, 0.5),
        # A feature of PCRNet_corr sees its own point alone (paper section 5.3).
        ("PCRNet_corr", PCRNET, 300, 1e-3, 45.0, 0.5, 0.7, 3.0),
        ("PCRNet", PCRNET, 500, 3e-4, 45.0, 0.7, None, 15.0),
        ("Invariant_corr", INVARIANT, 300, 3e-3, 180.0, 0.2, 0.95, 0.5),
    ],
)
def test_a_method_learns_eight_pairs_by_heart(
    name, network, steps, lr, rotation_deg, loss_left, right, error_deg
):
    before, after, matches, error = train(name, network, steps, lr, rotation_deg)
    assert after < loss_left * before
    assert error < error_deg
    if right is not None:
        assert matches > right
