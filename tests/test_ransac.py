"""RANSAC: transforms out of many wrong matches."""

import torch
from conftest import random_rotation

from corrmat.ops.ransac import best_by_matches, fit_triples


def ransac(x, y, weight, inlier_threshold, *, generator, count=8):
    """What `NetworkHypotheses` does with matches."""
    given = x, y, weight, inlier_threshold
    return best_by_matches(*fit_triples(*given, generator=generator), *given, count)


def matches(generator, count=200, wrong=0.7, noise=0.01):
    rotation, translation = random_rotation(1, generator)[0], torch.tensor([0.3, -0.2, 0.1])
    x = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    y = x @ rotation.T + translation
    y += noise * torch.randn(y.shape, generator=generator, dtype=torch.float64)
    bad = torch.rand(count, generator=generator) < wrong
    y[bad] = torch.rand(int(bad.sum()), 3, generator=generator, dtype=torch.float64) - 0.5
    return rotation, translation, x, y


def angle_deg(a, b):
    return torch.rad2deg(torch.arccos(((a.T @ b).trace().clamp(-1, 3) - 1) / 2))


def test_the_best_motion_is_the_truth_among_seven_tenths_wrong(generator):
    rotation, translation, x, y = matches(generator)
    estimate, shift = ransac(x, y, torch.ones(len(x)), 0.05, generator=generator)
    assert angle_deg(estimate[0], rotation) < 1
    assert (shift[0] - translation).norm() < 0.02


def test_motions_that_are_returned_differ(generator):
    _, _, x, y = matches(generator, wrong=0.9)
    rotation, _ = ransac(x, y, torch.ones(len(x)), 0.1, generator=generator, count=5)
    assert 1 < len(rotation) <= 5
    for i in range(len(rotation)):
        for j in range(i):
            assert angle_deg(rotation[i], rotation[j]) > 9.9
    assert torch.allclose(torch.det(rotation), torch.ones(len(rotation), dtype=rotation.dtype))


def test_weights_decide_between_two_motions(generator):
    """Half the matches follow one motion, half another: the heavier half wins."""
    one, shift, x, y = matches(generator, wrong=0)
    other = random_rotation(1, generator)[0]
    y[100:] = x[100:] @ other.T
    weight = torch.ones(200)
    weight[100:] = 0.3
    rotation, _ = ransac(x, y, weight, 0.05, generator=generator)
    assert angle_deg(rotation[0], one) < 1
    assert angle_deg(rotation[1], other) < 1


def test_the_same_generator_gives_the_same_motions(generator):
    _, _, x, y = matches(generator)
    twice = [
        ransac(x, y, torch.ones(len(x)), 0.05, generator=torch.Generator().manual_seed(3))
        for _ in range(2)
    ]
    assert all((a == b).all() for a, b in zip(*twice, strict=True))


def test_matches_that_no_rigid_motion_explains_give_none(generator):
    x = torch.rand(30, 3, generator=generator)
    for y, weight in ((10 * x, torch.ones(30)), (x, torch.zeros(30))):
        rotation, shift = ransac(x, y, weight, 0.01, generator=generator)
        assert rotation.shape == (0, 3, 3)
        assert shift.shape == (0, 3)


def test_points_on_a_line_are_laid_on_each_other(generator):
    """How they turn about their line nobody can say; that they meet, everybody."""
    x = torch.rand(30, 1, generator=generator) * torch.tensor([1.0, 2.0, 3.0])
    rotation, shift = ransac(x, x, torch.ones(30), 0.01, generator=generator)
    moved = x.double() @ rotation[0].T + shift[0]
    torch.testing.assert_close(moved, x.double())
