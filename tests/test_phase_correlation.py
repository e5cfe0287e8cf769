"""Tests of Manhattan frames and of the phase correlation of large clouds."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from corrmat.data.scan_pairs import make_room_pair
from corrmat.ops import rigid
from corrmat.registration.phase_correlation import PhaseCorrelation, highest_peaks, manhattan_frame
from corrmat.registration.preparation import prepare_clouds


@pytest.fixture
def corner():
    """Two walls and a floor with a few boxes: (N, 6), of a radius of about one."""
    rng = np.random.default_rng(0)
    points, normals = [], []
    for axis in range(3):
        wall = rng.uniform(-0.7, 0.7, (800, 3))
        wall[:, axis] = -0.7
        points.append(wall)
        normals.append(np.tile(np.eye(3)[axis], (800, 1)))
    for low in ([0.1, -0.2, -0.7], [-0.6, 0.3, -0.7]):
        for axis in range(3):
            side = np.array(low) + 0.3 * rng.uniform(0, 1, (200, 3))
            side[:, axis] = low[axis] + 0.3
            points.append(side)
            normals.append(np.tile(np.eye(3)[axis], (200, 1)))
    cloud = np.hstack([np.vstack(points), np.vstack(normals)])
    return cloud[rng.permutation(len(cloud))]


def moved(cloud, transform):
    rotation = transform[:3, :3]
    return np.hstack([cloud[:, :3] @ rotation.T + transform[:3, 3], cloud[:, 3:] @ rotation.T])


def test_a_manhattan_frame_has_the_walls_normals_as_axes(corner):
    turn = Rotation.from_rotvec([0.4, -0.3, 1.1]).as_matrix()
    signs = np.random.default_rng(1).choice([-1, 1], (len(corner), 1))
    frame = manhattan_frame(signs * corner[:, 3:] @ turn.T)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1)
    np.testing.assert_allclose(np.sort(np.abs(frame @ turn), axis=1)[:, 2], 1, atol=1e-9)


@pytest.mark.parametrize("count", [1, 5, 8])
def test_the_highest_peaks_are_those_of_a_maximum_filter(count):
    """In grids that wrap around; several peaks may lie in one grid, and neighbours may be equal."""
    heights = np.random.default_rng(0).normal(size=(8, 6, 6, 6)).round(1)
    heights[3, 0, 0, 0] = heights[3, -1, 2, 5] = heights.max() + 1
    peaks = np.flatnonzero(heights == maximum_filter(heights, (1, 3, 3, 3), mode="wrap"))
    peaks = peaks[np.argsort(-heights.ravel()[peaks], kind="stable")[:count]]
    grids, *cells = np.unravel_index(peaks, heights.shape)
    found = highest_peaks(heights, count)
    np.testing.assert_array_equal(found[0], grids)
    np.testing.assert_array_equal(found[1], np.stack(cells, 1))


def test_the_highest_peak_is_the_transform(corner):
    """To half a voxel along each axis; and it is higher than any other transform."""
    turn = Rotation.from_rotvec([0.4, -0.3, 1.1]).as_matrix()
    truth = rigid.to_homogeneous(turn, np.array([0.33, -0.21, 0.4]))
    correlation = PhaseCorrelation(corner, moved(corner, truth))
    peaks = correlation.peaks(np.empty((0, 3, 3)), 5)
    assert peaks.shape == (5, 4, 4)
    np.testing.assert_allclose(peaks[0][:3, :3], truth[:3, :3], atol=1e-6)
    assert np.linalg.norm(peaks[0][:3, 3] - truth[:3, 3]) < 0.05 * 3**0.5
    at_peaks = [correlation.at(peak) for peak in peaks]
    assert at_peaks[0] == max(at_peaks)
    assert correlation.at(truth) > 2 * correlation.at(peaks[1])


def test_a_transform_is_shifted_to_the_highest_correlation_next_to_it(corner):
    turn = Rotation.from_rotvec([0.4, -0.3, 1.1]).as_matrix()
    truth = rigid.to_homogeneous(turn, np.array([0.33, -0.21, 0.4]))
    correlation = PhaseCorrelation(corner, moved(corner, truth))
    off = truth.copy()
    off[:3, 3] += turn @ [0.1, 0.0, -0.1]  # along the walls, a voxel
    np.testing.assert_allclose(correlation.shifted(off), truth, atol=1e-6)
    np.testing.assert_array_equal(correlation.shifted(truth), truth)


def test_a_given_rotation_is_searched_too(corner):
    """Where frames do not help: a cloud without right angles."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((len(corner), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = np.hstack([corner[:, :3] + 0.3 * corner[:, [1, 2, 0]], normals])
    turn = Rotation.from_rotvec([0.2, 0.9, -0.5]).as_matrix()
    truth = rigid.to_homogeneous(turn, np.array([0.2, 0.1, -0.3]))
    correlation = PhaseCorrelation(cloud, moved(cloud, truth))
    alone = correlation.peaks(np.empty((0, 3, 3)), 8)
    given = correlation.peaks(truth[None, :3, :3], 8)
    assert np.linalg.norm(alone - truth, axis=(1, 2)).min() > 0.1
    assert np.linalg.norm(given[0] - truth) < 0.1


def test_a_far_stray_point_does_not_make_the_grid_large(corner):
    corner[0, :3] = 18.0
    assert PhaseCorrelation(corner, corner).peaks(np.empty((0, 3, 3)), 1).shape == (1, 4, 4)


def test_the_right_shift_of_a_room_is_among_the_peaks():
    room = make_room_pair(218, 20_000, "val")
    clouds = prepare_clouds(room.source, room.target, 0)
    truth = clouds.from_original_units(rigid.to_homogeneous(room.rotation, room.translation))
    peaks = clouds.scorers[1].phase_correlation.peaks(np.empty((0, 3, 3)), 16)
    assert np.linalg.norm(peaks - truth, axis=(1, 2)).min() < 0.2
