"""A registration as one page that needs no server and no network: before, after, matches."""

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from corrmat.registration import Registration

SHOWN = 4000  # points of a cloud
LINES = 150  # strongest matches


def page(found: Registration, source: np.ndarray, target: np.ndarray) -> str:
    """HTML of a registration.

    Args:
        found: how source lies on target.
        source: (N, 3 or more), as given to `register`.
        target: (M, 3 or more).
    """
    # Far from the origin a browser's float32 would lose the detail.
    origin = target[:, :3].mean(0)
    rotation, translation = found.transform[:3, :3], found.transform[:3, 3]
    moved = source[:, :3] @ rotation.T + translation - origin
    shifted = source[:, :3] - source[:, :3].mean(0)
    still = target[:, :3] - origin
    aside = np.array([1.1 * (np.ptp(still[:, 0]) + np.ptp(shifted[:, 0])), 0, 0]) / 2
    figure = make_subplots(
        rows=1,
        cols=2,
        specs=[[{"type": "scene"}] * 2],
        subplot_titles=("before, and the matches", "after"),
        horizontal_spacing=0.02,
    )
    for column, (x, y) in enumerate(((shifted - aside, still + aside), (moved, still)), 1):
        for name, cloud, colour in (("source", x, "#d62728"), ("target", y, "#1f77b4")):
            figure.add_trace(_points(cloud, name, colour, column == 1), row=1, col=column)
    if len(found.matches):
        figure.add_trace(_matches(found, shifted - aside, still + aside), row=1, col=1)
    hidden = {"visible": False}
    scene = {"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, "aspectmode": "data"}
    figure.update_layout(
        title=_title(found),
        template="plotly_white",
        margin={"l": 8, "r": 8, "t": 96, "b": 8},
        legend={"orientation": "h", "y": 0},
        scene=scene,
        scene2=scene,
    )
    return figure.to_html(include_plotlyjs=True, full_html=True, default_height="96vh")


def _points(cloud: np.ndarray, name: str, colour: str, legend: bool) -> go.Scatter3d:
    few = cloud[np.linspace(0, len(cloud) - 1, min(SHOWN, len(cloud))).astype(int)]
    x, y, z = few.astype(np.float32).T
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


def _matches(found: Registration, source: np.ndarray, target: np.ndarray) -> go.Scatter3d:
    order = np.argsort(-found.match_confidence, kind="stable")[:LINES]
    ends = np.full((len(order), 3, 3), np.nan)  # from, to, and a gap before the next
    ends[:, 0], ends[:, 1] = source[found.matches[order, 0]], target[found.matches[order, 1]]
    x, y, z = ends.reshape(-1, 3).astype(np.float32).T
    confidence = np.repeat(found.match_confidence[order], 3)
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
            "cmax": float(found.match_confidence.max()),
            "colorbar": {"title": "confidence", "thickness": 12, "len": 0.6},
        },
        hoverinfo="skip",
    )


def _title(found: Registration) -> str:
    return (
        f"{found.verdict} (confidence {found.confidence:.0%}): turned by "
        f"{found.rotation_deg:.2f}°, RMSE {found.rmse:.4g}, {found.overlap:.0%} of the source "
        f"on the target<br><sup>corrmat register, model {found.model}, seed {found.seed}. "
        "Drag to turn, scroll to come nearer.</sup>"
    )
