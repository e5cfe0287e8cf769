"""RANSAC on weighted matches: from matches of which many are wrong to rigid transforms."""

import math

import torch
from torch import Tensor

from corrmat.ops import rigid

_DRAWS = 20_000  # triples
_FITS = 1000  # transforms at most, to the triples that may be rigid
_REFITS = 5  # weighted fits of a transform to the matches that it explains
_SAME_ROTATION = math.cos(math.radians(10))  # closer rotations count as one hypothesis


@torch.no_grad()
def fit_triples(
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    inlier_threshold: float,
    *,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Fit rigid transforms to random triples of matches, all as one batch.

    Triples whose triangles differ in a side by more than the threshold cannot be rigid, and
    triangles with a side below twice the threshold fix no rotation: both are dropped before
    anything is fitted.

    Args:
        x: (K, 3) source points of K matches, at least three.
        y: (K, 3) their targets.
        weight: (K,) weight of each match; also its probability of being drawn.
        inlier_threshold: largest residual of a match, in units of the points.
        generator: random generator of the draws.

    Returns:
        Rotations (F, 3, 3) and translations (F, 3), in the order of the draws; F = 0 if no triple
        of matches is rigid, or no match has a weight.
    """
    x, y, weight = x.double(), y.double(), weight.double()
    if not (weight > 0).any():
        return x.new_empty(0, 3, 3), x.new_empty(0, 3)
    drawn = torch.multinomial(weight, 3 * _DRAWS, replacement=True, generator=generator)
    triple = drawn.view(-1, 3)
    sides_x, sides_y = _side_lengths(x[triple]), _side_lengths(y[triple])
    rigid_enough = (sides_x - sides_y).abs().amax(1) < inlier_threshold
    wide_enough = sides_x.amin(1) > 2 * inlier_threshold
    triple = triple[rigid_enough & wide_enough][:_FITS]
    if not len(triple):
        return x.new_empty(0, 3, 3), x.new_empty(0, 3)
    return rigid.procrustes(x[triple], y[triple])


@torch.no_grad()
def best_by_matches(
    rotation: Tensor,
    translation: Tensor,
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    inlier_threshold: float,
    count: int,
) -> tuple[Tensor, Tensor]:
    """Select the distinct transforms that most of the matches agree on, and refit them.

    A transform scores the weight of the matches that it explains, each less the larger its
    residual (MSAC, Torr & Zisserman 2000). The best are refitted to the matches that they explain.

    Args:
        rotation: (F, 3, 3).
        translation: (F, 3).
        x: as of `fit_triples`, and so are `y`, `weight` and `inlier_threshold`.
        y: (K, 3).
        weight: (K,).
        inlier_threshold: in units of the points.
        count: transforms returned at most.

    Returns:
        Rotations (T, 3, 3) and translations (T, 3), best first.
    """
    x, y, weight = x.double(), y.double(), weight.double()
    score, _ = _score(rotation, translation, x, y, weight, inlier_threshold)
    best = best_distinct(rotation, score, count)
    rotation, translation = rotation[best], translation[best]
    for _ in range(_REFITS):
        _, explained = _score(rotation, translation, x, y, weight, inlier_threshold)
        matches = x.expand(len(rotation), -1, -1), y.expand(len(rotation), -1, -1)
        rotation, translation = rigid.procrustes(*matches, explained)
    score, _ = _score(rotation, translation, x, y, weight, inlier_threshold)
    best = best_distinct(rotation, score, count)
    return rotation[best], translation[best]


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
    # Coordinates before matches, and in place: twenty times as fast.
    residual = (rotation @ x.mT).add_(translation.unsqueeze(-1)).sub_(y.mT)
    squared = residual.square_().sum(1)
    explained = squared.div_(-(inlier_threshold**2)).add_(1).clamp_min_(0).mul_(weight)
    return explained.sum(1), explained


def best_distinct(rotation: Tensor, score: Tensor, count: int) -> Tensor:
    """Select up to `count` indices by falling score, skipping rotations near a better one."""
    candidates, selected = score.argsort(descending=True), []
    while len(candidates) and len(selected) < count:
        best = candidates[0]
        selected.append(best)
        cosine = ((rotation[candidates] * rotation[best]).sum((1, 2)) - 1) / 2
        candidates = candidates[cosine < _SAME_ROTATION]
    return torch.stack(selected) if selected else score.new_empty(0, dtype=torch.int64)
