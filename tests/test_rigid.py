import numpy as np
import pytest
import torch
from conftest import random_rotation
from scipy.spatial.transform import Rotation
from twins import procrustes_loop

from corrmat.ops import rigid


def test_axis_angle_is_scipys_rotation_vector(generator):
    axis = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    axis = axis / axis.norm(dim=1, keepdim=True)
    angle = torch.linspace(-torch.pi, torch.pi, 50, dtype=torch.float64)
    expected = Rotation.from_rotvec((axis * angle[:, None]).numpy()).as_matrix()
    np.testing.assert_allclose(rigid.axis_angle_to_matrix(axis, angle), expected, atol=1e-14)


def test_compose_chains(generator):
    r, s = random_rotation(4, generator), random_rotation(4, generator)
    t, u = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    x = torch.randn(4, 9, 3, generator=generator, dtype=torch.float64)
    both = rigid.compose((s, u), (r, t))
    torch.testing.assert_close(rigid.apply(*both, x), rigid.apply(s, u, rigid.apply(r, t, x)))


def test_homogeneous_matrices_move_as_apply_does(generator):
    r, t = random_rotation(4, generator), torch.randn(4, 3, generator=generator)
    x = torch.randn(4, 9, 3, generator=generator, dtype=torch.float64)
    matrix = rigid.to_homogeneous(r, t)
    assert matrix.shape == (4, 4, 4)
    assert matrix.dtype == np.float64
    moved = np.concatenate([x.numpy(), np.ones((4, 9, 1))], -1) @ matrix.swapaxes(1, 2)
    np.testing.assert_allclose(moved[..., :3], rigid.apply(r, t.double(), x), atol=1e-12)
    np.testing.assert_array_equal(moved[..., 3], 1)


def test_procrustes_recovers_the_motion(generator):
    x = torch.randn(8, 5, 3, generator=generator, dtype=torch.float64)
    r, t = (
        random_rotation(8, generator),
        torch.randn(8, 3, generator=generator, dtype=torch.float64),
    )
    found_r, found_t = rigid.procrustes(x, rigid.apply(r, t, x))
    torch.testing.assert_close(found_r, r)
    torch.testing.assert_close(found_t, t)


def test_procrustes_agrees_with_scipy_on_noisy_weighted_points(generator):
    x, y = torch.randn(2, 6, 20, 3, generator=generator, dtype=torch.float64)
    w = torch.rand(6, 20, generator=generator, dtype=torch.float64)
    actual, _ = rigid.procrustes(x, y, w)
    for i in range(6):
        cx, cy = (w[i] @ x[i]) / w[i].sum(), (w[i] @ y[i]) / w[i].sum()
        expected, _ = Rotation.align_vectors((y[i] - cy).numpy(), (x[i] - cx).numpy(), w[i].numpy())
        np.testing.assert_allclose(actual[i], expected.as_matrix(), atol=1e-9)


def test_procrustes_and_gradients_equal_the_loop_through_the_svd(generator):
    x, y = torch.randn(2, 5, 12, 3, generator=generator, dtype=torch.float64)
    w = torch.rand(5, 12, generator=generator, dtype=torch.float64) + 0.1
    pull_r = torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    pull_t = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    gradients = []
    for solve in (rigid.procrustes, procrustes_loop):
        inputs = [v.clone().requires_grad_() for v in (x, y, w)]
        r, t = solve(*inputs)
        ((r * pull_r).sum() + (t * pull_t).sum()).backward()
        gradients.append([r.detach(), t.detach(), *(v.grad for v in inputs)])
    for fast, naive in zip(*gradients, strict=True):
        torch.testing.assert_close(fast, naive, rtol=1e-7, atol=1e-9)


def test_procrustes_gradcheck(generator):
    inputs = [
        torch.randn(2, 6, 3, generator=generator, dtype=torch.float64, requires_grad=True),
        torch.randn(2, 6, 3, generator=generator, dtype=torch.float64, requires_grad=True),
        (torch.rand(2, 6, generator=generator, dtype=torch.float64) + 0.1).requires_grad_(),
    ]
    assert torch.autograd.gradcheck(rigid.procrustes, inputs)


def test_equal_singular_values_have_the_true_gradient():
    """A cube's corners: the SVD's own gradient divides by zero here, the rotation's does not."""
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = corners.double().unsqueeze(0)
    target = corners.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda y: rigid.procrustes(corners, y)[0], [target])


@pytest.mark.parametrize("shape", ["one point", "line", "mirrored"])
def test_undetermined_rotations_are_proper_and_their_gradient_finite(shape, generator):
    x = torch.randn(3, 10, 3, generator=generator, dtype=torch.float64)
    if shape == "one point":
        x = x[:, :1].expand(-1, 10, -1)
    elif shape == "line":
        x = x * torch.tensor([1.0, 0, 0], dtype=torch.float64)
    source = x.clone().requires_grad_()
    target = (x * torch.tensor([-1.0, 1, 1]) if shape == "mirrored" else x).clone().requires_grad_()
    r, t = rigid.procrustes(source, target)
    (r.sum() + t.sum()).backward()
    torch.testing.assert_close(torch.det(r), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(r @ r.mT, torch.eye(3).double().expand(3, 3, 3))
    assert source.grad.isfinite().all()
    assert target.grad.isfinite().all()


def test_zero_weights_give_the_identity_and_nan_stays_with_its_pair(generator):
    x = torch.randn(3, 7, 3, generator=generator)
    weight = torch.ones(3, 7)
    weight[0] = 0
    y = x.clone()
    y[1, 2, 0] = torch.nan
    r, _ = rigid.procrustes(x, y, weight)
    torch.testing.assert_close(r[0], torch.eye(3))
    assert r[1].isnan().all()
    torch.testing.assert_close(r[2], torch.eye(3))
