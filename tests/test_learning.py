"""Slow: does a method learn what it is trained on? (make test-slow)"""

import pytest
import torch

from corrmat.data.datamodule import RegistrationDataModule
from corrmat.methods import METHODS
from corrmat.metrics import match_accuracy, rotation_error_deg

pytestmark = pytest.mark.slow


def train(arm, steps, rotation_deg, fresh_pairs):
    """Train a small network; returns the last losses and the state of the 8 pairs."""
    torch.manual_seed(0)
    data = RegistrationDataModule(
        num_points=32, batch_size=8, rotation_deg=rotation_deg, train_shapes=100, test_shapes=8
    )
    train, test = data.train_dataloader(), data.test_dataloader()
    network = {"width": 64, "feedforward": 128, "edge_channels": (32, 32, 32, 64), "k": 8}
    method = METHODS[arm](network)
    adam = torch.optim.Adam(method.parameters(), 1e-3)
    fixed = next(iter(test))
    method.train()
    losses = []
    for step in range(steps):
        train.sampler.set_epoch(step)
        batch = next(iter(train)) if fresh_pairs else fixed
        loss = method.loss(method(batch.source, batch.target), batch)
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(method.parameters(), 1.0)
        adam.step()
        losses.append(loss.item())
    # DCP's batch norm shares running statistics between source and target, so that only pairs
    # like those of training, not eight learnt by heart, score the same in evaluation mode.
    method.train(not fresh_pairs)
    with torch.no_grad():
        found = method(fixed.source, fixed.target)
    hits = match_accuracy(found.correspondence.argmax(), fixed.match, 32).mean().item()
    return losses, hits, rotation_error_deg(found.rotation, fixed.rotation).median().item()


def test_dcp_corr_overfits_eight_pairs():
    losses, hits, error = train("DCP_corr", 300, 180.0, fresh_pairs=False)
    assert losses[-1] < 0.01
    assert hits > 0.95
    assert error < 2


def test_dcp_overfits_eight_pairs():
    losses, _, error = train("DCP", 500, 180.0, fresh_pairs=False)
    assert losses[-1] < 0.05 * losses[0]
    assert error < 15
