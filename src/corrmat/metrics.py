"""Errors of predictions: per-pair functions, and one torchmetrics class on top of them.

The paper's own metrics and the sound ones have different names.
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from corrmat.ops import rigid
from corrmat.ops.neighbors import gather_points, nearest
from corrmat.types import PairBatch, Prediction

RECALL_DEG, RECALL_UNITS = 5.0, 0.05
ADDS_THRESHOLD = 0.03  # mean distance of aligned clean clouds (ADD-S): radii, or metres in rooms


def rotation_error_deg(rotation_pred: Tensor, rotation: Tensor) -> Tensor:
    """Compute the geodesic distance of rotations, in degrees: the angle of R_pred^T R.

    It uses atan2 in float64, which is exact near 0 and 180 degrees where acos in float32 is not.

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
    """Compute the zyx Euler angles of R_pred R^T, in degrees (tables 1 and 2; DCP's experiments).

    Args:
        rotation_pred: (B, 3, 3).
        rotation: (B, 3, 3).

    Returns:
        (B, 3) float64, signed, z first; NaN where the prediction is.
    """
    return _euler_deg(rotation_pred.double() @ rotation.double().mT)


def naive_euler_error_deg(rotation_pred: Tensor, rotation: Tensor) -> Tensor:
    """Subtract two zyx Euler triples, in degrees (the released PCRNet scripts).

    It wraps at 180 degrees: report it only beside `rotation_error_deg`.

    Args:
        rotation_pred: (B, 3, 3).
        rotation: (B, 3, 3).

    Returns:
        (B, 3) float64, signed, z first; NaN where the prediction is.
    """
    return _euler_deg(rotation_pred) - _euler_deg(rotation)


def translation_error(translation_pred: Tensor, translation: Tensor) -> Tensor:
    """Compute the distance (B,) float64 of translations (B, 3), in units of the clouds."""
    return (translation_pred.double() - translation.double()).norm(dim=-1)


def is_match(match: Tensor, num_target: int) -> Tensor:
    """Tell which entries of match name a target point: not -1 (none) and not M (outlier)."""
    return (match >= 0) & (match < num_target)


def num_correct(predicted: Tensor, match: Tensor, num_target: int) -> Tensor:
    """Count the rows whose arg max is the true match.

    Args:
        predicted: (B, N) int64.
        match: (B, N) int64; rows with no match (-1) or an outlier (num_target) are ignored.
        num_target: M.

    Returns:
        (B,) int64.
    """
    return ((predicted == match) & is_match(match, num_target)).sum(1)


def match_accuracy(predicted: Tensor, match: Tensor, num_target: int) -> Tensor:
    """Compute the share () of a batch's points with a match whose arg max is it; 0 without any."""
    num_matchable = is_match(match, num_target).sum()
    return num_correct(predicted, match, num_target).sum() / num_matchable.clamp_min(1)


def num_correct_transposed(predicted: Tensor, match: Tensor) -> Tensor:
    """Count as the released PCRNet_corr does: the predicted matrix against the true transpose.

    Row i counts where match[predicted[i]] = i, so a perfect prediction of a random permutation
    scores about 2 / N. Report it only beside `num_correct`.

    Args:
        predicted: (B, N) int64.
        match: (B, N) int64, of two clouds of N points each.

    Returns:
        (B,) int64.
    """
    n = match.shape[1]
    matched_back = match.gather(1, predicted.clamp(0, n - 1))
    correct = (matched_back == torch.arange(n, device=match.device)) & (predicted < n)
    return correct.sum(1)


def outlier_counts(predicted: Tensor, match: Tensor, num_target: int) -> tuple[Tensor, ...]:
    """Count correct, predicted and true outliers, for precision and recall.

    Args:
        predicted: (B, N) int64, num_target where a point is predicted to be an outlier.
        match: (B, N) int64, num_target where a point is an outlier.
        num_target: M.

    Returns:
        Three tensors (B,) int64.
    """
    positive, true = predicted == num_target, match == num_target
    return (positive & true).sum(1), positive.sum(1), true.sum(1)


