"""RANSAC on weighted matches: from matches of which many are wrong to rigid transforms."""

import math

import torch
from torch import Tensor

from corrmat.ops import rigid

_REFITS = 5  # weighted fits of a transform to the matches that it explains
_SAME_ROTATION = math.cos(math.radians(10))  # closer rotations count as one hypothesis


@torch.no_grad()
def ransac(
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    inlier_threshold: float,
    *,
    generator: torch.Generator,
    draws: int = 20000,
    fits: int = 1000,
    count: int = 8,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the rigid transforms that most of the matches agree on.

    All hypotheses are evaluated at once, as a batch. Three matches make a hypothesis. Triples
    whose triangles differ in a side by more than the threshold cannot be rigid and are dropped
    before anything is fitted. A transform scores the weight of the matches that it explains, each
    less the larger its residual (MSAC, Torr & Zisserman 2000). The best distinct transforms are
    refitted to the matches that they explain.

    Args:
        x: (K, 3) source points of K matches, at least three.
        y: (K, 3) their targets.
        weight: (K,) weight of each match; also its probability of being drawn.
        inlier_threshold: largest residual of a match, in units of the points.
        generator: random generator of the draws.
        draws: triples drawn.
        fits: transforms fitted to the triples that are left.
        count: transforms returned at most.

    Returns:
        Rotations (T, 3, 3), translations (T, 3) and scores (T,), best first; T = 0 if no triple
        of matches is rigid, or no match has a weight.
    """
    x, y, weight = x.double(), y.double(), weight.double()
    if not (weight > 0).any():
        return x.new_empty(0, 3, 3), x.new_empty(0, 3), x.new_empty(0)
    triple = torch.multinomial(weight, 3 * draws, replacement=True, generator=generator).view(-1, 3)
    sides_x, sides_y = _side_lengths(x[triple]), _side_lengths(y[triple])
    rigid_enough = (sides_x - sides_y).abs().amax(1) < inlier_threshold
    wide_enough = sides_x.amin(1) > 2 * inlier_threshold
    triple = triple[rigid_enough & wide_enough][:fits]
    if not len(triple):
        return x.new_empty(0, 3, 3), x.new_empty(0, 3), x.new_empty(0)
    rotation, translation = rigid.procrustes(x[triple], y[triple])
    score, _ = _score(rotation, translation, x, y, weight, inlier_threshold)
    best = _best_distinct(rotation, score, count)
    rotation, translation = rotation[best], translation[best]
    for _ in range(_REFITS):
        _, explained = _score(rotation, translation, x, y, weight, inlier_threshold)
        matches = x.expand(len(rotation), -1, -1), y.expand(len(rotation), -1, -1)
        rotation, translation = rigid.procrustes(*matches, explained)
    score, _ = _score(rotation, translation, x, y, weight, inlier_threshold)
    best = _best_distinct(rotation, score, count)
    return rotation[best], translation[best], score[best]


def _side_lengths(triangle: Tensor) -> Tensor:
    """Compute the side lengths (T, 3) of triangles (T, 3, 3)."""
    return (triangle - triangle.roll(1, 1)).norm(dim=-1)


def _score(
    rotation: Tensor,
    translation: Tensor,
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    inlier_threshold: float,
) -> tuple[Tensor, Tensor]:
    """Compute the scores (T,) of transforms and each match's contribution (T, K) to them."""
    residual = rigid.apply(rotation, translation, x.expand(len(rotation), -1, -1)) - y
    squared = residual.square().sum(-1)
    explained = weight * (1 - squared / inlier_threshold**2).clamp_min(0)
    return explained.sum(1), explained


def _best_distinct(rotation: Tensor, score: Tensor, count: int) -> Tensor:
    """Select up to `count` indices by falling score, skipping rotations near a better one."""
    candidates, selected = score.argsort(descending=True), []
    while len(candidates) and len(selected) < count:
        best = candidates[0]
        selected.append(best)
        cosine = ((rotation[candidates] * rotation[best]).sum((1, 2)) - 1) / 2
        candidates = candidates[cosine < _SAME_ROTATION]
        candidates = candidates[candidates != best]
    return torch.stack(selected)
