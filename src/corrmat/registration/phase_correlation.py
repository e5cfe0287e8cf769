"""Phase correlation of two large clouds, along the right angles of what they show.

Two fragments of a room differ by a turn of its axes and a shift, and wherever walls meet at right
angles, wrong turns and shifts put walls on walls as well. Phase correlation (Kuglin and Hines,
1975) scores every shift at once. It weighs all spatial frequencies alike, so that edges and
furniture count, and not the number of points that a wall has.
"""

import itertools

import numpy as np
import scipy.fft
from scipy.spatial.transform import Rotation

from corrmat.ops import rigid

_VOXEL = 0.1  # in units in which a cloud's radius is about one
_MOST_VOXELS = 64  # along each side of the grid, which wraps around
_FARTHEST = 0.75  # shift that can be told, in sums of the clouds' radii
_STARTS, _STEPS = 6, 15  # of the search for a frame
_FRAME_NORMALS = 1500  # are enough for it
_PARALLEL = 0.85  # cosine from which on a normal lies along an axis
_FLOOR = 0.01  # of a spectrum's largest magnitude: what is far below is noise
_NEXT = -1, 0, 1  # voxels


class PhaseCorrelation:
    """Phase correlation of a source with a target, on a grid along the target's Manhattan frame.

    Args:
        source: (N, 6) xyz and unit normals of any sign, centred, of a radius of about one, in
            random order.
        target: (M, 6), the same.
    """

    def __init__(self, source: np.ndarray, target: np.ndarray) -> None:
        self._source = source
        self._source_frame, self._target_frame = (
            manhattan_frame(cloud[:_FRAME_NORMALS, 3:]) for cloud in (source, target)
        )
        radii = sum(np.linalg.norm(cloud[:, :3], axis=1).max() for cloud in (source, target))
        voxels = min(2 * _FARTHEST * radii / _VOXEL, _MOST_VOXELS)
        self._size = 4 * int(np.ceil(voxels / 4))  # of small factors, for the Fourier transform
        self._target = self._phases(target)

    def peaks(self, rotations: np.ndarray, count: int) -> np.ndarray:
        """Search all shifts, of given rotations and of the 24 between the two Manhattan frames.

        Args:
            rotations: (R, 3, 3) of source onto target.
            count: of transforms, at most R + 24.

        Returns:
            (count, 4, 4) transforms of source onto target, the highest correlation first; exact
            to half a voxel.
        """
        of_axes = Rotation.create_group("O").as_matrix()
        between_frames = self._target_frame.T @ of_axes @ self._source_frame
        rotations = np.concatenate([between_frames, rotations])
        heights = np.stack([self._correlate(rotation, np.zeros(3)) for rotation in rotations])
        rows, cells = highest_peaks(heights, count)
        half = self._size // 2
        shifts = _VOXEL * ((cells + half) % self._size - half)
        return rigid.to_homogeneous(rotations[rows], shifts @ self._target_frame)

    def at(self, transform: np.ndarray) -> float:
        """Compute the highest correlation within a voxel of a transform (4, 4); at most 4."""
        return float(self._around(transform).max())

    def shifted(self, transform: np.ndarray) -> np.ndarray:
        """Shift a transform (4, 4) to the highest correlation within a voxel of it."""
        heights = self._around(transform)
        cell = np.unravel_index(heights.argmax(), heights.shape)
        shift = _VOXEL * np.array(_NEXT)[np.array(cell)] @ self._target_frame
        return rigid.to_homogeneous(transform[:3, :3], transform[:3, 3] + shift)

    def _around(self, transform: np.ndarray) -> np.ndarray:
        """Correlate at a transform (4, 4) and at the shifts next to it: (3, 3, 3)."""
        heights = self._correlate(transform[:3, :3], transform[:3, 3])
        return heights[np.ix_(_NEXT, _NEXT, _NEXT)]

    def _correlate(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Correlate the moved source with the target, (size, size, size): one for each shift."""
        points, normals = np.hsplit(self._source, 2)
        moved = np.hstack([points @ rotation.T + translation, normals @ rotation.T])
        source = self._phases(moved)
        product = (source.conj() * self._target).sum(0)
        return np.asarray(scipy.fft.irfftn(product, [self._size] * 3, axes=(0, 1, 2)))

    def _phases(self, cloud: np.ndarray) -> np.ndarray:
        """Compute spectra of magnitude one of four grids: surfaces along each axis, and others.

        Args:
            cloud: (N, 6).

        Returns:
            (4, size, size, size // 2 + 1) complex.
        """
        along = np.abs(cloud[:, 3:] @ self._target_frame.T)
        kind = np.where(along.max(1) > _PARALLEL, along.argmax(1), 3)
        voxels = np.round(cloud[:, :3] @ self._target_frame.T / _VOXEL).astype(int) % self._size
        grid = np.zeros((4, *[self._size] * 3), np.float32)
        grid[kind, *voxels.T] = 1
        spectrum = np.asarray(scipy.fft.rfftn(grid, axes=(1, 2, 3)))
        magnitude = np.abs(spectrum)
        return spectrum / (magnitude + _FLOOR * magnitude.max())


def highest_peaks(heights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the highest local maxima of several grids that wrap around.

    Args:
        heights: (G, n, n, n).
        count: of maxima, at most G.

    Returns:
        (count,) grids and (count, 3) cells, the highest first.
    """
    # Each grid's highest cell is a local maximum, so that lower ones than `count` of them are out.
    least = np.sort(heights.max((1, 2, 3)))[-count]
    grid, *cell = np.nonzero(heights >= least)
    peak = heights[grid, *cell]
    is_highest = np.ones(len(grid), bool)
    for step in itertools.product(_NEXT, repeat=3):
        beside = [(c + s) % heights.shape[1] for c, s in zip(cell, step, strict=True)]
        is_highest &= peak >= heights[grid, *beside]
    highest = np.flatnonzero(is_highest)
    highest = highest[np.argsort(-peak[highest], kind="stable")[:count]]
    return grid[highest], np.stack(cell, 1)[highest]


def manhattan_frame(normals: np.ndarray) -> np.ndarray:
    """Find the right-angled axes along which most normals (N, 3) lie.

    They maximise the sum of the fourth powers of the normals' coordinates, by matching, stretching
    and projection (Zhai et al., JMLR 2020), from a few starts.

    Returns:
        (3, 3), a rotation whose rows are the axes.
    """
    axes = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_matrix()
    for _ in range(_STEPS):
        along = normals @ axes.mT
        u, _, v = np.linalg.svd((along * along * along).mT @ normals)
        axes = u @ v
    best = axes[((normals @ axes.mT) ** 4).sum((1, 2)).argmax()]
    return best * np.sign(np.linalg.det(best))