def outliers_retrieved(weight: Tensor, match: Tensor, num_target: int) -> Tensor:
    """Count the true outliers among as many points of the lowest weight.

    Their share of the true outliers is the precision and the recall of the threshold at which the
    two are equal (R-precision). It compares matrices whose arg max trades one for the other.

    Args:
        weight: (B, N) probability of not being an outlier.
        match: (B, N) int64, num_target where a point is an outlier.
        num_target: M.

    Returns:
        (B,) int64.
    """
    true = match == num_target
    rank = weight.argsort(1).argsort(1)
    return (true & (rank < true.sum(1, keepdim=True))).sum(1)


def chamfer(prediction: Prediction, batch: PairBatch) -> Tensor:
    """Compute RPMNet's modified Chamfer distance, with squared distances (RPM-Net, section 5.3).

    It is the mean squared distance of the aligned source to the clean target plus that of the
    target to the clean source under the prediction. "Clean" is the whole cloud, so that a crop
    costs nothing.

    Returns:
        (B,) float64.
    """
    aligned = rigid.apply(prediction.rotation, prediction.translation, batch.source[..., :3])
    clean_target = rigid.apply(batch.rotation, batch.translation, batch.clean)
    clean_source = rigid.apply(prediction.rotation, prediction.translation, batch.clean)
    to_target = _nearest_squared(aligned, clean_target)
    to_source = _nearest_squared(batch.target[..., :3], clean_source)
    return to_target.mean(1) + to_source.mean(1)


class RegistrationMetrics(Metric):
    """Collects the prediction for each pair; `per_pair` scores it, `compute` summarises it.

    The state is transforms and counts, never a mean of means, so the batch size has no effect.
    """

    full_state_update = False
    _OUTLIERS = "outliers_correct", "outliers_predicted", "outliers_true", "outliers_retrieved"
    _STATE = (
        "shape", "predicted", "truth", "num_correct", "num_correct_transposed", "num_matchable",
        "chamfer_distance", *_OUTLIERS,
    )  # fmt: skip

    def __init__(self, sync_on_compute: bool = True) -> None:
        super().__init__(sync_on_compute=sync_on_compute)
        for name in self._STATE:
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, prediction: Prediction, batch: PairBatch) -> None:
        """Add a batch."""
        n, m, c = batch.source.shape[1], batch.target.shape[1], prediction.correspondence
        missing = torch.full(
            (len(batch),), torch.nan, dtype=torch.float64, device=batch.source.device
        )
        correct, transposed, outliers = missing, missing, [missing] * len(self._OUTLIERS)
        if c is not None:
            predicted = c.argmax()
            correct = num_correct(predicted, batch.match, m).double()
            if n == m and is_match(batch.match, m).all():
                transposed = num_correct_transposed(predicted, batch.match).double()
            if c.outlier is not None:
                ranked = outliers_retrieved(c.weight(), batch.match, m)
                counts = *outlier_counts(predicted, batch.match, m), ranked
                outliers = [x.double() for x in counts]
        values = {
            "shape": batch.shape,
            "predicted": _flatten(prediction.rotation, prediction.translation),
            "truth": _flatten(batch.rotation, batch.translation),
            "num_correct": correct,
            "num_correct_transposed": transposed,
            "num_matchable": is_match(batch.match, m).sum(1),
            "chamfer_distance": chamfer(prediction, batch).double(),
            **dict(zip(self._OUTLIERS, outliers, strict=True)),
        }
        for name in self._STATE:
            getattr(self, name).append(values[name])

    def per_pair(self) -> dict[str, Tensor]:
        """Compute every quantity of every pair on the CPU.

        Returns:
            Tensors (B,); Euler angles are (B, 3), transforms (B, 12): rotation row by row, then
            translation.
        """
        cat = {name: dim_zero_cat(getattr(self, name)).cpu() for name in self._STATE}
        (r, t), (true_r, true_t) = _unflatten(cat["predicted"]), _unflatten(cat["truth"])
        return {
            "shape": cat["shape"],
            "transform": cat["predicted"],
            "true_transform": cat["truth"],
            "rotation_error_deg": rotation_error_deg(r, true_r),
            "relative_euler_error_deg": relative_euler_error_deg(r, true_r),
            "naive_euler_error_deg": naive_euler_error_deg(r, true_r),
            "translation_error": translation_error(t, true_t),
            "num_correct": cat["num_correct"],
            "num_correct_transposed": cat["num_correct_transposed"],
            "num_matchable": cat["num_matchable"],
            "chamfer": cat["chamfer_distance"],
            **{name: cat[name] for name in self._OUTLIERS},
        }

    def compute(self) -> dict[str, float]:
        """Compute the `summary` of all pairs seen."""
        return summary(self.per_pair())


