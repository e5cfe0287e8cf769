"""Deep Closest Point (Wang & Solomon, ICCV 2019), the network of experiments 1.1 to 1.4."""

from typing import Literal, get_args

from torch import Tensor, nn

from corrmat.errors import require_choice
from corrmat.networks.attention import Transformer
from corrmat.networks.dgcnn import DGCNN
from corrmat.networks.matching import MATCHING_HEADS, Outlier
from corrmat.ops.rigid import procrustes
from corrmat.types import Prediction

Pointer = Literal["transformer", "identity"]


class DCPNetwork(nn.Module):
    """DGCNN features, a pointer, soft correspondence, Procrustes (paper figure 4a).

    Args:
        width: feature dimension d.
        pointer: "transformer" (DCP v2) lets each cloud's features see the other's,
            "identity" (DCP v1) does not.
        heads: attention heads of the transformer.
        feedforward: hidden width of its feed-forward blocks.
        edge_channels: widths of DGCNN's edge convolutions.
        k: neighbours of each point, itself included.
        outlier: the matching head, i.e. how source points without a match get a class of their
            own (supplement A); "none" in the experiments without outliers.
    """

    def __init__(
        self,
        width: int = 512,
        pointer: Pointer = "transformer",
        heads: int = 4,
        feedforward: int = 1024,
        edge_channels: tuple[int, ...] = (64, 64, 128, 256),
        k: int = 20,
        outlier: Outlier = "none",
    ) -> None:
        super().__init__()
        require_choice("pointer", pointer, get_args(Pointer))
        require_choice("outlier", outlier, MATCHING_HEADS)
        self.min_points = k
        self.embed = DGCNN(width, edge_channels, k)
        self.pointer = Transformer(width, heads, feedforward) if pointer == "transformer" else None
        self.matching_head = MATCHING_HEADS[outlier](width)

    def features(self, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the features (B, N, d) and (B, M, d) that the matching head compares."""
        f_x, f_y = self.embed(source[..., :3]), self.embed(target[..., :3])
        if self.pointer is None:
            return f_x + f_x, f_y + f_y
        return f_x + self.pointer(f_x, f_y), f_y + self.pointer(f_y, f_x)

    def forward(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, 3 or more) to target (B, M, 3 or more); xyz are read."""
        correspondence = self.matching_head(*self.features(source, target))
        y_hat = correspondence.soft_target(target[..., :3])
        rotation, translation = procrustes(source[..., :3], y_hat, correspondence.weight())
        return Prediction(rotation, translation, correspondence)
