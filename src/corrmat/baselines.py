"""Baselines that need no training: a learned network must beat them."""

from torch import Tensor, nn

from corrmat.ops import rigid
from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.types import Prediction


class Identity(nn.Module):
    """Identity baseline: the error that a method must beat."""

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Predict the identity pose for source (B, N, 3 or more); no correspondence."""
        return Prediction(*rigid.identity(source))


class Radius(nn.Module):
    """Matches points by their distance from the origin alone.

    A rotation about the origin does not change that distance. So without a translation and with
    identical points, this baseline is right up to ties and rounding, knowing nothing of shape.
    """

    SHARPNESS = 1e12  # makes the softmax an argmax, for radii 1e-5 apart

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3].double(), target[..., :3].double()
        r_x, r_y = x.norm(dim=-1, keepdim=True), y.norm(dim=-1, keepdim=True)
        # -(r_x - r_y)^2 as a dot product, up to terms that are constant along a row.
        f_x = (r_x - r_y.mean(1, keepdim=True)) * 2
        f_y = r_y - r_y.mean(1, keepdim=True)
        with_one = nn.functional.pad(f_x, (0, 1), value=1.0)
        with_square = nn.functional.pad(f_y, (0, 1)) - nn.functional.pad(f_y.square(), (1, 0))
        c = SoftCorrespondence(with_one, with_square, self.SHARPNESS)
        rotation, translation = rigid.procrustes(x, c.soft_target(y))
        return Prediction(rotation.to(source.dtype), translation.to(source.dtype), c)


BASELINES: dict[str, type[nn.Module]] = {"identity": Identity, "radius": Radius}
UNTRAINED = "untrained"  # the baseline that is the arms' own network before training
