"""The network that verifies hypotheses: does a transform align two clouds correctly?

Single numbers, such as how near the clouds' points are, prefer many a wrong pose to the right one:
half a chair lies well on the other half turned over. This network looks at every point under the
transform, at what lies nearest to it, and at what the matching network thought of both.
"""

import torch
from torch import Tensor, nn

from corrmat.errors import require_positive
from corrmat.networks.attention import FeedForward

EVIDENCE = 18  # numbers a point, the last three its position; see `registration.verification`


class VerificationNetwork(nn.Module):
    """Points ask the nearest point of the other cloud, and all points, a few times; then pool.

    Args:
        width: feature dimension.
        layers: of messages between the points.
        features: dimension of the matching network's features.
    """

    def __init__(self, width: int = 64, layers: int = 3, features: int = 128) -> None:
        super().__init__()
        require_positive(width=width, layers=layers, features=features)
        self.features = nn.Linear(features, width, bias=False)
        self.embed = FeedForward(EVIDENCE, width, width)
        self.layers = nn.ModuleList(MessageLayer(width) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.score = FeedForward(2 * width, width, 1)

    def forward(self, features: Tensor, evidence: Tensor, nearest: Tensor) -> Tensor:
        """Score transforms by the points of both clouds under each of them.

        Args:
            features: (P, features) or (T, P, features), the matching network's, of all points.
            evidence: (T, P, EVIDENCE) of the points under each transform.
            nearest: (T, P) for each point, the index of the nearest one of the other cloud.

        Returns:
            (T,) logits; the softmax over a pair's transforms says which of them is right.
        """
        x = self.embed(evidence) + self.features(features)
        for layer in self.layers:
            x = layer(x, nearest)
        x = self.norm(x)
        return self.score(torch.cat([x.mean(1), x.amax(1)], 1)).squeeze(1)


class MessageLayer(nn.Module):
    """Update a point by itself, the nearest point of the other cloud, and the mean of all."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.message = nn.Linear(width, width)
        self.norm = nn.LayerNorm(3 * width)
        self.update = FeedForward(3 * width, 2 * width, width)

    def forward(self, x: Tensor, nearest: Tensor) -> Tensor:
        """Update features (T, P, d), given the nearest points (T, P)."""
        message = self.message(x)
        index = nearest + torch.arange(len(x), device=x.device).unsqueeze(1) * x.shape[1]
        received = message.flatten(0, 1)[index.flatten()].view_as(x)
        everywhere = x.mean(1, keepdim=True).expand_as(x)
        return x + self.update(self.norm(torch.cat([x, received, everywhere], -1)))
