from dataclasses import replace

import numpy as np
import pytest
import torch

from corrmat import load_model
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.data.pairs import STREAM, Key, make_pairs
from corrmat.networks.verification import EVIDENCE, VerificationNetwork
from corrmat.registration import benchmark
from corrmat.registration.hypotheses import NetworkHypotheses
from corrmat.registration.preparation import prepare_clouds
from corrmat.registration.verification import evidence, verify
from corrmat.registration.verification_training import candidate_set
from corrmat.weights import load_verification


@pytest.fixture(scope="module")
def generate():
    return NetworkHypotheses(load_model())


@pytest.fixture(scope="module")
def pairs():
    clouds = RegistrationDataModule("shapes", train_shapes=20).clouds("train")
    settings = replace(benchmark.PROTOCOLS["real"], num_points=512)
    return make_pairs(clouds, [3], [Key(0, STREAM["train"], 0, 3)], settings)


@pytest.fixture(scope="module")
def registered(generate, pairs):
    source, target = (c[0].double().numpy() for c in (pairs.source, pairs.target))
    clouds = prepare_clouds(source, target, 0)
    (scorer,) = clouds.scorers
    return generate(*clouds.subsamples, 0), clouds.subsamples, scorer


def test_the_order_of_points_does_not_matter():
    torch.manual_seed(0)
    network = VerificationNetwork(width=8, layers=2, features=4).eval()
    points, transforms = 12, 3
    features, seen = torch.randn(points, 4), torch.randn(transforms, points, EVIDENCE)
    nearest = torch.randint(points, (transforms, points))
    order = torch.randperm(points)
    place = order.argsort()  # where each point went
    again = network(features[order], seen[:, order], place[nearest[:, order]])
    torch.testing.assert_close(again, network(features, seen, nearest))
    other = network(features, seen, nearest.roll(1, 1))
    assert not torch.allclose(again, other)


def test_transforms_are_scored_one_by_one(registered):
    hypotheses, subsamples, _ = registered
    together = verify(hypotheses.transforms[:3], hypotheses, subsamples)
    alone = [verify(each[None], hypotheses, subsamples)[0] for each in hypotheses.transforms[:3]]
    np.testing.assert_allclose(together, alone, atol=1e-4)


def test_evidence_tells_points_on_each_other_from_points_apart(registered):
    hypotheses, (source, _), _ = registered
    apart = np.eye(4)
    apart[:3, 3] = 3.0
    itself = hypotheses._replace(
        prob=torch.eye(len(source)),
        unmatched_nll=(hypotheses.unmatched_nll[0],) * 2,
        features=(hypotheses.features[0],) * 2,
    )
    _, seen, nearest = evidence(np.stack([np.eye(4), apart]), itself, (source, source))
    near, far, parallel, residual = (seen[..., i] for i in (0, 2, 3, 10))
    assert torch.all(near[0] == 1)
    assert torch.all(near[1] < 1e-6)
    assert torch.all(far[0] == 0)
    assert torch.all(far[1] == 1)  # as far as it is told
    torch.testing.assert_close(parallel[0], torch.ones_like(parallel[0]))
    assert torch.all(residual[0] < 2e-3)  # from squares, in float32
    half = seen.shape[1] // 2
    assert torch.equal(nearest[0], torch.arange(2 * half).roll(half))


def test_the_truth_is_the_last_candidate_and_right(pairs, generate):
    sets = candidate_set(pairs, generate)
    assert sets.right[-1]
    assert len(sets.right) == len(sets.evidence) == len(sets.nearest)
    assert not sets.right.all()
    assert torch.isfinite(sets.evidence).all()


def test_the_shipped_network_prefers_the_truth(pairs, generate):
    sets = candidate_set(pairs, generate)
    assert generate.verification is not None
    logits = generate.verification(
        sets.features.float(), sets.evidence.float(), sets.nearest.long()
    )
    assert sets.right[logits.argmax()]


def test_it_verifies_its_own_matching_network_alone():
    network = load_model()
    assert load_verification(network) is not None
    with torch.no_grad():
        next(network.parameters()).flatten()[0] += 1e-3
    assert load_verification(network) is None
    assert load_verification(load_model("1.2/DCP_corr")) is None
