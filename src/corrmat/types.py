"""What flows between the parts: a batch of pairs, and what a network says of it."""

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor

from corrmat.ops.correspondence import SoftCorrespondence


@dataclass
class PairBatch:
    """B pairs of clouds and their truth: `rotation @ x + translation` takes source onto target."""

    source: Tensor  # (B, N, 6) xyz and unit normals; networks that need xyz take the first 3
    target: Tensor  # (B, M, 6)
    rotation: Tensor  # (B, 3, 3)
    translation: Tensor  # (B, 3)
    match: Tensor  # (B, N) int64: index of the true match in target; M marks an outlier
    clean: Tensor  # (B, P, 3) the whole clean cloud in the source's frame, for Chamfer distances
    shape: Tensor  # (B,) int64: which shape of the split the pair was made of

    def to(self, device: torch.device | str, **kwargs: bool) -> Self:
        """The same batch on another device (Lightning's transfer protocol)."""
        moved = {f.name: getattr(self, f.name).to(device, **kwargs) for f in fields(self)}
        return replace(self, **moved)

    def pin_memory(self) -> Self:
        """The same batch in page-locked memory (the DataLoader's protocol)."""
        return replace(self, **{f.name: getattr(self, f.name).pin_memory() for f in fields(self)})

    def __len__(self) -> int:
        return len(self.source)


@dataclass
class Prediction:
    """A network's answer for B pairs."""

    rotation: Tensor  # (B, 3, 3)
    translation: Tensor  # (B, 3)
    correspondence: SoftCorrespondence | None = None  # None for networks that regress the pose
    earlier: "tuple[Prediction, ...]" = ()  # of an iterative network: one an iteration before

    @property
    def steps(self) -> "list[Prediction]":
        """One prediction an iteration, this one last."""
        return [*self.earlier, self]


def with_earlier(steps: list[Prediction]) -> Prediction:
    """The last of an iterative network's predictions, which knows those before it."""
    *earlier, last = steps
    return replace(last, earlier=tuple(earlier))
