"""Atomic writes, so that a reader never sees half a file; and locks of folders."""

import json
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from corrmat.errors import CorrmatError

if TYPE_CHECKING:
    from filelock import FileLock


def replace_text(path: Path, text: str) -> None:
    """Write text to a temporary file beside `path`, then rename it into place."""
    replace_bytes(path, text.encode())


def replace_json(path: Path, content: object) -> None:
    """Write indented JSON to a temporary file beside `path`, then rename it into place."""
    replace_text(path, json.dumps(content, indent=1) + "\n")


def update_json(path: Path, key: str, value: object) -> None:
    """Set one key of the JSON object in a file, which need not be there yet."""
    content = json.loads(path.read_text()) if path.is_file() else {}
    replace_json(path, content | {key: value})


def replace_bytes(path: Path, content: bytes | memoryview) -> None:
    """Write bytes to a temporary file beside `path`, then rename it into place.

    A link stays one: what it points to is replaced. A pipe or device is written to.

    Raises:
        OSError: the file cannot be written; the temporary file is removed.
    """
    if path.exists() and not path.is_file():
        path.write_bytes(content)
        return
    path = path.resolve()
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def folder_lock(folder: Path) -> "FileLock":
    """Return the lock that processes take before they write to a folder; it lies beside it."""
    from filelock import FileLock  # slow, and `register` needs none

    folder.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(folder.with_name(f".{folder.name}.lock"))


def refuse_existing(paths: Iterable[Path]) -> None:
    """Refuse to overwrite files that somebody else may have written.

    Raises:
        CorrmatError: one of them exists.
    """
    for path in paths:
        if path.exists():
            raise CorrmatError(f"{path} is there already; delete it or choose another folder")


def ensure_writable(folder: Path) -> None:
    """Check that files can be written to a folder, which need not exist yet.

    A long run calls this first, so that it does not fail at its end. Nothing is left behind.

    Raises:
        CorrmatError: the folder cannot be written.
    """
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    try:
        with tempfile.NamedTemporaryFile(dir=existing) as file:
            file.write(b"corrmat")
    except OSError as error:
        raise CorrmatError(f"cannot write to {folder}: {error.strerror}") from error
