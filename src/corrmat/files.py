"""Writing files so that a reader never sees half of one."""

import tempfile
from pathlib import Path

from corrmat.errors import CorrmatError


def replace_text(path: Path, text: str) -> None:
    """Write beside the place, then move in."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes | memoryview) -> None:
    """Write beside the place, then move in; what could not be written whole is removed."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def ensure_writable(folder: Path) -> None:
    """Find out now, not after an hour of training, whether files can be written to a folder.

    It need not be there yet, and nothing is left behind.

    Raises:
        CorrmatError: they cannot.
    """
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    try:
        with tempfile.NamedTemporaryFile(dir=there) as file:
            file.write(b"corrmat")
    except OSError as error:
        raise CorrmatError(f"cannot write to {folder}: {error.strerror}") from error
