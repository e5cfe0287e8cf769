"""Anybody's shapes: a folder of meshes or clouds, sampled once into shards.

Three layouts are understood. In ModelNet40's, a folder `train` or `test` decides the split
(`chair/train/chair_0001.off`). In ShapeNet's (`03001627/<id>/models/model.obj`) and in a folder of
files, with or without a folder a category, a hash of the path puts about one shape in five into the
test split, and at least one.
"""

import hashlib
import logging
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from corrmat.data.build import build_shards
from corrmat.data.clouds import CloudSet, cache_folder, open_shards, skipped_shapes
from corrmat.data.normals import estimate_normals
from corrmat.data.scans import MESHES, read_shape
from corrmat.errors import CorrmatError

log = logging.getLogger("corrmat")
SUFFIXES = (*MESHES, ".pcd", ".xyz", ".npy", ".npz")
POINTS = 2048
TEST_SHARE = 0.2
_SHOWN = 5  # skipped files named in the log


class ShapeFile(NamedTuple):
    """A file of the folder and what its path says."""

    path: str
    relative: str
    label: int


def load(split: str, count: int | None = None, root: Path | None = None) -> CloudSet:
    """Load a split; every shape is sampled once, on all cores, into the cache folder.

    An interrupted call continues with the next shard. Files that cannot be read are skipped,
    counted and listed.

    Args:
        split: "train" or "test".
        count: number of shapes; None for all.
        root: the folder.

    Raises:
        CorrmatError: the folder is missing, or holds no shape of this split.
    """
    if root is None:
        raise CorrmatError(
            "data set folder needs its folder: ROOT=..., --data.root ... or --root ..."
        )
    if not root.is_dir():
        raise CorrmatError(f"no folder {root}")
    names, splits = find_shapes(root)
    files = splits[split]
    if not files:
        raise CorrmatError(
            f"{root} holds {'one shape' if any(splits.values()) else 'no shape'}, and none for the "
            f"{split} split; shapes are {', '.join(SUFFIXES)} files, in any of the layouts of "
            "README.md (Data)"
        )
    identity = [
        (f.relative, Path(f.path).stat().st_size, Path(f.path).stat().st_mtime_ns) for f in files
    ]
    content = os.fsencode(repr((root.resolve().as_posix(), identity)))
    digest = hashlib.sha256(content).hexdigest()[:12]
    shards = cache_folder() / f"folder-{root.name}-{digest}-{split}"
    clouds = open_shards(shards)
    if clouds is None:
        if splits["neither"]:
            left_out, first = len(splits["neither"]), splits["neither"][0].relative
            log.warning("%d files lie in no folder train or test, as %s: left out", left_out, first)
        build_shards(
            shards, names, files, sample_shape, f"sampling {len(files)} {split} shapes (once)"
        )
        skipped = list(skipped_shapes(shards))
        if 0 < len(skipped) < len(files):
            shown = "\n  ".join([*skipped[:_SHOWN], *(["..."] if len(skipped) > _SHOWN else [])])
            log.warning("%d of %d files were skipped:\n  %s", len(skipped), len(files), shown)
        clouds = open_shards(shards)
    assert clouds is not None
    return clouds.select(slice(count))


def find_shapes(root: Path) -> tuple[tuple[str, ...], dict[str, list[ShapeFile]]]:
    """Find the categories of a folder and the files of both splits, in the order of their paths.

    Returns:
        Names of the categories; files of "train", "test" and "neither".
    """
    paths = sorted(p for p in root.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    relative = [path.relative_to(root) for path in paths]
    # Both must be there: a folder "train" alone is a category, of trains.
    by_folder = {"train", "test"} <= {_split_folder(path) for path in relative}
    categories = [
        path.parts[0] if len(path.parts) > 1 else root.resolve().name for path in relative
    ]
    if by_folder:  # `train/chair.off` has no category
        categories = [root.resolve().name if c in ("train", "test") else c for c in categories]
    names = tuple(sorted(set(categories)))
    chosen = [_split_folder(path) for path in relative] if by_folder else _split_by_hash(relative)
    splits: dict[str, list[ShapeFile]] = {"train": [], "test": [], "neither": []}
    for path, rel, category, split in zip(paths, relative, categories, chosen, strict=True):
        splits[split].append(ShapeFile(str(path), rel.as_posix(), names.index(category)))
    return names, splits


def sample_shape(file: ShapeFile) -> tuple[np.ndarray, int] | str:
    """Sample a file: (2048, 6) float32 points with normals and the label, or why there is none.

    Points are uniform on a mesh's surface, or a random subset of a cloud with estimated normals.
    They are centred at their mean and scaled into the unit sphere. The sample depends on the
    file's path in the folder alone.
    """
    rng = np.random.default_rng(list(hashlib.sha256(os.fsencode(file.relative)).digest()))
    path = Path(file.path)
    try:
        shape = read_shape(path)
    except CorrmatError as error:
        return str(error)
    if isinstance(shape, trimesh.Trimesh):
        points, faces = trimesh.sample.sample_surface(shape, POINTS, seed=rng)[:2]
        normals = shape.face_normals[faces]
    else:
        if len(shape) < POINTS:
            return f"{file.relative}: {len(shape)} points, {POINTS} are needed"
        points, normals = shape[rng.choice(len(shape), POINTS, replace=False)], None
    points = points - points.mean(0)
    radius = np.linalg.norm(points, axis=1).max()
    if not np.isfinite(radius) or radius == 0:
        return f"{file.relative}: points are not finite, or all equal"
    points = points / radius
    rows = np.hstack([points, estimate_normals(points) if normals is None else normals])
    return rows.astype(np.float32), file.label


def _split_folder(relative: Path) -> str:
    """Return "train" or "test" if a folder of this name holds the file, else "neither"."""
    folders = (part for part in relative.parts[:-1] if part in ("train", "test"))
    return next(folders, "neither")


def _split_by_hash(relative: list[Path]) -> list[str]:
    """Choose "train" or "test" for each path; of two or more, each gets at least one."""
    digests = [hashlib.sha256(os.fsencode(path.as_posix())).digest()[:4] for path in relative]
    shares = [int.from_bytes(digest, "big") / 2**32 for digest in digests]
    border = max(TEST_SHARE, min(shares, default=0.0))
    return ["test" if share <= border and share < max(shares) else "train" for share in shares]
