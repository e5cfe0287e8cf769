"""What a method is trained on: one mixin a loss, over a plain function.

A method is a mixin in front of `RegistrationModule`. DCP and DCP_corr differ in this one base
class and in nothing else; RPMNet's two in their learning rate as well, PCRNet's in their network
(paper section 5).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from corrmat.ops import rigid
from corrmat.ops.correspondence import MatchabilityCorrespondence, SoftCorrespondence
from corrmat.ops.neighbors import nearest, take
from corrmat.types import PairBatch, Prediction

DISCOUNT = 0.5  # of an iteration against the next
INLIER_WEIGHT = 0.01


def transformation_loss(
    rotation: Tensor, translation: Tensor, true_rotation: Tensor, true_translation: Tensor
) -> Tensor:
    """L_DCP = ||R^T R* - I||^2 + ||t - t*||^2, both as means over elements (paper section 5.1).

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
        turned = (rotation.mT @ true_rotation - identity).square().mean()
    return turned + (translation - true_translation).square().mean()


def correspondence_loss(c: SoftCorrespondence, match: Tensor) -> Tensor:
    """L_CE: mean cross-entropy of the rows of C that have a match (paper section 4).

    Args:
        c: the predicted matrix, N rows.
        match: (B, N) int64, the class of each row; rows without one do not count.

    Returns:
        A scalar.
    """
    return c.nll(match).sum() / c.is_class(match).sum().clamp_min(1)


def registration_loss(prediction: Prediction, batch: PairBatch) -> Tensor:
    """One iteration of L_RPMNet: mean L1 distance of source points, and doubt (paper section 5.2).

    Doubt is how much the rows and columns of the matrix lack to one, on average, times 0.01:
    RPM-Net's L_inlier, which keeps it from calling every point unmatched.

    Returns:
        A scalar.
    """
    if prediction.correspondence is None:
        raise ValueError("this network predicts no correspondence to be sure of")
    source = batch.source[..., :3]
    moved = rigid.apply(prediction.rotation, prediction.translation, source)
    truth = rigid.apply(batch.rotation, batch.translation, source)
    prob = prediction.correspondence.prob()
    doubt = (1 - prob.sum(1)).mean() + (1 - prob.sum(2)).mean()
    return (moved - truth).abs().mean() + INLIER_WEIGHT * doubt


def chamfer_loss(moved: Tensor, target: Tensor) -> Tensor:
    """CD: mean distance to the nearest point, there and back, not squared (paper section 5.3).

    Exact, with memory linear in the number of points.

    Args:
        moved: (B, N, 3).
        target: (B, M, 3).

    Returns:
        A scalar.
    """
    there = moved - take(target, nearest(moved, target))
    back = target - take(moved, nearest(target, moved))
    return there.norm(dim=-1).mean() + back.norm(dim=-1).mean()


def mutual_matches(moved: Tensor, target: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Matches of two clouds that share no point: nearest to each other, and near.

    Args:
        moved: (B, N, 3) source, where it truly lies.
        target: (B, M, 3).
        reach: beyond it, no match.

    Returns:
        Classes (B, N) of source points and (B, M) of target points: the index of the match; M
        (or N) where nothing is in reach; -1, no class, where something is but prefers another.
    """
    there, back = nearest(moved, target), nearest(target, moved)

    def classes(own: Tensor, cloud: Tensor, to: Tensor, fro: Tensor) -> Tensor:
        near = (own - take(cloud, to)).norm(dim=-1) <= reach
        mutual = fro.gather(1, to) == torch.arange(to.shape[1], device=to.device)
        return torch.where(near, torch.where(mutual, to, -1), cloud.shape[1])

    return classes(moved, target, there, back), classes(target, moved, back, there)


def mutual_loss(c: MatchabilityCorrespondence, matches: tuple[Tensor, Tensor]) -> Tensor:
    """Cross-entropy over the rows and over the columns of C, as `mutual_matches` labels them."""
    return (
        correspondence_loss(c, matches[0]) + correspondence_loss(c.transposed(), matches[1])
    ) / 2


def discounted(losses: Sequence[Tensor]) -> Tensor:
    """Sum over the iterations of a network, each worth half the next (RPM-Net)."""
    total = losses[0]
    for loss in losses[1:]:
        total = DISCOUNT * total + loss
    return total


class TransformationLoss:
    """Train on the error of the transform: METHOD, for DCP."""

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """`transformation_loss` of a batch."""
        return transformation_loss(
            prediction.rotation, prediction.translation, batch.rotation, batch.translation
        )


class CorrespondenceLoss:
    """Train on the correspondence matrix: METHOD_corr."""

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """`correspondence_loss` of a batch, `discounted` over iterations, if there are any."""
        found = [step.correspondence for step in prediction.steps]
        if None in found:
            raise ValueError("this network predicts no correspondence to train on")
        return discounted([correspondence_loss(c, batch.match) for c in found if c is not None])


class MutualLoss:
    """Train on the correspondence matrix of two clouds of which each lacks parts of the other."""

    reach = 0.08  # about the distance of neighbours among 512 points of a unit ball's shape

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """`mutual_loss` of a batch, `discounted` over the layers."""
        found = [step.correspondence for step in prediction.steps]
        moved = rigid.apply(batch.rotation, batch.translation, batch.source[..., :3])
        matches = mutual_matches(moved, batch.target[..., :3], self.reach)
        known = [c for c in found if isinstance(c, MatchabilityCorrespondence)]
        if len(known) < len(found):
            raise ValueError("this network has no doubt about target points to train")
        return discounted([mutual_loss(c, matches) for c in known])


class RegistrationLoss:
    """Train on distances of transformed points: METHOD, for RPMNet."""

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """`registration_loss` of a batch, `discounted` over the iterations."""
        return discounted([registration_loss(step, batch) for step in prediction.steps])


class ChamferLoss:
    """Train on the distance of the two clouds: METHOD, for PCRNet. It needs no truth."""

    def loss(self, prediction: Prediction, batch: PairBatch) -> Tensor:
        """`chamfer_loss` of the source, moved as predicted, and the target."""
        source, target = batch.source[..., :3], batch.target[..., :3]
        return chamfer_loss(
            rigid.apply(prediction.rotation, prediction.translation, source), target
        )
