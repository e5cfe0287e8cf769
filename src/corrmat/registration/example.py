"""Write two scans of one shape, to try `corrmat register` on."""

from pathlib import Path

import numpy as np
import torch

from corrmat.data.scans import write_ply
from corrmat.data.shapes.dataset import make_shape
from corrmat.errors import CorrmatError
from corrmat.files import refuse_existing, replace_json
from corrmat.ops import rigid

SHAPE = 25  # of the test split: a piano
MILLIMETRES = 250.0  # its radius
KEEP = 0.8  # of the points of each scan
NOISE = 0.005  # of the radius


def write_example(folder: Path) -> None:
    """Write source.ply, target.ply and truth.json.

    Each scan lacks 20 % of the shape on one side. The scans share no point, are noisy, and lie
    1.5 m apart with a rotation of 130 degrees.

    Raises:
        CorrmatError: the folder cannot be created, or holds other scans of these names.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CorrmatError(f"cannot create the folder {folder}: {error.strerror}") from error
    if not (folder / "truth.json").exists():  # it is not an earlier example
        refuse_existing((folder / "source.ply", folder / "target.ply"))
    rng = np.random.default_rng(0)
    points = MILLIMETRES * make_shape(("test", SHAPE))[0][:, :3].astype(np.float64)
    order = rng.permutation(len(points))
    scans = []
    for side, rows in zip(
        np.array([[1.0, 0.3, 0.2], [-0.4, 1.0, 0.1]]), np.split(order, 2), strict=True
    ):
        scan = points[rows]
        scan = scan[(scan @ side).argsort()[: round(KEEP * len(scan))]]
        scans.append(scan + rng.normal(0, NOISE * MILLIMETRES, scan.shape))
    axis = torch.tensor([[0.48, -0.6, 0.64]], dtype=torch.float64)
    angle = torch.deg2rad(torch.tensor([130.0], dtype=torch.float64))
    rotation = rigid.axis_angle_to_matrix(axis, angle)[0].numpy()
    translation = np.array([1200.0, -700.0, 500.0])
    transform = rigid.to_homogeneous(rotation, translation)
    write_ply(folder / "source.ply", scans[0])
    write_ply(folder / "target.ply", scans[1] @ rotation.T + translation)
    replace_json(folder / "truth.json", {"transform": transform.tolist()})
