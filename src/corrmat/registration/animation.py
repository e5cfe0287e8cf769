"""An animated GIF of a registration: two clouds, their matches, and the source as it moves."""

import io
from collections.abc import Iterator

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

from corrmat.calibration import as_percent, verdict_words
from corrmat.registration.result import Registration
from corrmat.registration.scene import build_scene, extent
from corrmat.reporting.figures import BLUE, GREEN, GREY, RED
from corrmat.reporting.snapshots import thin

MAX_POINTS = 900  # drawn of a cloud
MAX_LINES = 60  # strongest matches drawn
BEFORE, MATCHES, MOVING, AFTER = 8, 12, 20, 14  # frames
FRAME_MS = 100
SIZE_INCHES, DPI = (7.2, 3.8), 80
TURN_DEG, ELEVATION_DEG = 40.0, 20.0  # of the camera; it turns over the whole animation


def registration_gif(registration: Registration, source: np.ndarray, target: np.ndarray) -> bytes:
    """Draw the GIF of a registration: the clouds as they lie, their matches, and the motion.

    Args:
        registration: of the source onto the target.
        source: (N, 3 or more), as given to `register`.
        target: (M, 3 or more).
    """
    frames = [image.quantize(64) for image in _frames(registration, source, target)]
    content = io.BytesIO()
    frames[0].save(
        content, "GIF", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0,
        optimize=True,
    )  # fmt: skip
    return content.getvalue()


def _frames(
    registration: Registration, source: np.ndarray, target: np.ndarray
) -> Iterator[Image.Image]:
    """Draw frame by frame, seen so that the target is as wide as it can be."""
    scene = build_scene(registration, source, target, MAX_LINES, widest=True)
    i, j = scene.matches.T
    fixed, rows = thin(scene.fixed, MAX_POINTS), thin(np.arange(len(source)), MAX_POINTS)
    drawn = np.concatenate([rows, i])  # of the source; the starts of the matches come last
    count = BEFORE + MATCHES + MOVING + AFTER
    figure = Figure(SIZE_INCHES, DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.86))
    axes.set_axis_off()
    axes.set_aspect("equal")
    cameras = [_camera(TURN_DEG * (share - 0.5)).T for share in np.linspace(0, 1, count)]
    corners = np.vstack([scene.source_at(0, drawn), fixed, scene.fixed[j], scene.aligned[drawn]])
    corners = np.vstack([corners @ camera for camera in cameras])
    (left_end, bottom), (right_end, top) = extent(corners)
    axes.set(xlim=(left_end, right_end), ylim=(bottom, top))
    clouds = [axes.scatter([], [], s=5, c=colour, linewidths=0) for colour in (BLUE, RED)]
    colours = list(np.where(scene.agrees, GREEN, GREY))
    lines = LineCollection([], colors=colours, lw=0.7, alpha=0.8)
    axes.add_collection(lines)
    title = figure.suptitle("", y=0.97, fontsize=13)
    for frame, camera in enumerate(cameras):
        share = float(np.clip((frame - BEFORE - MATCHES) / MOVING, 0, 1))
        moved = scene.source_at(share**2 * (3 - 2 * share), drawn)  # starts and stops slowly
        clouds[0].set_offsets(fixed @ camera)
        clouds[1].set_offsets(moved[: len(rows)] @ camera)
        shown = len(i) > 0 and BEFORE <= frame <= BEFORE + MATCHES
        lines.set_segments(
            list(np.stack([moved[len(rows) :], scene.fixed[j]], 1) @ camera) if shown else []
        )
        title.set_text(_title(registration, share, len(i) if shown else 0))
        canvas.draw()
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _title(registration: Registration, share: float, lines: int) -> str:
    """Say what a frame shows: `lines` matches, and the source after a share of its way."""
    if lines:
        return f"the {lines} strongest matches; green ones agree with the motion"
    if share == 0:
        return "source (orange) and target (blue)"
    if share < 1:
        return f"rotated by {registration.rotation_deg:.0f}°"
    words = verdict_words(registration.confidence)  # the reason is too long for a title
    return f"{words}, confidence {as_percent(registration.confidence)}"


def _camera(azimuth_deg: float) -> np.ndarray:
    """Return the projection (2, 3) onto the picture: x, and height seen from slightly above."""
    rotation = Rotation.from_euler("zx", [azimuth_deg, ELEVATION_DEG], degrees=True).as_matrix()
    return rotation[[0, 2]]
