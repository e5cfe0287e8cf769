import pytest
import torch
from twins import cross_entropy_by_one_hot

from corrmat.losses import correspondence_loss, transformation_loss
from corrmat.ops.correspondence import SoftCorrespondence


def features(generator):
    f_x = torch.randn(2, 7, 16, generator=generator, dtype=torch.float64, requires_grad=True)
    f_y = torch.randn(2, 9, 16, generator=generator, dtype=torch.float64, requires_grad=True)
    return f_x, f_y, torch.randint(0, 9, (2, 7), generator=generator)


def test_nll_is_the_papers_formula_in_value_and_gradient(generator):
    f_x, f_y, index = features(generator)
    fast = SoftCorrespondence(f_x, f_y, 0.25).nll(index)
    naive = cross_entropy_by_one_hot(f_x, f_y, 0.25, index)
    torch.testing.assert_close(fast, naive)
    for a, b in zip(
        torch.autograd.grad(fast.sum(), (f_x, f_y)),
        torch.autograd.grad(naive.sum(), (f_x, f_y)),
        strict=True,
    ):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("first", ["argmax", "weight", "prob", "logits"])
def test_what_was_read_without_gradients_has_them_in_the_loss(first, generator):
    f_x, f_y, index = features(generator)
    expected = torch.autograd.grad(correspondence_loss(SoftCorrespondence(f_x, f_y), index), f_x)
    c = SoftCorrespondence(f_x, f_y)
    with torch.no_grad():
        getattr(c, first)()
    torch.testing.assert_close(torch.autograd.grad(correspondence_loss(c, index), f_x), expected)
    assert c.prob().requires_grad


def test_rows_are_distributions_and_the_rest_follows_from_them(generator):
    f_x, f_y, _ = features(generator)
    c = SoftCorrespondence(f_x, f_y, 0.5)
    y = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(c.prob().sum(-1), torch.ones(2, 7, dtype=torch.float64))
    torch.testing.assert_close(c.prob(), c.logits().softmax(-1))
    torch.testing.assert_close(c.soft_target(y), torch.einsum("bnm,bmd->bnd", c.prob(), y))
    assert torch.equal(c.argmax(), c.prob().argmax(-1))
    assert c.argmax().dtype == torch.int64


def test_rows_without_a_match_neither_cost_nor_pull(generator):
    f_x, f_y, index = features(generator)
    index[:, 0] = -1
    c = SoftCorrespondence(f_x, f_y)
    assert (c.nll(index)[:, 0] == 0).all()
    gradient = torch.autograd.grad(correspondence_loss(c, index), f_x)[0]
    assert (gradient[:, 0] == 0).all()
    torch.testing.assert_close(correspondence_loss(c, index), c.nll(index)[:, 1:].mean())
    assert correspondence_loss(c, torch.full_like(index, -1)) == 0
    outliers = torch.where(index == -1, 9, index)  # no outlier class here: left out as well
    torch.testing.assert_close(correspondence_loss(c, outliers), correspondence_loss(c, index))


def test_half_precision_features_are_compared_in_float32(generator):
    f = torch.randn(1, 4, 8, generator=generator, dtype=torch.bfloat16)
    with torch.autocast("cpu", torch.bfloat16):
        c = SoftCorrespondence(f, f)
        logits = c.logits()
    torch.testing.assert_close(logits, f.float() @ f.float().mT)


def test_logits_far_apart_neither_overflow_nor_lose_the_loss():
    f_x, f_y = torch.eye(3).unsqueeze(0) * 1e3, torch.eye(3).unsqueeze(0)
    c = SoftCorrespondence(f_x, f_y)
    torch.testing.assert_close(c.nll(torch.tensor([[1, 1, 2]])), torch.tensor([[1e3, 0.0, 0.0]]))


def test_the_true_transform_has_no_transformation_loss(generator):
    rotation, translation = torch.eye(3).expand(4, 3, 3), torch.randn(4, 3, generator=generator)
    assert transformation_loss(rotation, translation, rotation, translation) == 0
    turned = torch.diag(torch.tensor([1.0, -1, -1])).expand(4, 3, 3)
    expected = torch.tensor(8 / 9 + 4)
    actual = transformation_loss(turned, translation + 2, rotation, translation)
    torch.testing.assert_close(actual, expected)


def test_matches_and_features_that_do_not_fit_are_refused():
    x, y = torch.randn(2, 5, 4), torch.randn(2, 6, 4)
    c = SoftCorrespondence(x, y)
    good = torch.zeros(2, 5, dtype=torch.int64)
    assert correspondence_loss(c, good) > 0
    assert correspondence_loss(c, good - 1) == 0  # no row has a class
    for bad in (good + 7, good - 2):
        with pytest.raises(ValueError, match="are not rows of 6 target points"):
            correspondence_loss(c, bad)
    with pytest.raises(ValueError, match="true matches of shape"):
        correspondence_loss(c, good[:1])
    for features in ((x, y[:1]), (x, y[..., :3]), (x[0], y[0])):
        with pytest.raises(ValueError, match="features must be"):
            SoftCorrespondence(*features)
    with pytest.raises(ValueError, match="outlier logits"):
        SoftCorrespondence(x, y, outlier=torch.zeros(2, 5, 1))
