"""What a learned network is measured against: answers that need no training."""

from torch import Tensor, nn

from corrmat.ops import rigid
from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.types import Prediction


class Identity(nn.Module):
    """Says that nothing has moved: what an error means that has not come down from it."""

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """The identity pose of source (B, N, 3 or more); no correspondence."""
        return Prediction(*rigid.identity(source))


class Radius(nn.Module):
    """Matches points by their distance from the origin alone.

    A rotation about the origin leaves it as it is, so where there is no translation and the
    points are identical this is right but for ties and rounding. It knows nothing of shape.
    """

    SHARPNESS = 1e12  # so that the softmax is its maximum, for radii 1e-5 apart

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        x, y = source[..., :3].double(), target[..., :3].double()
        r_x, r_y = x.norm(dim=-1, keepdim=True), y.norm(dim=-1, keepdim=True)
        # -(r_x - r_y)^2 as a dot product, up to what is equal along a row.
        f_x = (r_x - r_y.mean(1, keepdim=True)) * 2
        f_y = r_y - r_y.mean(1, keepdim=True)
        c = SoftCorrespondence(_with_one(f_x), _with_square(f_y), self.SHARPNESS)
        rotation, translation = rigid.procrustes(x, c.soft_target(y))
        return Prediction(rotation.to(source.dtype), translation.to(source.dtype), c)


def _with_one(feature: Tensor) -> Tensor:
    return nn.functional.pad(feature, (0, 1), value=1.0)


def _with_square(feature: Tensor) -> Tensor:
    return nn.functional.pad(feature, (0, 1)) - nn.functional.pad(feature.square(), (1, 0))


BASELINES: dict[str, type[nn.Module]] = {"identity": Identity, "radius": Radius}
UNTRAINED = "untrained"  # the arms' own network as it is before the first step
