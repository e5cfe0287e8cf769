"""Writing files so that a reader never sees half of one."""

from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Write beside the place, then move in."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes) -> None:
    """Write beside the place, then move in."""
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(content)
    partial.replace(path)
