"""Progress bars on standard error, so that standard output holds results alone."""

from collections.abc import Iterable
from typing import TypeVar

from rich import progress
from rich.console import Console

T = TypeVar("T")


def track(
    items: Iterable[T], title: str, total: int | None = None, *, transient: bool = True
) -> Iterable[T]:
    """Show a bar while items are gone through.

    Args:
        items: any.
        title: before the bar.
        total: how many items; None if their length says it.
        transient: whether the bar vanishes at its end. Such a bar is not written to a file.
    """
    console = Console(stderr=True)
    return progress.track(
        items, title, total, console=console, transient=transient,
        disable=transient and not console.is_terminal,
    )  # fmt: skip
