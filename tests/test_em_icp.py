"""EM-ICP: the last refinement of `corrmat register`."""

import numpy as np
import pytest
import torch
from conftest import random_rotation
from scipy.linalg import expm

import corrmat
from corrmat.data.shapes.dataset import make_shape
from corrmat.registration import em_icp as module
from corrmat.registration.em_icp import em_icp
from corrmat.registration.scoring import AlignmentScorer


def two_samples(shape, count, rng, noise=0.01):
    """Two samples of a shape that share no point, with normals: (count, 6) each."""
    cloud = rng.permutation(make_shape(("train", shape))[0].astype(np.float64))
    cloud[:, :3] += noise * rng.standard_normal((len(cloud), 3))
    return cloud[:count], cloud[count : 2 * count]


def nudged(rng, angle, shift):
    """A small rigid transform (4, 4): radians and units."""
    transform = np.eye(4)
    transform[:3, :3] = expm(np.cross(np.eye(3), angle * unit(rng.standard_normal(3))))
    transform[:3, 3] = shift * unit(rng.standard_normal(3))
    return transform


def unit(vector):
    return vector / np.linalg.norm(vector)


def naive_iteration(transform, source, target, prob):
    """One iteration, match by match, as a linear least-squares problem."""
    x = source[:, :3] @ transform[:3, :3].T + transform[:3, 3]
    n = source[:, 3:] @ transform[:3, :3].T
    weight = np.empty((len(source), len(target)))
    for i, j in np.ndindex(weight.shape):
        distance = np.linalg.norm(x[i] - target[j, :3])
        near = np.exp(-(distance**2) / (2 * module.WIDTHS[0] ** 2))
        weight[i, j] = near * abs(n[i] @ target[j, 3:]) * (prob[i, j] + module._LEAST_PROB)
    none = module._OUTLIER * module._LEAST_PROB
    weight /= np.sqrt(np.outer(weight.sum(1) + none, weight.sum(0) + none))
    rows, rest = [], []
    for i, j in np.ndindex(weight.shape):
        directions = [(n[i], module._PLANE), (target[j, 3:], module._PLANE)]
        directions += [(axis, 1 - module._PLANE) for axis in np.eye(3)]
        for direction, share in directions:
            root = np.sqrt(share * weight[i, j])
            rows.append(root * np.hstack([np.cross(x[i], direction), direction]))
            rest.append(root * direction @ (target[j, :3] - x[i]))
    step = np.linalg.lstsq(np.array(rows), np.array(rest))[0]
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = expm(np.cross(np.eye(3), step[:3])), step[3:]
    return motion @ transform


def test_an_iteration_is_the_least_squares_step_over_all_matches():
    rng = np.random.default_rng(0)
    source, target = two_samples(3, 30, rng)
    prob = rng.uniform(size=(30, 30)) ** 4
    start = nudged(rng, 0.1, 0.05)
    refined = em_icp(start, source, target, torch.from_numpy(prob), module.WIDTHS[:1])
    expected = naive_iteration(start, source, target, prob)
    np.testing.assert_allclose(refined, expected, atol=2e-5)


def test_the_result_is_a_rigid_transform():
    rng = np.random.default_rng(1)
    source, target = two_samples(3, 200, rng)
    rotation = em_icp(nudged(rng, 3.0, 0.05), source, target, None)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0


def test_clouds_without_a_common_region_stay_where_they_are():
    rng = np.random.default_rng(2)
    source, target = two_samples(3, 100, rng)
    far = np.eye(4)
    far[:3, 3] = 50.0
    np.testing.assert_allclose(em_icp(far, source, target, None), far, atol=1e-4)


def test_sparse_noisy_clouds_end_nearer_than_by_generalised_icp():
    errors = []
    for shape in range(12):
        rng = np.random.default_rng(shape)
        source, target = two_samples(shape, 400, rng)
        start = nudged(rng, 0.1, 0.05)
        scorer = AlignmentScorer(source[:, :3], target[:, :3])
        both = em_icp(start, source, target, None), scorer.refine(start)
        moved = [source[:, :3] @ t[:3, :3].T + t[:3, 3] - source[:, :3] for t in both]
        errors.append([np.linalg.norm(m, axis=1).mean() for m in moved])
    em, generalised = np.median(errors, 0)
    assert em < generalised


def test_matches_hold_a_turned_shape_where_nearness_lets_it_slide():
    angle = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.repeat([0.0, 0.3], 120)], 1)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(240)], 1)
    cloud = np.hstack([ring, normals])
    start = np.eye(4)
    start[:3, :3] = expm(np.cross(np.eye(3), [0.0, 0.0, 0.08]))
    free = em_icp(start, cloud, cloud, None)
    held = em_icp(start, cloud, cloud, torch.eye(240))
    turned = [np.degrees(np.arctan2(t[1, 0], t[0, 0])) for t in (start, free, held)]
    assert abs(turned[2]) < 0.2 * abs(turned[1])


@pytest.mark.parametrize("count", [500, 2000])
def test_equal_clouds_are_registered_to_rounding(count):
    rng = np.random.default_rng(5)
    points = make_shape(("test", 25))[0][:count, :3].astype(np.float64)
    rotation = random_rotation(1, torch.Generator().manual_seed(0))[0].numpy()
    moved = points @ rotation.T + [1.0, 2.0, 3.0]
    found = corrmat.register(points, rng.permutation(moved)).transform
    np.testing.assert_allclose(found[:3, :3], rotation, atol=1e-6)
