"""The registration page: the source moves onto the target under a slider; no server, no network."""

import json

import numpy as np
import plotly.graph_objects as go

from corrmat.calibration import as_percent
from corrmat.registration.result import Registration, direction_text, matrix_lines
from corrmat.registration.scene import build_scene, extent
from corrmat.reporting.figures import BLUE, GREEN, GREY, RED
from corrmat.reporting.html import render
from corrmat.reporting.snapshots import thin

MAX_POINTS = 4000  # drawn of a cloud
MAX_LINES = 150  # strongest matches drawn


def registration_page(
    registration: Registration,
    source: np.ndarray,
    target: np.ndarray,
    names: tuple[str, str] = ("source", "target"),
) -> str:
    """Build the HTML of a registration.

    Args:
        registration: of the source onto the target.
        source: (N, 3 or more), as given to `register`.
        target: (M, 3 or more).
        names: of source and target, for the legend and the title.
    """
    scene = build_scene(registration, source, target, MAX_LINES)
    fixed, aligned, (i, j) = scene.fixed, scene.aligned, scene.matches.T
    figure = go.Figure([_points(fixed, names[1], BLUE), _points(aligned, names[0], RED)])
    for name, chosen, colour in (
        ("matches that agree", scene.agrees, GREEN),
        ("other matches", ~scene.agrees, GREY),
    ):
        figure.add_trace(_lines(aligned[i[chosen]], fixed[j[chosen]], name, colour))
    everything = np.vstack([fixed, aligned, scene.source_at(0)])
    axes = {
        f"{axis}axis": {"visible": False, "range": [low, high]}  # the same all along the way
        for axis, low, high in zip("xyz", *extent(everything), strict=True)
    }
    figure.update_layout(
        template="none",
        paper_bgcolor="rgba(0,0,0,0)",
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        legend={
            "orientation": "h",
            "y": 0,
            "font": {"color": "#808080"},
            "itemsizing": "constant",
        },
        scene={**axes, "aspectmode": "data", "camera": {"eye": {"x": 0.3, "y": -1.4, "z": 0.7}}},
    )
    path = {
        "middle": scene.middle.tolist(),
        "rotvec": scene.rotvec.tolist(),
        "beside": scene.beside,
    }
    axis = registration.turns_about
    return render(
        "registration.html.j2",
        registration=registration,
        axis=None if axis is None else direction_text(axis),
        confidence=as_percent(registration.confidence),
        names=names,
        matrix="\n".join(matrix_lines(registration.transform)),
        path=json.dumps(path),
        plot=figure.to_html(
            include_plotlyjs=True,
            full_html=False,
            default_height="78vh",
            div_id="clouds",
            config={"displayModeBar": False},
        ),
    )


def _points(cloud: np.ndarray, name: str, colour: str) -> go.Scatter3d:
    """Build the trace of a cloud (N, 3), thinned evenly."""
    x, y, z = thin(cloud, MAX_POINTS).astype(np.float32).T.tolist()
    marker = {"size": 2, "color": colour}
    return go.Scatter3d(x=x, y=y, z=z, name=name, mode="markers", marker=marker, hoverinfo="skip")


def _lines(start: np.ndarray, end: np.ndarray, name: str, colour: str) -> go.Scatter3d:
    """Build the trace of lines from (K, 3) source points to (K, 3) target points."""
    ends = np.full((len(start), 3, 3), np.nan)  # from, to, and a gap before the next
    ends[:, 0], ends[:, 1] = start, end
    x, y, z = ends.reshape(-1, 3).astype(np.float32).T.tolist()
    line = {"width": 2, "color": colour}
    return go.Scatter3d(x=x, y=y, z=z, name=name, mode="lines", line=line, hoverinfo="skip")
