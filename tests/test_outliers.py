import pytest
import torch
from conftest import golden

from corrmat import metrics
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.losses import correspondence_loss
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.matching import MATCHING_HEADS
from corrmat.ops.correspondence import (
    MatchabilityCorrespondence,
    SoftCorrespondence,
    outlier_feature,
)
from corrmat.ops.rigid import procrustes
from corrmat.types import Prediction

WAYS = [name for name in MATCHING_HEADS if name != "none"]


def features(generator):
    f_x = torch.randn(2, 7, 16, generator=generator, dtype=torch.float64, requires_grad=True)
    f_y = torch.randn(2, 9, 16, generator=generator, dtype=torch.float64, requires_grad=True)
    return f_x, f_y


def test_the_outliers_feature_agrees_with_the_reference():
    arrays, _ = golden("outlier_embedding")
    feature = outlier_feature(arrays["feature_target"].mT, float(arrays["b"]))
    torch.testing.assert_close(feature, arrays["outlier_embedding"], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("m", [9, 16, 40])
def test_the_outliers_feature_is_the_least_squares_solution(m, generator):
    f_y = torch.randn(2, m, 16, generator=generator, dtype=torch.float64, requires_grad=True)
    feature = outlier_feature(f_y)
    expected = -(torch.linalg.pinv(f_y) @ torch.ones(2, m, 1, dtype=torch.float64)).squeeze(-1)
    torch.testing.assert_close(feature, expected, rtol=1e-5, atol=1e-5)
    if m <= 16:
        scores = (f_y @ feature.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(scores, -torch.ones_like(scores), rtol=1e-5, atol=1e-5)
    gradient = torch.autograd.grad(feature.sum(), f_y)[0]
    torch.testing.assert_close(
        gradient, torch.autograd.grad(expected.sum(), f_y)[0], rtol=1e-3, atol=1e-3
    )


def test_features_of_zero_have_a_finite_outlier():
    f_y = torch.zeros(1, 5, 4, requires_grad=True)
    feature = outlier_feature(f_y)
    feature.sum().backward()
    assert (feature == 0).all()
    assert f_y.grad.isfinite().all()


@pytest.mark.parametrize("logit", [8.0, 18.0, 60.0])
@pytest.mark.parametrize("log_matrix", [False, True])
def test_an_all_but_certain_outlier_still_has_an_expected_match(log_matrix, logit, generator):
    """In float32, 1 - p_outlier has no digits left; the mean over target points has all of them."""
    f_x, f_y = (f.detach() for f in features(generator))
    y = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    found = {}
    for dtype in (torch.float32, torch.float64):
        x = f_x.to(dtype).requires_grad_()
        out = torch.full((2, 7), logit, dtype=dtype)
        c = (
            MatchabilityCorrespondence(x, f_y.to(dtype), 0.25, -out, torch.zeros(2, 9, dtype=dtype))
            if log_matrix
            else SoftCorrespondence(x, f_y.to(dtype), 0.25, out)
        )
        matched = c.soft_target(y.to(dtype))
        (gradient,) = torch.autograd.grad(matched.square().sum(), x, retain_graph=True)
        found[dtype] = matched, gradient, c.weight().log(), c.nll(torch.zeros(2, 7).long())
    for single, double in zip(found[torch.float32], found[torch.float64], strict=True):
        torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("way", WAYS)
def test_index_m_is_a_class_of_its_own(way, generator):
    torch.manual_seed(0)
    f_x, f_y = features(generator)
    c = MATCHING_HEADS[way](16).double()(f_x, f_y)
    p = c.prob()
    assert p.shape == c.logits().shape == (2, 7, 10)
    assert (p.sum(-1) <= 1 + 1e-9).all()
    assert c.is_class(torch.tensor([-1, 0, 8, 9, 10])).tolist() == [False, True, True, True, False]
    index = torch.tensor([[0, 9, 3, -1, 9, 1, 8]] * 2)
    nll = c.nll(index)
    assert (nll[:, 3] == 0).all()
    torch.testing.assert_close(nll[:, 1], -p[:, 1, 9].log())
    torch.testing.assert_close(correspondence_loss(c, index), nll.sum() / 12)
    y = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    inlier = p[..., :9]
    torch.testing.assert_close(c.soft_target(y), inlier @ y / inlier.sum(-1, keepdim=True))
    torch.testing.assert_close(c.weight(), inlier.sum(-1))
    gradients = torch.autograd.grad(correspondence_loss(c, index), (f_x, f_y))
    assert all(g.isfinite().all() and g.abs().sum() > 0 for g in gradients)


def test_a_row_that_is_all_outlier_has_no_weight(generator):
    f_x, f_y = features(generator)
    logit = torch.full((2, 7), -1e3, dtype=torch.float64)
    logit[:, 2] = 1e3
    c = SoftCorrespondence(f_x, f_y, outlier=logit)
    assert (c.argmax()[:, 2] == 9).all()
    assert (c.weight()[:, 2] == 0).all()
    assert (c.weight()[:, :2] == 1).all()
    assert c.soft_target(torch.ones(2, 9, 3, dtype=torch.float64)).isfinite().all()


def test_matchability_is_lightglues_formula(generator):
    torch.manual_seed(0)
    f_x, f_y = features(generator)
    head = MATCHING_HEADS["matchability"](16).double()
    p = head(f_x, f_y).prob()
    s = f_x @ f_y.mT / 4
    m_x, m_y = head.head(f_x).sigmoid(), head.head(f_y).sigmoid()
    torch.testing.assert_close(p[..., :9], m_x * m_y.mT * s.softmax(1) * s.softmax(2))
    torch.testing.assert_close(p[..., 9:], 1 - m_x)


def outlier_batch():
    data = RegistrationDataModule(
        num_points=40, rotation_deg=45, outliers=0.2, batch_size=4, test_shapes=4, train_shapes=2
    )
    return next(iter(data.test_dataloader()))


@pytest.mark.parametrize("way", ["none", *WAYS])
def test_dcp_learns_with_each_of_them(way):
    torch.manual_seed(0)
    batch = outlier_batch()
    network = DCPNetwork(16, "transformer", 2, 16, (8, 8, 12, 16), 5, way).train()
    prediction = network(batch.source, batch.target)
    loss = correspondence_loss(prediction.correspondence, batch.match)
    (loss + prediction.rotation.sum()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())
    assert (prediction.correspondence.outlier is None) == (way == "none")


def test_perfect_weights_give_the_perfect_pose():
    """Outliers spoil Procrustes unless their weight is taken away."""
    batch = outlier_batch()
    m = batch.target.shape[1]
    assert (batch.match == m).sum() > 20
    one_hot = torch.nn.functional.one_hot(batch.match.clamp_max(m - 1), m).double()
    logit = torch.where(batch.match == m, 500.0, -500.0).double()
    f_y = torch.eye(m, dtype=torch.float64).expand(len(batch), m, m)
    c = SoftCorrespondence(100 * one_hot, f_y, outlier=logit)
    prediction = Prediction(
        *procrustes(batch.source[..., :3], c.soft_target(batch.target[..., :3]), c.weight()),
        correspondence=c,
    )
    scores = metrics.RegistrationMetrics()
    scores.update(prediction, batch)
    values = scores.compute()
    assert values["match_accuracy"] == values["outlier_precision"] == values["outlier_recall"] == 1
    assert values["outlier_r_precision"] == 1
    assert values["rotation_error_deg_mean"] < 1e-3


def test_r_precision_ranks_the_points_by_their_weight():
    weight = torch.tensor([[0.9, 0.1, 0.4, 0.2, 0.3], [0.5, 0.4, 0.3, 0.2, 0.1]])
    match = torch.tensor([[0, 5, 5, 1, -1], [0, 1, 2, 3, 4]])  # two outliers, and none
    assert metrics.outliers_retrieved(weight, match, 5).tolist() == [1, 0]  # of the two lowest, one


def test_precision_and_recall_of_the_outlier_class():
    predicted = torch.tensor([[5, 5, 0, 1, 5]])
    match = torch.tensor([[5, 1, 0, 5, -1]])
    correct, positive, true = metrics.outlier_counts(predicted, match, 5)
    assert (correct.item(), positive.item(), true.item()) == (1, 3, 2)
