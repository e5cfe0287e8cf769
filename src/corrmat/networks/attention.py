"""DCP's transformer: one encoder and one decoder block, pre-norm, no dropout, as released."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from corrmat.errors import CorrmatError, require_positive


class Transformer(nn.Module):
    """The pointer of DCP v2: updates a cloud's features with attention to the other cloud's.

    Args:
        width: feature dimension, a multiple of heads.
        heads: attention heads.
        feedforward: hidden width of the feed-forward blocks.
    """

    def __init__(self, width: int = 512, heads: int = 4, feedforward: int = 1024) -> None:
        super().__init__()
        require_positive(width=width, feedforward=feedforward)
        self.encoder = EncoderBlock(width, heads, feedforward)
        self.decoder = DecoderBlock(width, heads, feedforward)
        self.encoder_norm = StdNorm(width)
        self.decoder_norm = StdNorm(width)

    def forward(self, features: Tensor, other: Tensor) -> Tensor:
        """Compute decoder(features, encoder(other)): (B, N, d), (B, M, d) -> (B, N, d)."""
        memory = self.encoder_norm(self.encoder(other))
        return self.decoder_norm(self.decoder(features, memory))


class EncoderBlock(nn.Module):
    """Self-attention and feed-forward, each pre-norm with a residual connection."""

    def __init__(self, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.self_attention = Attention(width, heads)
        self.feedforward = FeedForward(width, feedforward)
        self.norms = nn.ModuleList(StdNorm(width) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, N, d) to (B, N, d)."""
        normed = self.norms[0](x)
        x = x + self.self_attention(normed, normed)
        return x + self.feedforward(self.norms[1](x))


class DecoderBlock(nn.Module):
    """Self-attention, cross-attention to the other cloud, and feed-forward."""

    def __init__(self, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.self_attention = Attention(width, heads)
        self.cross_attention = Attention(width, heads)
        self.feedforward = FeedForward(width, feedforward)
        self.norms = nn.ModuleList(StdNorm(width) for _ in range(3))

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """Map (B, N, d) and memory (B, M, d) to (B, N, d)."""
        normed = self.norms[0](x)
        x = x + self.self_attention(normed, normed)
        x = x + self.cross_attention(self.norms[1](x), memory)
        return x + self.feedforward(self.norms[2](x))


class Attention(nn.Module):
    """Multi-head attention."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        if heads < 1 or width % heads:
            raise CorrmatError(f"width {width} is not a multiple of {heads} heads")
        self.heads = heads
        self.query, self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(4))

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """Let each of x (B, N, d) attend to memory (B, M, d); return (B, N, d)."""
        q, k, v = (
            layer(t).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for layer, t in ((self.query, x), (self.key, memory), (self.value, memory))
        )
        return self.out(_attend(q, k, v).transpose(1, 2).flatten(-2))


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Compute softmax(Q K^T / sqrt(size)) V for (B, H, N, size) and (B, H, M, size)."""
    if q.device.type == "cpu" and q.dtype == torch.bfloat16:  # where the fused kernel is slow
        return (q * q.shape[-1] ** -0.5 @ k.mT).softmax(-1) @ v
    return F.scaled_dot_product_attention(q, k, v)


class FeedForward(nn.Sequential):
    """Linear, ReLU, linear."""

    def __init__(self, width: int, hidden: int, out: int | None = None) -> None:
        super().__init__(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, out or width))


class StdNorm(nn.Module):
    """The annotated transformer's LayerNorm: gain * (x - mean) / (std + 1e-6) + bias.

    The original uses the unbiased std. torch's fused kernel divides by the biased one, so the
    gain is corrected. The 1e-6 that the original adds to a std near one is left out; a constant
    row gives the bias, as in the original.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise over the last dimension."""
        width = x.shape[-1]
        unbiased = ((width - 1) / width) ** 0.5
        return F.layer_norm(x, (width,), self.gain * unbiased, self.bias, eps=1e-12)