def summary(per_pair: dict[str, Tensor]) -> dict[str, float]:
    """Summarise many pairs: angles in degrees, lengths in units of the unit sphere.

    A pair without a finite rotation counts in `failed`, as 180 degrees in the median, makes means
    NaN and is a miss in recall.
    """
    angle, shift = per_pair["rotation_error_deg"], per_pair["translation_error"]
    relative, naive = per_pair["relative_euler_error_deg"], per_pair["naive_euler_error_deg"]
    recalled = (angle < RECALL_DEG) & (shift < RECALL_UNITS)
    values = {
        "rotation_error_deg_mean": angle.mean(),
        "rotation_error_deg_median": angle.nan_to_num(nan=180.0).median(),
        "relative_euler_rmse_deg": relative.square().mean().sqrt(),
        "relative_euler_mae_deg": relative.abs().mean(),
        "naive_euler_rmse_deg": naive.square().mean().sqrt(),
        "translation_rmse": (shift.square().mean() / 3).sqrt(),
        "match_accuracy": _ratio(per_pair, "num_correct", "num_matchable"),
        "transposed_match_accuracy": _ratio(per_pair, "num_correct_transposed", "num_matchable"),
        "outlier_precision": _ratio(per_pair, "outliers_correct", "outliers_predicted"),
        "outlier_recall": _ratio(per_pair, "outliers_correct", "outliers_true"),
        "outlier_r_precision": _ratio(per_pair, "outliers_retrieved", "outliers_true"),
        "chamfer": per_pair["chamfer"].mean(),
        "recall@5deg_0.05": recalled.double().mean(),
        "failed": (~angle.isfinite()).double().sum(),
        "pairs": torch.tensor(float(len(angle))),
    }
    return {name: float(value) for name, value in values.items()}


def _ratio(per_pair: dict[str, Tensor], numerator: str, denominator: str) -> Tensor:
    return per_pair[numerator].sum() / per_pair[denominator].sum()


def _flatten(rotation: Tensor, translation: Tensor) -> Tensor:
    return torch.cat([rotation.detach().flatten(1), translation.detach()], 1)


def _unflatten(transform: Tensor) -> tuple[Tensor, Tensor]:
    return transform[:, :9].unflatten(1, (3, 3)), transform[:, 9:]


def _euler_deg(rotation: Tensor) -> Tensor:
    """Compute zyx Euler angles (B, 3) of rotations (B, 3, 3), in degrees; NaN stays NaN."""
    matrix = rotation.detach().cpu().double().numpy()
    angles = np.full(matrix.shape[:-1], np.nan)
    finite = np.isfinite(matrix).all((-1, -2))
    if finite.any():
        angles[finite] = Rotation.from_matrix(matrix[finite]).as_euler("zyx", degrees=True)
    return torch.from_numpy(angles).to(rotation.device)


def _nearest_squared(points: Tensor, cloud: Tensor) -> Tensor:
    neighbor = gather_points(cloud, nearest(points, cloud))
    return (points.double() - neighbor.double()).square().sum(-1)
