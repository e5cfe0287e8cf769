"""What a method is trained on: one mixin a loss, over a plain function.

A method is a mixin in front of `RegistrationModule`: the paper's METHOD and METHOD_corr
differ in this one base class and in nothing else.
"""

import torch
from torch import Tensor

from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.types import PairBatch, Prediction


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
        """`correspondence_loss` of a batch."""
        if prediction.correspondence is None:
            raise ValueError("this network predicts no correspondence to train on")
        return correspondence_loss(prediction.correspondence, batch.match)
