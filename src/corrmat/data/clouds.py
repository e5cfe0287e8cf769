"""A set of clean clouds, in memory or in shards on disk."""

import io
import json
import logging
import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import platformdirs

from corrmat.errors import CorrmatError
from corrmat.files import replace_bytes, replace_text

log = logging.getLogger("corrmat")
_INDEX = "index.json"  # written last: a folder without it is not complete


class ShardedRows:
    """Rows (S, P, 6) in .npy shards, of which only the requested ones are read.

    Reading a shape is one read of some 50 KB. The operating system caches the files, so that
    memory of the process does not grow with the data set, and any number of DataLoader workers
    share one copy.
    """

    def __init__(self, files: Sequence[Path], index: np.ndarray | None = None) -> None:
        headers = [np.load(file, mmap_mode="r") for file in files]
        self._files, self._offsets = tuple(files), [header.offset for header in headers]
        self._starts = np.cumsum([0, *(len(header) for header in headers)])
        self._row_shape = headers[0].shape[1:]
        self._index = np.arange(self._starts[-1]) if index is None else index

    @property
    def shape(self) -> tuple[int, ...]:
        """(S, P, 6), as an array's."""
        return len(self._index), *self._row_shape

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, key: np.ndarray | slice | Sequence[int] | int) -> np.ndarray:
        chosen = self._index[key]
        if np.ndim(chosen) == 0:
            return self._read(int(chosen))
        return np.stack([self._read(int(i)) for i in chosen])

    def select(self, key: np.ndarray | slice) -> "ShardedRows":
        """Return a subset without reading it."""
        subset = object.__new__(ShardedRows)
        subset.__dict__ |= self.__dict__
        subset._index = self._index[key]
        return subset

    @classmethod
    def joined(cls, parts: Sequence["ShardedRows"]) -> "ShardedRows":
        """Join sets one after the other, without reading them."""
        firsts = np.cumsum([0, *(part._starts[-1] for part in parts)])
        index = [part._index + first for part, first in zip(parts, firsts, strict=False)]
        return cls([file for part in parts for file in part._files], np.concatenate(index))

    def _read(self, position: int) -> np.ndarray:
        """Read the row at a position of the whole set, (P, 6)."""
        shard = int(np.searchsorted(self._starts, position, "right")) - 1
        size = int(np.prod(self._row_shape))
        skip = self._offsets[shard] + 4 * size * (position - int(self._starts[shard]))
        values = np.fromfile(self._files[shard], np.float32, size, offset=skip)
        return values.reshape(self._row_shape)


@dataclass(frozen=True)
class CloudSet:
    """S clean clouds of P points each, centred, inside the unit sphere; read-only."""

    rows: np.ndarray | ShardedRows  # (S, P, 6) float32: xyz and unit normal of every point
    labels: np.ndarray  # (S,) int64, index into names
    names: tuple[str, ...]  # categories

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def num_points(self) -> int:
        """P."""
        return self.rows.shape[1]

    def select(self, key: np.ndarray | slice) -> "CloudSet":
        """Return the shapes at these positions."""
        rows = self.rows
        rows = rows.select(key) if isinstance(rows, ShardedRows) else rows[key]
        return CloudSet(rows, self.labels[key], self.names)

    @classmethod
    def joined(cls, sets: Sequence["CloudSet"]) -> "CloudSet":
        """Join sets one after the other.

        Raises:
            CorrmatError: their clouds differ in the number of points.
        """
        sizes = {clouds.num_points for clouds in sets}
        if len(sizes) > 1:
            raise CorrmatError(f"data sets with clouds of {sorted(sizes)} points cannot be joined")
        rows = [clouds.rows for clouds in sets]
        sharded = [part for part in rows if isinstance(part, ShardedRows)]
        firsts = np.cumsum([0, *(len(clouds.names) for clouds in sets)])
        labels = [clouds.labels + first for clouds, first in zip(sets, firsts, strict=False)]
        return cls(
            ShardedRows.joined(sharded)
            if len(sharded) == len(rows)
            else np.concatenate([part[:] for part in rows]),
            np.concatenate(labels),
            tuple(name for clouds in sets for name in clouds.names),
        )

    def only(self, categories: Sequence[str]) -> "CloudSet":
        """Return the shapes of these categories.

        Raises:
            CorrmatError: a category is unknown, or no shape is left.
        """
        for name in categories:
            if name not in self.names:
                raise CorrmatError(
                    f"unknown category {name!r}; categories: {', '.join(self.names)}"
                )
        wanted = [self.names.index(name) for name in categories]
        selected = self.select(np.flatnonzero(np.isin(self.labels, wanted)))
        if not len(selected):
            raise CorrmatError(f"no shape of {', '.join(categories)} in this data set")
        return selected

    def checksum(self) -> str:
        """Compute a CRC of labels and of up to 256 shapes: which data a network was trained on."""
        sample = np.linspace(0, len(self) - 1, min(256, len(self))).round().astype(int)
        crc = zlib.crc32(np.ascontiguousarray(self.labels).data)
        return f"{zlib.crc32(np.ascontiguousarray(self.rows[sample]).data, crc):08x}"


