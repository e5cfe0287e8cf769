import pytest
import torch
from conftest import random_rotation

from corrmat.data.datamodule import RegistrationDataModule
from corrmat.errors import CorrmatError
from corrmat.losses import CorrespondenceLoss, RegistrationLoss, registration_loss
from corrmat.methods import RPMNet, RPMNetCorr
from corrmat.metrics import match_accuracy, rotation_error_deg
from corrmat.networks.rpmnet import RPMNetwork
from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.types import PairBatch, Prediction


def small(**options):
    torch.manual_seed(0)
    return RPMNetwork(width=8, k=6, radius=0.8, annealing_width=16, **options)


def pair(generator, n=12, m=15):
    """A cloud with normals, moved: the first n points of the target are the source's."""
    target = torch.randn(2, m, 6, generator=generator)
    target[..., 3:] /= target[..., 3:].norm(dim=-1, keepdim=True)
    rotation = random_rotation(2, generator).float()
    translation = torch.tensor([[0.1, 0.2, 0.3], [0.0, -0.3, 0.2]])
    xyz = (target[:, :n, :3] - translation.unsqueeze(1)) @ rotation
    source = torch.cat([xyz, target[:, :n, 3:] @ rotation], -1)
    match = torch.arange(n).expand(2, n)
    clean, shape = source[..., :3], torch.zeros(2, dtype=torch.int64)
    return PairBatch(source, target, rotation, translation, match, clean, shape)


@pytest.mark.parametrize("loss", [CorrespondenceLoss, RegistrationLoss])
def test_turns_shapes_and_finite_gradients(loss, generator):
    network, batch = small().train(), pair(generator)
    prediction = network(batch.source, batch.target)
    assert len(prediction.steps) == 2
    assert len(network.eval()(batch.source, batch.target).steps) == 5
    assert prediction.steps[-1] is prediction
    assert prediction.correspondence.prob().shape == (2, 12, 15)
    loss().loss(prediction, batch).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_targets_features_are_computed_once(generator, monkeypatch):
    network, batch = small(), pair(generator)
    sizes = []
    network.embed.register_forward_hook(lambda module, args, out: sizes.append(out.shape[1]))
    network.eval()(batch.source, batch.target)
    assert sizes == [15] + [12] * 5


def test_a_turn_does_not_see_the_gradient_of_the_turn_before(generator):
    """The source is moved by the detached transform."""
    network, batch = small().train(), pair(generator)
    prediction = network(batch.source, batch.target)
    first, second = prediction.steps
    leaves = torch.autograd.grad(
        second.correspondence.beta.sum(), first.rotation, allow_unused=True
    )
    assert leaves == (None,)


def test_pair_features_do_not_see_a_rotation_of_the_cloud(generator):
    batch = pair(generator)
    network = small().eval()
    network.embed.edge[0].weight.data[:, :6] = 0  # leave pair features only
    with torch.no_grad():
        prediction = network(batch.source, batch.target)
        turn = random_rotation(2, generator).float()
        source = torch.cat([batch.source[..., i : i + 3] @ turn.mT for i in (0, 3)], -1)
        again = network(source, batch.target)
    torch.testing.assert_close(
        again.steps[0].correspondence.feature_source,
        prediction.steps[0].correspondence.feature_source,
        atol=1e-4, rtol=1e-4,
    )  # fmt: skip


def test_clouds_without_normals_are_refused():
    with pytest.raises(ValueError, match="needs normals"):
        small()(torch.zeros(1, 10, 3), torch.zeros(1, 10, 3))
    with pytest.raises(CorrmatError, match="not a multiple of 8"):
        RPMNetwork(width=12)


def test_a_perfect_prediction_has_no_registration_loss(generator):
    batch = pair(generator, 15, 15)
    c = SoftCorrespondence(1e3 * torch.eye(15).expand(2, -1, -1), torch.eye(15).expand(2, -1, -1))
    perfect = Prediction(batch.rotation, batch.translation, c)
    assert registration_loss(perfect, batch) < 1e-6
    off = Prediction(batch.rotation, batch.translation + 0.3, c)
    torch.testing.assert_close(registration_loss(off, batch), torch.tensor(0.3))


def test_an_earlier_turn_counts_half(generator):
    batch = pair(generator, 15, 15)
    c = SoftCorrespondence(1e3 * torch.eye(15).expand(2, -1, -1), torch.eye(15).expand(2, -1, -1))
    early, middle, last = (
        Prediction(batch.rotation, batch.translation + shift, c) for shift in (0.4, 0.2, 0.1)
    )
    last.earlier = (early, middle)
    expected = torch.tensor(0.25 * 0.4 + 0.5 * 0.2 + 0.1)
    torch.testing.assert_close(RegistrationLoss().loss(last, batch), expected)


def test_the_papers_settings():
    network = RPMNetCorr().network
    assert (network.k, network.radius, network.iterations, network.test_iterations) == (
        64,
        0.3,
        2,
        5,
    )
    assert network.embed.out.out_channels == 96
    assert (RPMNet().optimizer_settings.lr, RPMNetCorr().optimizer_settings.lr) == (1e-4, 1e-2)
    last = RPMNetCorr().optimizer_settings
    assert last.lr * last.gamma ** len(last.milestones) == pytest.approx(1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("method", [RPMNet, RPMNetCorr])
def test_rpmnet_overfits_eight_pairs(method):
    torch.manual_seed(0)
    data = RegistrationDataModule(num_points=64, batch_size=8, test_shapes=8)
    batch = next(iter(data.test_dataloader()))
    module = method({"width": 32, "k": 8, "radius": 0.5, "annealing_width": 64}).train()
    adam = torch.optim.Adam(module.parameters(), 2e-3)
    for _ in range(250):
        loss = module.loss(module(batch.source, batch.target), batch)
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        adam.step()
    module.eval()
    with torch.no_grad():
        prediction = module(batch.source, batch.target)
    assert rotation_error_deg(prediction.rotation, batch.rotation).median() < 2
    if method is RPMNetCorr:
        hits = match_accuracy(prediction.correspondence.argmax(), batch.match, 64)
        assert hits.mean() > 0.9
