"""Training losses: a pure function each, and a mixin that makes it a method's loss.

A method is a loss mixin in front of `methods.Method`. DCP and DCP_corr differ in this base class
and in nothing else. RPMNet's two methods also differ in their learning rate, and PCRNet's in their
network (paper section 5). A mixin's hyper-parameters are the fields of its `LossSettings`; they
form the `loss:` group of a recipe.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from corrmat.ops import rigid
from corrmat.ops.correspondence import MatchabilityCorrespondence, SoftCorrespondence
from corrmat.ops.neighbors import gather_points, nearest
from corrmat.types import MATCH_DISTANCE, PairBatch, Prediction


def transformation_loss(
    rotation: Tensor, translation: Tensor, true_rotation: Tensor, true_translation: Tensor
) -> Tensor:
    """Compute L_DCP = ||R^T R* - I||^2 + ||t - t*||^2, means over elements (section 5.1).

    Args:
        rotation: (B, 3, 3) predicted.
        translation: (B, 3) predicted.
        true_rotation: (B, 3, 3).
        true_translation: (B, 3).

    Returns:
        A scalar.
    """
    identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    with torch.autocast(rotation.device.type, enabled=False):
        rotation_loss = (rotation.mT @ true_rotation - identity).square().mean()
    return rotation_loss + (translation - true_translation).square().mean()


def correspondence_loss(c: SoftCorrespondence, match: Tensor) -> Tensor:
    """Compute L_CE: mean cross-entropy of the rows of C that have a match (paper section 4).

    Args:
        c: the predicted matrix, N rows.
        match: (B, N) int64, the class of each row; rows without a class are ignored.

    Returns:
        A scalar; 0 if no row has a class.

    Raises:
        ValueError: see `SoftCorrespondence.nll`.
    """
    return c.nll(match).sum() / c.is_class(match).sum().clamp_min(1)


def registration_loss(
    prediction: Prediction, batch: PairBatch, inlier_weight: float = 0.01
) -> Tensor:
    """Compute one iteration of L_RPMNet = L_reg + inlier_weight * L_inlier (paper section 5.2).

    L_reg is the mean L1 distance of the source points under both transforms. L_inlier is the mean
    unmatched probability of source and target points; without it, every point would be unmatched.

    Args:
        prediction: with a correspondence matrix.
        batch: the pairs.
        inlier_weight: weight of L_inlier.

    Returns:
        A scalar.

    Raises:
        ValueError: the network predicts no correspondence matrix.
    """
    if prediction.correspondence is None:
        raise ValueError("RPMNet's loss needs a network that predicts a correspondence matrix")
    source = batch.source[..., :3]
    moved = rigid.apply(prediction.rotation, prediction.translation, source)
    truth = rigid.apply(batch.rotation, batch.translation, source)
    prob = prediction.correspondence.prob()
    unmatched_probability = (1 - prob.sum(1)).mean() + (1 - prob.sum(2)).mean()
    return (moved - truth).abs().mean() + inlier_weight * unmatched_probability


def chamfer_loss(moved: Tensor, target: Tensor) -> Tensor:
    """Compute CD: mean distance to the nearest point, both ways, not squared (section 5.3).

    The result is exact; memory is linear in the number of points.

    Args:
        moved: (B, N, 3).
        target: (B, M, 3).

    Returns:
        A scalar.
    """
    to_target = moved - gather_points(target, nearest(moved, target))
    to_moved = target - gather_points(moved, nearest(target, moved))
    return to_target.norm(dim=-1).mean() + to_moved.norm(dim=-1).mean()


def mutual_matches(moved: Tensor, target: Tensor, max_distance: float) -> tuple[Tensor, Tensor]:
    """Label two clouds that share no point with their mutual nearest neighbours.

    Args:
        moved: (B, N, 3) source points in the target's frame.
        target: (B, M, 3).
        max_distance: largest distance of a match.

    Returns:
        Classes (B, N) of source points and (B, M) of target points: the index of the match; M
        (or N) if no point is within `max_distance`; -1, no class, if one is but its own nearest
        neighbour is another point.
    """
    to_target, to_moved = nearest(moved, target), nearest(target, moved)

    def classes(points: Tensor, cloud: Tensor, index: Tensor, back: Tensor) -> Tensor:
        near = (points - gather_points(cloud, index)).norm(dim=-1) <= max_distance
        mutual = back.gather(1, index) == torch.arange(index.shape[1], device=index.device)
        return torch.where(near, torch.where(mutual, index, -1), cloud.shape[1])

    return classes(moved, target, to_target, to_moved), classes(target, moved, to_moved, to_target)


def mutual_loss(c: MatchabilityCorrespondence, matches: tuple[Tensor, Tensor]) -> Tensor:
    """Compute the cross-entropy over rows and columns of C, labelled by `mutual_matches`."""
    over_rows = correspondence_loss(c, matches[0])
    return (over_rows + correspondence_loss(c.transposed(), matches[1])) / 2


def discounted(losses: Sequence[Tensor], discount: float) -> Tensor:
    """Sum losses over iterations, each weighted `discount` times the next (RPM-Net, 5.4)."""
    total = losses[0]
    for loss in losses[1:]:
        total = discount * total + loss
    return total


@dataclass(frozen=True)
class NoSettings:
    """Settings of a loss without hyper-parameters."""


@dataclass(frozen=True)
class IterationSettings:
    """Settings of a loss that is summed over iterations.

    Args:
        discount: weight of an iteration relative to the next.
    """

    discount: float = 0.5


@dataclass(frozen=True)
class RegistrationLossSettings(IterationSettings):
    """Settings of RPMNet's own loss.

    Args:
        discount: weight of an iteration relative to the next.
        inlier_weight: weight of L_inlier.
    """

    inlier_weight: float = 0.01


@dataclass(frozen=True)
class MutualLossSettings(IterationSettings):
    """Settings of the loss on mutual nearest neighbours.

    Args:
        discount: weight of an iteration relative to the next.
        max_distance: largest distance of a match, in units of the unit sphere.
    """

    max_distance: float = MATCH_DISTANCE


class TransformationLoss:
    """Train on the error of the transform: METHOD, for DCP."""

    LossSettings = NoSettings

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """Compute `transformation_loss` of a batch."""
        return transformation_loss(
            prediction.rotation, prediction.translation, batch.rotation, batch.translation
        )


class CorrespondenceLoss:
    """Train on the correspondence matrix: METHOD_corr."""

    LossSettings = IterationSettings
    loss_settings: IterationSettings = IterationSettings()

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """Compute `correspondence_loss` of a batch, discounted over iterations.

        Raises:
            ValueError: the network predicts no correspondence matrix.
        """
        matrices = [step.correspondence for step in prediction.steps]
        if None in matrices:
            raise ValueError("this loss needs a network that predicts a correspondence matrix")
        losses = [correspondence_loss(c, batch.match) for c in matrices if c is not None]
        return discounted(losses, self.loss_settings.discount)


class MutualLoss:
    """Train on the correspondence matrix of two clouds that overlap in part and share no point."""

    LossSettings = MutualLossSettings
    loss_settings: MutualLossSettings = MutualLossSettings()

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """Compute `mutual_loss` of a batch, discounted over layers.

        Raises:
            ValueError: the network predicts no matchability.
        """
        steps = [step.correspondence for step in prediction.steps]
        matrices = [c for c in steps if isinstance(c, MatchabilityCorrespondence)]
        if len(matrices) < len(steps):
            raise ValueError("this loss needs a network that predicts matchability (LightGlue)")
        moved = rigid.apply(batch.rotation, batch.translation, batch.source[..., :3])
        matches = mutual_matches(moved, batch.target[..., :3], self.loss_settings.max_distance)
        losses = [mutual_loss(c, matches) for c in matrices]
        return discounted(losses, self.loss_settings.discount)


class RegistrationLoss:
    """Train on distances of transformed points: METHOD, for RPMNet."""

    LossSettings = RegistrationLossSettings
    loss_settings: RegistrationLossSettings = RegistrationLossSettings()

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """Compute `registration_loss` of a batch, discounted over iterations."""
        weight = self.loss_settings.inlier_weight
        losses = [registration_loss(step, batch, weight) for step in prediction.steps]
        return discounted(losses, self.loss_settings.discount)


class ChamferLoss:
    """Train on the distance of the two clouds: METHOD, for PCRNet. It needs no ground truth."""

    LossSettings = NoSettings

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """Compute `chamfer_loss` between the source under the prediction and the target."""
        source, target = batch.source[..., :3], batch.target[..., :3]
        moved = rigid.apply(prediction.rotation, prediction.translation, source)
        return chamfer_loss(moved, target)
