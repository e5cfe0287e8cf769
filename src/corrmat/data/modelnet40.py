"""ModelNet40 as sampled clouds, in the official HDF5 layout (Qi et al., PointNet)."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from corrmat.data import download
from corrmat.data.clouds import CloudSet, concatenate, read_hdf5
from corrmat.errors import CorrmatError

FOLDER = "modelnet40_ply_hdf5_2048"
SOURCE = "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip"


def fetch(root: Path, mirrors: Sequence[str] = (SOURCE,)) -> Path:
    """Download and unpack the data set, where it is not there yet.

    Args:
        root: folder that `FOLDER` goes into; a zip that lies there already is taken.
        mirrors: addresses of the zip.

    Returns:
        The data set's folder.

    Raises:
        CorrmatError: see `download.fetch` and `download.unzip`.
    """
    folder, archive = root / FOLDER, root / f"{FOLDER}.zip"
    if not folder.is_dir():
        if not archive.is_file():
            download.fetch(mirrors, archive)
        download.unzip(archive, root, FOLDER)
    for split in ("train", "test"):
        load(root, split)
    return folder


def load(root: Path, split: str) -> CloudSet:
    """Read a split.

    Args:
        root: the folder `modelnet40_ply_hdf5_2048`, or the one that holds it.
        split: "train" or "test", as the official file lists have it.

    Raises:
        CorrmatError: a folder, list or file is missing or damaged; the message names it.
    """
    folder = _folder(root)
    names = tuple(_lines(folder / "shape_names.txt"))
    # The official lists say "data/modelnet40_ply_hdf5_2048/<file>": only the name counts.
    files = [PurePosixPath(line).name for line in _lines(folder / f"{split}_files.txt")]
    for file in files:
        if not (folder / file).is_file():
            raise CorrmatError(
                f"{folder / file} is missing, but {split}_files.txt names it; fetch it again"
            )
    return concatenate([read_hdf5(folder / file, names) for file in files])


def _folder(root: Path) -> Path:
    for folder in (root, root / FOLDER):
        if (folder / "shape_names.txt").is_file():
            return folder
    raise CorrmatError(
        f"no ModelNet40 in {root} (looked for shape_names.txt and {FOLDER}/); "
        f"unpack {SOURCE} there, or use --data.data shapes"
    )


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        raise CorrmatError(f"{path} is missing; fetch the data set again")
    lines = [line.strip() for line in path.read_text().splitlines() if line.strip()]
    if not lines:
        raise CorrmatError(f"{path} is empty; fetch the data set again")
    return lines
