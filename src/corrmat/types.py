"""Data that flows between the parts: a batch of pairs, and a network's prediction for it."""

from dataclasses import dataclass, fields, replace
from typing import Protocol, Self

import torch
from torch import Tensor

from corrmat.ops.correspondence import SoftCorrespondence

# Largest distance of matching points in two clouds that share none: about the spacing of
# neighbours among 512 points on a shape of radius 1.
MATCH_DISTANCE = 0.08


@dataclass
class PairBatch:
    """B pairs of clouds and their truth: `rotation @ x + translation` takes source onto target."""

    source: Tensor  # (B, N, 6) xyz and unit normals; networks that need xyz take the first 3
    target: Tensor  # (B, M, 6)
    rotation: Tensor  # (B, 3, 3)
    translation: Tensor  # (B, 3)
    match: Tensor  # (B, N) int64: index of the true match in target; M marks an outlier
    clean: Tensor  # (B, P, 3) the whole clean cloud in the source's frame, for Chamfer distances
    shape: Tensor  # (B,) int64: index of the pair's shape in its split

    def to(self, device: torch.device | str, **kwargs: bool) -> Self:
        """Move the batch to another device (Lightning's transfer protocol)."""
        moved = {f.name: getattr(self, f.name).to(device, **kwargs) for f in fields(self)}
        return replace(self, **moved)

    def pin_memory(self) -> Self:
        """Copy the batch to page-locked memory (the DataLoader's protocol)."""
        return replace(self, **{f.name: getattr(self, f.name).pin_memory() for f in fields(self)})

    def __len__(self) -> int:
        return len(self.source)


@dataclass
class Prediction:
    """A network's prediction for B pairs."""

    rotation: Tensor  # (B, 3, 3)
    translation: Tensor  # (B, 3)
    correspondence: SoftCorrespondence | None = None  # None for networks that regress the pose
    earlier: "tuple[Prediction, ...]" = ()  # predictions of the iterations before, if any

    @property
    def steps(self) -> "list[Prediction]":
        """One prediction an iteration, this one last."""
        return [*self.earlier, self]


def last_of(steps: list[Prediction]) -> Prediction:
    """Return the last prediction of an iterative network, with the earlier ones attached."""
    *earlier, last = steps
    return replace(last, earlier=tuple(earlier))


class RegistrationNetwork(Protocol):
    """A network that a method can train: an `nn.Module` with these two members."""

    min_points: int
    """Fewest points of a cloud that the network can process."""

    def __call__(self, source: Tensor, target: Tensor) -> Prediction:
        """Register source (B, N, C) to target (B, M, C); C = 3, or 6 with unit normals."""
        ...


def fewest_points(network: object) -> int:
    """Return a network's `min_points`; 3, which determine a rotation, if it does not say."""
    return int(getattr(network, "min_points", 3))
