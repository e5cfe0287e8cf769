import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from twins import within_radius_loops

from corrmat.networks.ppf import neighborhoods, point_pair_features
from corrmat.ops import neighbors
from corrmat.ops.neighbors import gather_points, knn, nearest, neighbors_at_ranks, within_radius


@pytest.mark.parametrize("chunk", [1, 100, 2**24])
def test_within_radius_takes_the_lowest_indices(chunk, generator, monkeypatch):
    monkeypatch.setattr(neighbors, "_CHUNK", chunk)
    points = torch.randn(2, 20, 3, generator=generator, dtype=torch.float64)
    for radius, k in ((0.8, 4), (2.0, 6), (0.01, 3), (100.0, 25)):
        actual = within_radius(points, radius, k)
        assert torch.equal(actual, within_radius_loops(points, radius, k))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_has_the_neighbours_of_its_values(dtype, generator):
    points = torch.randn(1, 20, 3, generator=generator).to(dtype)
    cloud, exact = points[:, :10], points.double()
    assert torch.equal(nearest(points, cloud), nearest(exact, exact[:, :10]))
    assert torch.equal(within_radius(points, 0.8, 4), within_radius(exact, 0.8, 4))


def test_the_border_is_inside_and_copies_are_neighbours():
    points = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0], [0.0, 0, 0]]])
    assert within_radius(points, 0.5, 2).tolist() == [[[1, 2], [0, 2], [0, 1]]]
    assert within_radius(points, 0.49, 2).tolist() == [[[2, 0], [1, 1], [0, 2]]]


@pytest.mark.parametrize("chunk", [1, 2**24])
def test_nearest_is_exact(chunk, generator, monkeypatch):
    monkeypatch.setattr(neighbors, "_CHUNK", chunk)
    x = 100 + 0.01 * torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    y = 100 + 0.01 * torch.randn(2, 11, 3, generator=generator, dtype=torch.float64)
    expected = (x.unsqueeze(2) - y.unsqueeze(1)).norm(dim=-1).argmin(-1)
    assert torch.equal(nearest(x, y), expected)
    assert torch.equal(gather_points(y, expected)[1, 3], y[1, expected[1, 3]])
    assert knn(y, 1).squeeze(-1).tolist() == [list(range(11))] * 2


@pytest.mark.parametrize("chunk", [1, 100, 2**24])
def test_knn_is_exact_slice_by_slice(chunk, generator, monkeypatch):
    monkeypatch.setattr(neighbors, "_CHUNK", chunk)
    points = torch.randn(2, 40, 3, generator=generator)
    order = (points.unsqueeze(2) - points.unsqueeze(1)).norm(dim=-1).argsort(-1)
    assert torch.equal(knn(points, 7), order[..., :7])


def test_pair_features_are_angles_and_a_distance():
    up, right = torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0])
    features = point_pair_features(2 * right, up, right)
    expected = torch.tensor([math.pi / 2, 0.0, math.pi / 2, 2.0])
    torch.testing.assert_close(features, expected)
    assert (point_pair_features(torch.zeros(3), up, up) == 0).all()  # a place left over


def test_pair_features_do_not_change_when_the_cloud_moves(generator):
    cloud = torch.randn(1, 40, 6, generator=generator, dtype=torch.float64)
    cloud[..., 3:] /= cloud[..., 3:].norm(dim=-1, keepdim=True)
    r = torch.from_numpy(Rotation.random(random_state=0).as_matrix()).unsqueeze(0)
    t = torch.tensor([[0.3, -0.2, 0.1]], dtype=torch.float64)
    moved = torch.cat([cloud[..., :3] @ r.mT + t, cloud[..., 3:] @ r.mT], -1)
    again = neighborhoods(moved, 0.9, 5)
    shifted = neighborhoods(cloud, 0.9, 5).moved(r, t)
    for one, other in zip(again, shifted, strict=True):
        torch.testing.assert_close(one, other)
    assert again.features().shape == (1, 40, 5, 10)
    features = again.features()[0, 7, 2]
    torch.testing.assert_close(features[:3], moved[0, 7, :3])
    torch.testing.assert_close(features[6:], again.ppf[0, 7, 2])


def test_neighbors_at_ranks_are_those_of_knn(generator):
    points = torch.randn(2, 30, 3, generator=generator)
    ranks = torch.tensor([[0, 1, 2], [0, 7, 29]])
    assert torch.equal(neighbors_at_ranks(points, ranks), knn(points, 30)[..., ranks])


def test_equally_near_points_come_in_the_order_of_the_cloud():
    axes = torch.meshgrid(*[torch.arange(3.0)] * 3, indexing="ij")
    grid = torch.stack(axes, -1).view(1, 27, 3)
    expected = torch.cdist(grid, grid).argsort(dim=-1, stable=True)
    assert torch.equal(neighbors_at_ranks(grid, torch.arange(27)), expected)


def test_ranks_do_not_depend_on_where_the_cloud_lies(generator):
    points = torch.randn(1, 300, 3, generator=generator)
    ranks = torch.arange(8)
    expected = neighbors_at_ranks(points, ranks)
    assert torch.equal(expected[0, :, 0], torch.arange(300))
    assert (neighbors_at_ranks(points + 100, ranks) == expected).float().mean() > 0.999
