"""The registration page: before, matches and after, without a server or a network."""

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from corrmat.registration.register import Registration
from corrmat.reporting.figures import BLUE, RED, thin

MAX_POINTS = 4000  # drawn of a cloud
MAX_LINES = 150  # strongest matches drawn


def registration_page(registration: Registration, source: np.ndarray, target: np.ndarray) -> str:
    """Build the HTML of a registration.

    Args:
        registration: of the source onto the target.
        source: (N, 3 or more), as given to `register`.
        target: (M, 3 or more).
    """
    # Far from the origin a browser's float32 would lose the detail.
    origin = target[:, :3].mean(0)
    rotation, translation = registration.transform[:3, :3], registration.transform[:3, 3]
    moved = source[:, :3] @ rotation.T + translation - origin
    shifted = source[:, :3] - source[:, :3].mean(0)
    fixed = target[:, :3] - origin
    gap = np.array([1.1 * (np.ptp(fixed[:, 0]) + np.ptp(shifted[:, 0])), 0, 0]) / 2
    figure = make_subplots(
        rows=1,
        cols=2,
        specs=[[{"type": "scene"}] * 2],
        subplot_titles=("before, and the matches", "after"),
        horizontal_spacing=0.02,
    )
    for column, (x, y) in enumerate(((shifted - gap, fixed + gap), (moved, fixed)), 1):
        for name, cloud, colour in (("source", x, RED), ("target", y, BLUE)):
            figure.add_trace(_points(cloud, name, colour, column == 1), row=1, col=column)
    if len(registration.matches):
        figure.add_trace(_matches(registration, shifted - gap, fixed + gap), row=1, col=1)
    hidden = {"visible": False}
    scene = {"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, "aspectmode": "data"}
    figure.update_layout(
        title=_title(registration),
        template="plotly_white",
        margin={"l": 8, "r": 8, "t": 96, "b": 8},
        legend={"orientation": "h", "y": 0},
        scene=scene,
        scene2=scene,
    )
    return figure.to_html(include_plotlyjs=True, full_html=True, default_height="96vh")


def _points(cloud: np.ndarray, name: str, colour: str, legend: bool) -> go.Scatter3d:
    """Build the trace of a cloud (N, 3), thinned evenly."""
    x, y, z = thin(cloud, MAX_POINTS).astype(np.float32).T
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        name=name,
        mode="markers",
        marker={"size": 2, "color": colour},
        legendgroup=name,
        showlegend=legend,
        hoverinfo="skip",
    )


def _matches(registration: Registration, source: np.ndarray, target: np.ndarray) -> go.Scatter3d:
    """Build the trace of the strongest matches, coloured by confidence."""
    order = np.argsort(-registration.match_confidence, kind="stable")[:MAX_LINES]
    ends = np.full((len(order), 3, 3), np.nan)  # from, to, and a gap before the next
    ends[:, 0], ends[:, 1] = (
        source[registration.matches[order, 0]],
        target[registration.matches[order, 1]],
    )
    x, y, z = ends.reshape(-1, 3).astype(np.float32).T
    confidence = np.repeat(registration.match_confidence[order], 3)
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        name="matches",
        mode="lines",
        line={
            "width": 2,
            "color": confidence,
            "colorscale": "Viridis",
            "cmin": 0,
            "cmax": float(registration.match_confidence.max()),
            "colorbar": {"title": "confidence", "thickness": 12, "len": 0.6},
        },
        hoverinfo="skip",
    )


def _title(registration: Registration) -> str:
    """Format verdict, confidence and errors for the heading."""
    return (
        f"{registration.verdict} (confidence {registration.confidence:.0%}): rotated by "
        f"{registration.rotation_deg:.2f}°, RMSE {registration.rmse:.4g}, "
        f"{registration.overlap:.0%} of the source on the target<br>"
        f"<sup>corrmat register, model {registration.model}, seed {registration.seed}. "
        "Drag to rotate, scroll to zoom.</sup>"
    )
