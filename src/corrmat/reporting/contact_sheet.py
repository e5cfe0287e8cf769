"""Contact sheet of a data set: one shape of every category, side by side."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from corrmat.data.clouds import CloudSet
from corrmat.reporting.figures import save

COLUMNS = 8


def draw_contact_sheet(clouds: CloudSet, path: Path) -> None:
    """Write a PNG with the first shape of each category, shaded by its normals."""
    members = [np.flatnonzero(clouds.labels == label) for label in range(len(clouds.names))]
    tiles = [(name, i[0]) for name, i in zip(clouds.names, members, strict=True) if len(i)]
    rows = -(-len(tiles) // COLUMNS)
    figure = Figure(figsize=(1.9 * COLUMNS, 2.0 * rows), layout="constrained")
    light = np.array([0.4, -0.7, 0.6]) / np.linalg.norm([0.4, -0.7, 0.6])
    for place, (name, index) in enumerate(tiles):
        axes = figure.add_subplot(rows, COLUMNS, place + 1, projection="3d", computed_zorder=False)
        shape = clouds.rows[int(index)]
        x, y, z = shape[:, :3].T
        shade = 0.25 + 0.75 * np.abs(shape[:, 3:] @ light)
        axes.scatter(x, y, z, c=shade, cmap="viridis", vmin=0, vmax=1, s=3, linewidths=0)
        axes.set(xlim=(-0.75, 0.75), ylim=(-0.75, 0.75), zlim=(-0.75, 0.75))
        axes.view_init(elev=22, azim=-60)
        axes.set_axis_off()
        axes.set_title(name, fontsize=9, y=0.92)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(figure, path, dpi=80)
