"""How far off a prediction is: per-pair functions, and one torchmetrics class on them.

The paper's own metrics stand beside the sound ones under names that tell them apart (SPEC: 5).
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from corrmat.ops import rigid
from corrmat.types import PairBatch, Prediction

RECALL_DEG, RECALL_UNITS = 5.0, 0.05


def rotation_error_deg(rotation_pred: Tensor, rotation: Tensor) -> Tensor:
    """Geodesic distance of rotations, in degrees: the angle of R_pred^T R.

    By atan2 in float64, exact near 0 and near 180 degrees, where acos in float32 is not.

    Args:
        rotation_pred: (B, 3, 3).
        rotation: (B, 3, 3).

    Returns:
        (B,) float64 in [0, 180].
    """
    delta = rotation_pred.double().mT @ rotation.double()
    skew = delta - delta.mT
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1).norm(dim=-1)
    cosine = delta.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return torch.rad2deg(torch.atan2(sine, cosine))


def relative_euler_error_deg(rotation_pred: Tensor, rotation: Tensor) -> Tensor:
    """The zyx Euler angles of R_pred R^T, in degrees (tables 1 and 2; DCP's experiments).

    Args:
        rotation_pred: (B, 3, 3).
        rotation: (B, 3, 3).

    Returns:
        (B, 3) float64, signed, z first; NaN where the prediction is.
    """
    return _euler_deg(rotation_pred.double() @ rotation.double().mT)


def naive_euler_error_deg(rotation_pred: Tensor, rotation: Tensor) -> Tensor:
    """Difference of two zyx Euler triples, in degrees (the released PCRNet scripts).

    It wraps at 180 degrees: report it only beside `rotation_error_deg`.

    Args:
        rotation_pred: (B, 3, 3).
        rotation: (B, 3, 3).

    Returns:
        (B, 3) float64, signed, z first; NaN where the prediction is.
    """
    return _euler_deg(rotation_pred) - _euler_deg(rotation)


def translation_error(translation_pred: Tensor, translation: Tensor) -> Tensor:
    """Euclidean distance (B,) float64 of two translations (B, 3), in units of the clouds."""
    return (translation_pred.double() - translation.double()).norm(dim=-1)


def right_matches(predicted: Tensor, match: Tensor, num_target: int) -> Tensor:
    """How many rows have their arg max at the true match.

    Args:
        predicted: (B, N) int64.
        match: (B, N) int64; rows with no match (-1) or an outlier (num_target) do not count.
        num_target: M.

    Returns:
        (B,) int64.
    """
    return ((predicted == match) & _has_match(match, num_target)).sum(1)


def match_accuracy(predicted: Tensor, match: Tensor, num_target: int) -> Tensor:
    """Share (B,) float64 of rows with a match whose arg max is it; see `right_matches`."""
    rows = _has_match(match, num_target).sum(1)
    return right_matches(predicted, match, num_target).double() / rows


def chamfer(prediction: Prediction, batch: PairBatch) -> Tensor:
    """RPMNet's modified Chamfer distance (RPM-Net, section 5.3), squared distances.

    Mean squared distance of the aligned source to the clean target, and of the target to the
    clean source moved by the prediction; clean = the whole cloud, so that a crop costs nothing.

    Returns:
        (B,) float64.
    """
    aligned = rigid.apply(prediction.rotation, prediction.translation, batch.source[..., :3])
    clean_target = rigid.apply(batch.rotation, batch.translation, batch.clean)
    clean_source = rigid.apply(prediction.rotation, prediction.translation, batch.clean)
    there = _nearest_squared(aligned, clean_target)
    back = _nearest_squared(batch.target[..., :3], clean_source)
    return there.mean(1) + back.mean(1)


class RegistrationMetrics(Metric):
    """Keeps what was predicted for each pair; `per_pair` scores it and `compute` sums it up.

    Predict once, score many: the state is transforms and counts, never a mean of means.
    """

    full_state_update = False
    shape: list[Tensor]
    predicted: list[Tensor]
    truth: list[Tensor]
    right: list[Tensor]
    rows: list[Tensor]
    distance: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        for name in ("shape", "predicted", "truth", "right", "rows", "distance"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, prediction: Prediction, batch: PairBatch, with_chamfer: bool = False) -> None:
        """Add a batch; the Chamfer distance costs more than the rest and is optional."""
        none = torch.full((len(batch),), torch.nan, dtype=torch.float64, device=batch.source.device)
        m = batch.target.shape[1]
        c = prediction.correspondence
        self.shape.append(batch.shape)
        self.predicted.append(_row(prediction.rotation, prediction.translation))
        self.truth.append(_row(batch.rotation, batch.translation))
        self.right.append(none if c is None else right_matches(c.argmax(), batch.match, m).double())
        self.rows.append(_has_match(batch.match, m).sum(1))
        self.distance.append(chamfer(prediction, batch).double() if with_chamfer else none)

    def per_pair(self) -> dict[str, Tensor]:
        """Every quantity of every pair, on the CPU: (B,), Euler angles (B, 3), motion (B, 12)."""
        cat = {name: dim_zero_cat(getattr(self, name)).cpu() for name in self._defaults}
        (r, t), (true_r, true_t) = _motion(cat["predicted"]), _motion(cat["truth"])
        return {
            "shape": cat["shape"],
            "transform": cat["predicted"],
            "rotation_error_deg": rotation_error_deg(r, true_r),
            "relative_euler_error_deg": relative_euler_error_deg(r, true_r),
            "naive_euler_error_deg": naive_euler_error_deg(r, true_r),
            "translation_error": translation_error(t, true_t),
            "right": cat["right"],
            "rows": cat["rows"],
            "chamfer": cat["distance"],
        }

    def compute(self) -> dict[str, float]:
        """`summary` of all pairs seen."""
        return summary(self.per_pair())


def summary(per_pair: dict[str, Tensor]) -> dict[str, float]:
    """Metrics of many pairs (SPEC: 5): angles in degrees, lengths in units of the unit sphere.

    A pair whose prediction is not finite is counted in `failed`, makes means NaN, and is a
    miss in `recall`.
    """
    angle, shift = per_pair["rotation_error_deg"], per_pair["translation_error"]
    relative, naive = per_pair["relative_euler_error_deg"], per_pair["naive_euler_error_deg"]
    hit = (angle < RECALL_DEG) & (shift < RECALL_UNITS)
    values = {
        "rotation_error_deg_mean": angle.mean(),
        "rotation_error_deg_median": angle.median(),
        "relative_euler_rmse_deg": relative.square().mean().sqrt(),
        "relative_euler_mae_deg": relative.abs().mean(),
        "naive_euler_rmse_deg": naive.square().mean().sqrt(),
        "translation_rmse": (shift.square().mean() / 3).sqrt(),
        "match_accuracy": per_pair["right"].sum() / per_pair["rows"].sum(),
        "chamfer": per_pair["chamfer"].mean(),
        "recall@5deg_0.05": hit.double().mean(),
        "failed": (~angle.isfinite()).double().sum(),
        "pairs": torch.tensor(float(len(angle))),
    }
    return {name: float(value) for name, value in values.items()}


def _has_match(match: Tensor, num_target: int) -> Tensor:
    return (match >= 0) & (match < num_target)


def _row(rotation: Tensor, translation: Tensor) -> Tensor:
    return torch.cat([rotation.detach().flatten(1), translation.detach()], 1)


def _motion(row: Tensor) -> tuple[Tensor, Tensor]:
    return row[:, :9].unflatten(1, (3, 3)), row[:, 9:]


def _euler_deg(rotation: Tensor) -> Tensor:
    matrix = rotation.detach().cpu().double().numpy()
    angles = np.full(matrix.shape[:-1], np.nan)
    finite = np.isfinite(matrix).all((-1, -2))
    if finite.any():
        angles[finite] = Rotation.from_matrix(matrix[finite]).as_euler("zyx", degrees=True)
    return torch.from_numpy(angles).to(rotation.device)


@torch.no_grad()
def _nearest_squared(points: Tensor, cloud: Tensor) -> Tensor:
    distance = torch.cdist(
        points.double(), cloud.double(), compute_mode="donot_use_mm_for_euclid_dist"
    )
    return distance.amin(-1).square()
