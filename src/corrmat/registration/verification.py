"""What the verification network sees of a transform, and what it says of it."""

import numpy as np
import torch
from torch import Tensor

from corrmat.registration.hypotheses import Hypotheses

POINTS = 320  # of each cloud
_RADII = 0.05, 0.1, 0.2  # within which the probability of a point's matches is summed
_FAR_SQUARES = 4.5  # half squares of distance over the largest radius; beyond, all is as far


@torch.inference_mode()
def verify(
    transforms: np.ndarray, hypotheses: Hypotheses, subsamples: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Score transforms by the verification network of hypotheses.

    Args:
        transforms: (T, 4, 4).
        hypotheses: of a network that has one.
        subsamples: the clouds that they were made from.

    Returns:
        (T,) logits; see `VerificationNetwork`.
    """
    assert hypotheses.verification is not None
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
    source, target = (torch.from_numpy(c[:POINTS]).float() for c in subsamples)
    assert hypotheses.prob is not None
    assert hypotheses.unmatched_nll is not None
    assert hypotheses.features is not None
    n, m = len(source), len(target)
    prob = hypotheses.prob[:n, :m].float()
    rotation = torch.from_numpy(transforms[:, :3, :3]).float()
    translation = torch.from_numpy(transforms[:, :3, 3]).float()
    x = source[:, :3] @ rotation.mT + translation.unsqueeze(1)
    normals_x = source[:, 3:] @ rotation.mT
    y, normals_y = (part.expand(len(x), -1, -1) for part in target.split(3, 1))
    squares = torch.cdist(x, y).square_()

    near = (squares / (-2 * _RADII[-1] ** 2)).clamp_(min=-_FAR_SQUARES).exp_()
    ratios = [round((large / small) ** 2) for small, large in zip(_RADII, _RADII[1:], strict=False)]
    masses = []  # of the largest radius first
    for ratio in (1, *reversed(ratios)):
        near = near.pow(ratio)
        likely = near * prob
        # Of all matches, though only some of the other cloud's points are looked at.
        shares = hypotheses.prob.shape[1] / m, hypotheses.prob.shape[0] / n
        masses.append(torch.cat([shares[0] * likely.sum(2), shares[1] * likely.sum(1)], 1))

    to_target, to_source = squares.argmin(2), squares.argmin(1)
    best_x, best_y = prob.argmax(1), prob.argmax(0)
    residual = torch.cat([squares[:, range(n), best_x], squares[:, best_y, range(m)]], 1).sqrt()
    nearest = torch.cat([to_target + n, to_source], 1)
    points, normals = torch.cat([x, y], 1), torch.cat([normals_x, normals_y], 1)
    other, other_normals = (
        torch.take_along_dim(part, nearest.unsqueeze(2), 1) for part in (points, normals)
    )
    offset = points - other
    distance = offset.norm(dim=2)
    parallel = (normals * other_normals).sum(2).abs()
    off_planes = [(n * offset).sum(2).abs() / 0.05 for n in (normals, other_normals)]
    unmatched = [torch.from_numpy(nll[:POINTS]) for nll in hypotheses.unmatched_nll]
    matched = torch.cat([hypotheses.prob.sum(1)[:n], hypotheses.prob.sum(0)[:m]])
    which = torch.cat([x.new_zeros(n), x.new_ones(m)])
    columns = [
        *((-((distance / width) ** 2)).exp() for width in (0.03, 0.1)),
        2 * distance.clamp(max=0.5),
        parallel,
        *(off_plane.clamp(max=3) for off_plane in off_planes),
        parallel * (-((distance / 0.06) ** 2)).exp(),
        *((mass + 1e-3).log() / 3 for mass in masses),
        2 * residual.clamp(max=0.6),
        (residual < 0.1).float(),
        *(
            of_point.float().expand_as(distance)
            for of_point in (torch.cat(unmatched) / 4, matched, which)
        ),
    ]
    centred = points - points.mean(1, keepdim=True)
    features = torch.cat([part[:POINTS] for part in hypotheses.features])
    return features, torch.cat([torch.stack(columns, 2), centred], 2), nearest
