"""How far off a prediction is: per-pair functions, and one torchmetrics class on them.

The paper's own metrics stand beside the sound ones under names that tell them apart.
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from corrmat.ops import rigid
from corrmat.ops.neighbors import nearest, take
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


def is_match(match: Tensor, num_target: int) -> Tensor:
    """Which entries of match name one of num_target points: not -1 (none), not M (outlier)."""
    return (match >= 0) & (match < num_target)


def right_matches(predicted: Tensor, match: Tensor, num_target: int) -> Tensor:
    """How many rows have their arg max at the true match.

    Args:
        predicted: (B, N) int64.
        match: (B, N) int64; rows with no match (-1) or an outlier (num_target) do not count.
        num_target: M.

    Returns:
        (B,) int64.
    """
    return ((predicted == match) & is_match(match, num_target)).sum(1)


def match_accuracy(predicted: Tensor, match: Tensor, num_target: int) -> Tensor:
    """Share (B,) float64 of rows with a match whose arg max is it; see `right_matches`."""
    rows = is_match(match, num_target).sum(1)
    return right_matches(predicted, match, num_target).double() / rows


def transposed_right_matches(predicted: Tensor, match: Tensor) -> Tensor:
    """The released PCRNet_corr count: the predicted matrix against the true one's transpose.

    Row i counts where match[predicted[i]] = i, so a perfect prediction of a random permutation
    scores about 2 / N. Report it only beside `right_matches`.

    Args:
        predicted: (B, N) int64.
        match: (B, N) int64, of two clouds of N points each.

    Returns:
        (B,) int64.
    """
    n = match.shape[1]
    there = match.gather(1, predicted.clamp(0, n - 1))
    found = (there == torch.arange(n, device=match.device)) & (predicted < n)
    return found.sum(1)


def outlier_counts(predicted: Tensor, match: Tensor, num_target: int) -> tuple[Tensor, ...]:
    """Outliers found, called so, and there: what precision and recall are made of.

    Args:
        predicted: (B, N) int64, num_target where a point is called an outlier.
        match: (B, N) int64, num_target where it is one.
        num_target: M.

    Returns:
        Three tensors (B,) int64.
    """
    called, there = predicted == num_target, match == num_target
    return (called & there).sum(1), called.sum(1), there.sum(1)


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
    _OUTLIERS = ("outliers_found", "outliers_called", "outliers_there")
    _STATE = (
        "shape", "predicted", "truth", "right", "transposed", "rows", "distance", *_OUTLIERS
    )  # fmt: skip

    def __init__(self) -> None:
        super().__init__()
        for name in self._STATE:
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, prediction: Prediction, batch: PairBatch) -> None:
        """Add a batch."""
        n, m, c = batch.source.shape[1], batch.target.shape[1], prediction.correspondence
        none = torch.full((len(batch),), torch.nan, dtype=torch.float64, device=batch.source.device)
        right, transposed, outliers = none, none, [none] * 3
        if c is not None:
            predicted = c.argmax()
            right = right_matches(predicted, batch.match, m).double()
            if n == m and is_match(batch.match, m).all():
                transposed = transposed_right_matches(predicted, batch.match).double()
            if c.outlier is not None:
                outliers = [x.double() for x in outlier_counts(predicted, batch.match, m)]
        values = {
            "shape": batch.shape,
            "predicted": _row(prediction.rotation, prediction.translation),
            "truth": _row(batch.rotation, batch.translation),
            "right": right,
            "transposed": transposed,
            "rows": is_match(batch.match, m).sum(1),
            "distance": chamfer(prediction, batch).double(),
            **dict(zip(self._OUTLIERS, outliers, strict=True)),
        }
        for name in self._STATE:
            getattr(self, name).append(values[name])

    def per_pair(self) -> dict[str, Tensor]:
        """Every quantity of every pair, on the CPU: (B,), Euler angles (B, 3), motion (B, 12)."""
        cat = {name: dim_zero_cat(getattr(self, name)).cpu() for name in self._STATE}
        (r, t), (true_r, true_t) = _motion(cat["predicted"]), _motion(cat["truth"])
        return {
            "shape": cat["shape"],
            "transform": cat["predicted"],
            "rotation_error_deg": rotation_error_deg(r, true_r),
            "relative_euler_error_deg": relative_euler_error_deg(r, true_r),
            "naive_euler_error_deg": naive_euler_error_deg(r, true_r),
            "translation_error": translation_error(t, true_t),
            "right": cat["right"],
            "transposed": cat["transposed"],
            "rows": cat["rows"],
            "chamfer": cat["distance"],
            **{name: cat[name] for name in self._OUTLIERS},
        }

    def compute(self) -> dict[str, float]:
        """`summary` of all pairs seen."""
        return summary(self.per_pair())


def summary(per_pair: dict[str, Tensor]) -> dict[str, float]:
    """Metrics of many pairs: angles in degrees, lengths in units of the unit sphere.

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
        "transposed_match_accuracy": per_pair["transposed"].sum() / per_pair["rows"].sum(),
        "outlier_precision": per_pair["outliers_found"].sum() / per_pair["outliers_called"].sum(),
        "outlier_recall": per_pair["outliers_found"].sum() / per_pair["outliers_there"].sum(),
        "chamfer": per_pair["chamfer"].mean(),
        "recall@5deg_0.05": hit.double().mean(),
        "failed": (~angle.isfinite()).double().sum(),
        "pairs": torch.tensor(float(len(angle))),
    }
    return {name: float(value) for name, value in values.items()}


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


def _nearest_squared(points: Tensor, cloud: Tensor) -> Tensor:
    found = take(cloud, nearest(points, cloud))
    return (points.double() - found.double()).square().sum(-1)
