"""How far registrations are from known poses, and what their verdicts are."""

from collections import Counter
from collections.abc import Iterable
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from corrmat.calibration import Verdict, verdict_words
from corrmat.ops import rigid
from corrmat.registration.result import Registration


def pose_error(transform: np.ndarray, truth: np.ndarray, source: np.ndarray) -> tuple[float, float]:
    """Compute how far a transform is from the truth, both (4, 4).

    Returns:
        The rotation error in degrees, and the mean distance of the source's points (N, 3) from
        their true places.
    """
    off = Rotation.from_matrix((transform @ np.linalg.inv(truth))[:3, :3])
    shifts = rigid.move(transform, source) - rigid.move(truth, source)
    return float(np.degrees(off.magnitude())), float(np.linalg.norm(shifts, axis=1).mean())


def count_verdicts(registrations: Iterable[Registration]) -> list[int]:
    """Count the registrations of each `Verdict`, in its order."""
    verdicts = Counter(verdict_words(each.confidence) for each in registrations)
    return [verdicts[verdict] for verdict in get_args(Verdict)]
