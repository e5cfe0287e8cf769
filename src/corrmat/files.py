"""Writing files so that a reader never sees half of one."""

from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Write beside the place, then move in."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    partial.replace(path)
