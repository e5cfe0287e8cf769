"""What the verification network sees of a transform, and what it says of it."""

import numpy as np
import torch
from torch import Tensor

from corrmat.registration.hypotheses import Hypotheses

POINTS = 320  # of each cloud
# All lengths are in units in which a cloud's radius is about one.
_NEAR = 0.03, 0.1  # scales of how near the nearest point is
_TOUCHING = 0.06  # the same for points that must be parallel, too
_OFF_PLANE = 0.05  # unit of distances along a normal
_RADII = 0.2, 0.1, 0.05  # within which the probability of a point's matches is summed
_FAR_SQUARES = 4.5  # half squares of distance over the largest radius; beyond, all is as far
_EXPLAINED = 0.1  # residual of a match that a transform explains


@torch.inference_mode()
def verify(
    transforms: np.ndarray, hypotheses: Hypotheses, subsamples: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Score transforms by the verification network of hypotheses.

    Args:
        transforms: (T, 4, 4).
        hypotheses: of the model.
        subsamples: the clouds that they were made from.

    Returns:
        (T,) logits, see `VerificationNetwork`; zeros if the model has no such network.
    """
    if hypotheses.verification is None:
        return np.zeros(len(transforms))
    return hypotheses.verification(*evidence(transforms, hypotheses, subsamples)).double().numpy()


def evidence(
    transforms: np.ndarray, hypotheses: Hypotheses, subsamples: tuple[np.ndarray, np.ndarray]
) -> tuple[Tensor, Tensor, Tensor]:
    """Collect what speaks for and against transforms, point by point.

    Args: see `verify`; the first `POINTS` of each subsample are looked at, P of both together.

    Returns:
        The points' features (P, d), those of the source first. Evidence (T, P, EVIDENCE): how near
        the nearest point of the other cloud is, at several scales, and how parallel the normals
        are; the probability of the point's matches within three radii; how far its best match is;
        that it has no match, and that it has one; which cloud it is of; its position. And the
        index (T, P) of the nearest point.
    """
    assert hypotheses.prob is not None
    assert hypotheses.unmatched_nll is not None
    assert hypotheses.features is not None
    source, target = (torch.from_numpy(cloud[:POINTS]).float() for cloud in subsamples)
    n, m = len(source), len(target)
    rotation = torch.from_numpy(transforms[:, :3, :3]).float()
    translation = torch.from_numpy(transforms[:, :3, 3]).float()
    x = source[:, :3] @ rotation.mT + translation.unsqueeze(1)
    normals_x = source[:, 3:] @ rotation.mT
    y, normals_y = (part.expand(len(x), -1, -1) for part in target.split(3, 1))
    squares = torch.cdist(x, y).square_()

    nearest = torch.cat([squares.argmin(2) + n, squares.argmin(1)], 1)
    points, normals = torch.cat([x, y], 1), torch.cat([normals_x, normals_y], 1)
    other, other_normals = (
        torch.take_along_dim(part, nearest.unsqueeze(2), 1) for part in (points, normals)
    )
    offset = points - other
    distance = offset.norm(dim=2)
    parallel = (normals * other_normals).sum(2).abs()
    off_planes = [(each * offset).sum(2).abs() / _OFF_PLANE for each in (normals, other_normals)]

    prob = hypotheses.prob[:n, :m].float()
    best_x, best_y = prob.argmax(1), prob.argmax(0)
    residual = torch.cat([squares[:, range(n), best_x], squares[:, best_y, range(m)]], 1).sqrt()
    masses = _match_probabilities(squares, hypotheses.prob)
    unmatched = torch.cat([torch.from_numpy(nll[:POINTS]) for nll in hypotheses.unmatched_nll])
    matched = torch.cat([hypotheses.prob.sum(1)[:n], hypotheses.prob.sum(0)[:m]])
    is_target = torch.cat([x.new_zeros(n), x.new_ones(m)])
    of_points = (each.float().expand_as(distance) for each in (unmatched / 4, matched, is_target))
    columns = [
        *((-((distance / scale) ** 2)).exp() for scale in _NEAR),
        2 * distance.clamp(max=0.5),
        parallel,
        *(off_plane.clamp(max=3) for off_plane in off_planes),
        parallel * (-((distance / _TOUCHING) ** 2)).exp(),
        *((mass + 1e-3).log() / 3 for mass in masses),
        2 * residual.clamp(max=0.6),
        (residual < _EXPLAINED).float(),
        *of_points,
    ]
    centred = points - points.mean(1, keepdim=True)
    features = torch.cat([part[:POINTS] for part in hypotheses.features])
    return features, torch.cat([torch.stack(columns, 2), centred], 2), nearest


def _match_probabilities(squares: Tensor, prob: Tensor) -> list[Tensor]:
    """Sum the probabilities of the matches near each point, for each of `_RADII`.

    Args:
        squares: (T, n, m) squared distances of the points that are looked at.
        prob: (N, M) of all points' matches.

    Returns:
        (T, n + m) each, scaled from the points that are looked at to all.
    """
    _, n, m = squares.shape
    near = (squares / (-2 * _RADII[0] ** 2)).clamp_(min=-_FAR_SQUARES).exp_()
    masses = []
    for larger, radius in zip(_RADII[:1] + _RADII, _RADII, strict=False):
        near = near.pow(round((larger / radius) ** 2))
        likely = near * prob[:n, :m].float()
        shares = prob.shape[1] / m, prob.shape[0] / n
        masses.append(torch.cat([shares[0] * likely.sum(2), shares[1] * likely.sum(1)], 1))
    return masses
