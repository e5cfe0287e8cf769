"""From weighted matches, many of them wrong, to the motions that most of them agree on."""

import math

import torch
from torch import Tensor

from corrmat.ops import rigid

_ROUNDS = 5  # of refitting a motion to the matches it explains
_SAME = math.cos(math.radians(10))  # nearer than this two motions count as one


@torch.no_grad()
def consensus(
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    reach: float,
    *,
    generator: torch.Generator,
    draws: int = 20000,
    fits: int = 1000,
    count: int = 8,
) -> tuple[Tensor, Tensor, Tensor]:
    """RANSAC over all hypotheses at once.

    Three matches make a motion; those whose triangles differ in a side by more than `reach` can
    make no rigid one and are left out before anything is fitted. A motion's score is the weight
    of the matches that it explains, each counting less the farther it stays off (MSAC). The best
    ones that differ are refitted to what they explain.

    Args:
        x: (K, 3) source points of K matches, at least three.
        y: (K, 3) their targets.
        weight: (K,) how much each is worth; also how often it is drawn.
        reach: how far off a match may stay, in units of the points.
        generator: of the draws.
        draws: triples drawn.
        fits: motions fitted to those that are left.
        count: motions returned at most.

    Returns:
        Rotations (T, 3, 3), translations (T, 3) and scores (T,), best first; T = 0 where no
        triple of matches is rigid.
    """
    x, y, weight = x.double(), y.double(), weight.double()
    triple = torch.multinomial(weight, 3 * draws, replacement=True, generator=generator).view(-1, 3)
    sides_x, sides_y = _sides(x[triple]), _sides(y[triple])
    rigid_enough = (sides_x - sides_y).abs().amax(1) < reach
    wide_enough = sides_x.amin(1) > 2 * reach
    triple = triple[rigid_enough & wide_enough][:fits]
    if not len(triple):
        return x.new_empty(0, 3, 3), x.new_empty(0, 3), x.new_empty(0)
    rotation, translation = rigid.procrustes(x[triple], y[triple])
    chosen = _distinct(rotation, _score(rotation, translation, x, y, weight, reach)[0], count)
    rotation, translation = rotation[chosen], translation[chosen]
    for _ in range(_ROUNDS):
        _, explained = _score(rotation, translation, x, y, weight, reach)
        every = x.expand(len(rotation), -1, -1), y.expand(len(rotation), -1, -1)
        rotation, translation = rigid.procrustes(*every, explained)
    score, _ = _score(rotation, translation, x, y, weight, reach)
    chosen = _distinct(rotation, score, count)
    return rotation[chosen], translation[chosen], score[chosen]


def _sides(triangle: Tensor) -> Tensor:
    """Lengths (T, 3) of the sides of triangles (T, 3, 3)."""
    return (triangle - triangle.roll(1, 1)).norm(dim=-1)


def _score(
    rotation: Tensor, translation: Tensor, x: Tensor, y: Tensor, weight: Tensor, reach: float
) -> tuple[Tensor, Tensor]:
    """Scores (T,) of motions, and what each match (T, K) adds to them."""
    squares = (rigid.apply(rotation, translation, x.expand(len(rotation), -1, -1)) - y).square()
    explained = weight * (1 - squares.sum(-1) / reach**2).clamp_min(0)
    return explained.sum(1), explained


def _distinct(rotation: Tensor, score: Tensor, count: int) -> Tensor:
    """Indices by falling score, at most `count`, without those that turn nearly as a better one."""
    left, chosen = score.argsort(descending=True), []
    while len(left) and len(chosen) < count:
        best = left[0]
        chosen.append(best)
        cosine = ((rotation[left] * rotation[best]).sum((1, 2)) - 1) / 2
        left = left[cosine < _SAME]
        left = left[left != best]
    return torch.stack(chosen)