def cache_folder() -> Path:
    """Return `$CORRMAT_CACHE`, or the user's cache folder."""
    return Path(os.environ.get("CORRMAT_CACHE") or platformdirs.user_cache_dir("corrmat"))


def write_shard(
    folder: Path, number: int, rows: np.ndarray, labels: np.ndarray, skipped: Sequence[str] = ()
) -> None:
    """Write one shard, so that it is there whole or not at all.

    Args:
        folder: of the data set's split.
        number: of the shard.
        rows: (n, P, 6) float32; n may be 0.
        labels: (n,).
        skipped: what could not be read, a line each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = _shard(folder, number)
    content = io.BytesIO()
    np.save(content, np.ascontiguousarray(rows, np.float32))
    replace_bytes(path, content.getbuffer())
    about = {"labels": labels.tolist(), "crc32": _crc(path), "skipped": list(skipped)}
    replace_text(path.with_suffix(".json"), json.dumps(about))


def missing_shards(folder: Path, count: int) -> list[int]:
    """List the shards, of `count`, that are not there yet."""
    return [n for n in range(count) if not _shard(folder, n).with_suffix(".json").is_file()]


def finish_shards(folder: Path, names: Sequence[str], count: int) -> None:
    """Mark a folder of `count` shards as complete."""
    abouts = [json.loads(_shard(folder, n).with_suffix(".json").read_text()) for n in range(count)]
    replace_text(folder / _INDEX, json.dumps({"names": list(names), "shards": abouts}))


def open_shards(folder: Path) -> CloudSet | None:
    """Open a complete folder of shards; None if it is incomplete or damaged.

    A damaged shard is deleted, so that only this one has to be made again.

    Raises:
        CorrmatError: it is complete, but every shape was skipped.
    """
    if not (folder / _INDEX).is_file():
        return None
    try:
        index = json.loads((folder / _INDEX).read_text())
    except ValueError:  # cut short: it is made again from the shards
        (folder / _INDEX).unlink()
        return None
    damaged = [
        n for n, about in enumerate(index["shards"]) if _crc(_shard(folder, n)) != about["crc32"]
    ]
    if damaged:
        log.warning("%s: %d damaged shards are made again", folder, len(damaged))
        (folder / _INDEX).unlink()
        for number in damaged:
            _shard(folder, number).with_suffix(".json").unlink(missing_ok=True)
        return None
    filled = [n for n, about in enumerate(index["shards"]) if about["labels"]]
    labels = [label for about in index["shards"] for label in about["labels"]]
    if not filled:
        first = next(skipped_shapes(folder), "there is none")
        raise CorrmatError(f"no shape could be read; the first: {first}")
    rows = ShardedRows([_shard(folder, n) for n in filled])
    return CloudSet(rows, np.array(labels, np.int64), tuple(index["names"]))


def skipped_shapes(folder: Path) -> Iterator[str]:
    """Yield a line for every shape that could not be read when the shards were made."""
    for about in json.loads((folder / _INDEX).read_text())["shards"]:
        yield from about["skipped"]


def _shard(folder: Path, number: int) -> Path:
    return folder / f"shard-{number:05d}.npy"


def _crc(path: Path) -> int | None:
    """Compute the CRC-32 of a file in slices; None if it is missing."""
    if not path.is_file():
        return None
    crc = 0
    with path.open("rb") as file:
        while content := file.read(2**22):
            crc = zlib.crc32(content, crc)
    return crc
