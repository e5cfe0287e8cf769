"""The data sets by name. A new one is a module with a `load` function and a line here."""

from collections.abc import Callable
from pathlib import Path

from corrmat.data import folder, modelnet40
from corrmat.data.clouds import CloudSet
from corrmat.data.shapes import dataset
from corrmat.errors import CorrmatError

Loader = Callable[[str, int | None, Path | None], CloudSet]
"""(split "train" or "test", number of shapes or None for all, root folder) -> CloudSet."""

DATASETS: dict[str, Loader] = {
    "shapes": dataset.load,
    "assemblies": dataset.load_assemblies,
    "rooms": dataset.load_rooms,
    "modelnet40": modelnet40.load,
    "folder": folder.load,
}

_GENERATED = {"shapes", "assemblies", "rooms"}  # the others are read from a folder


def is_generated(name: str) -> bool:
    """Tell whether a data set, or several joined by "+", is made rather than read."""
    return set(name.split("+")) <= _GENERATED


def load_clouds(
    name: str, split: str, count: int | None = None, root: Path | None = None
) -> CloudSet:
    """Load a split of a data set, or of several joined by "+", e.g. "shapes+assemblies".

    Raises:
        CorrmatError: there is no such data set, or it cannot be read; their clouds differ in
            the number of points.
    """
    names = name.split("+")
    for each in names:
        if each not in DATASETS:
            raise CorrmatError(f"unknown data set {each!r}; data sets: {', '.join(DATASETS)}")
    if root is not None and is_generated(name):
        raise CorrmatError(f"{name} is made, not read from {root}: is folder or modelnet40 meant?")
    if len(names) == 1:
        return DATASETS[name](split, count, root)
    share = None if count is None else -(-count // len(names))
    joined = CloudSet.joined([DATASETS[each](split, share, root) for each in names])
    return joined.select(slice(count))
