import pytest
import torch
from twins import sinkhorn_padded

from corrmat.losses import correspondence_loss
from corrmat.ops import streaming
from corrmat.ops.correspondence import SinkhornCorrespondence
from corrmat.ops.sinkhorn import sinkhorn_potentials


def sinkhorn(affinity, iterations, slack):
    """The logarithm of the normalised matrix; its rows and unit vectors have it as products."""
    unit = torch.eye(affinity.shape[2], dtype=affinity.dtype).expand(len(affinity), -1, -1)
    u, v = sinkhorn_potentials(affinity, unit, iterations, slack)
    return affinity - u.unsqueeze(2) - v.unsqueeze(1)


def affinity(generator):
    return 3 * torch.randn(2, 6, 8, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("slack", ["row", "both", "none"])
@pytest.mark.parametrize("iterations", [0, 1, 5])
def test_potentials_equal_the_padded_matrix_in_value_and_gradient(
    slack, iterations, whole, generator, monkeypatch
):
    if not whole:
        monkeypatch.setattr(streaming, "_DENSE", 0)
        monkeypatch.setattr(streaming, "_SLICE", 20)
    a = affinity(generator).requires_grad_()
    pull = torch.randn(a.shape, generator=generator, dtype=torch.float64)
    fast, naive = sinkhorn(a, iterations, slack), sinkhorn_padded(a, iterations, slack)
    torch.testing.assert_close(fast, naive)
    gradients = [torch.autograd.grad((value * pull).sum(), a)[0] for value in (fast, naive)]
    torch.testing.assert_close(*gradients)


def test_gradient_is_the_derivative(generator):
    a = affinity(generator)[:1, :3, :4].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: sinkhorn(x, 2, "both"), a)


def test_without_slack_a_square_matrix_becomes_doubly_stochastic(generator):
    p = sinkhorn(affinity(generator)[:, :, :6], 200, "none").exp()
    ones = torch.ones(2, 6, dtype=torch.float64)
    torch.testing.assert_close(p.sum(1), ones)
    torch.testing.assert_close(p.sum(2), ones)


def test_a_slack_row_leaves_targets_without_a_match(generator):
    p = sinkhorn(affinity(generator), 100, "row").exp()
    torch.testing.assert_close(p.sum(2), torch.ones(2, 6, dtype=torch.float64))
    assert (p.sum(1) < 1).all()


def test_large_affinities_stay_finite():
    a = torch.tensor([[[1e4, -1e4], [-1e4, 1e4]]]).requires_grad_()
    p = sinkhorn(a, 5, "row")
    p.exp().sum().backward()
    assert p.exp().isfinite().all()
    assert a.grad.isfinite().all()


def correspondence(generator, beta=20.0, alpha=0.5):
    f_x, f_y = (
        torch.nn.functional.normalize(torch.randn(2, n, 8, generator=generator), dim=-1)
        for n in (5, 7)
    )
    scalars = torch.full((2,), beta), torch.full((2,), alpha)
    return SinkhornCorrespondence(f_x, f_y, *scalars, iterations=5, slack="row")


def test_the_matrix_answers_consistently(generator):
    c, y = correspondence(generator), torch.randn(2, 7, 3, generator=generator)
    p = c.prob()
    torch.testing.assert_close(c.logits(), p.log())
    torch.testing.assert_close(c.weight(), p.sum(-1))
    torch.testing.assert_close(c.soft_target(y), (p / p.sum(-1, keepdim=True)) @ y)
    assert torch.equal(c.argmax(), p.argmax(-1))
    index = torch.randint(0, 7, (2, 5), generator=generator)
    index[:, 0] = -1
    nll = c.nll(index)
    assert (nll[:, 0] == 0).all()
    torch.testing.assert_close(nll[:, 1:], -p.log()[:, 1:].gather(2, index[:, 1:, None]).squeeze(2))
    torch.testing.assert_close(correspondence_loss(c, index), nll[:, 1:].mean())


def test_the_loss_does_not_stop_where_a_probability_underflows(generator):
    """log(exp(.) + eps) would be flat there: the gradient must still pull."""
    c = correspondence(generator, beta=400.0)
    c.feature_source.requires_grad_()
    index = c.logits().argmin(-1)
    assert (c.prob().gather(2, index.unsqueeze(2)) == 0).any()
    loss = c.nll(index).mean()
    assert loss > 100
    assert torch.autograd.grad(loss, c.feature_source)[0].abs().sum() > 0
