"""The one error type that users see, and the checks that settings and networks share."""

import dataclasses
import errno
import re
import textwrap
import typing
from collections.abc import Collection


class CorrmatError(Exception):
    """User input cannot be used. The message names the input and says what to do."""


class DivergedError(CorrmatError):
    """A training loss is not finite."""


_WHILE_WRITING = {
    errno.EACCES, errno.EDQUOT, errno.EEXIST, errno.EFBIG, errno.EIO, errno.EISDIR,
    errno.ENAMETOOLONG, errno.ENOSPC, errno.ENOTDIR, errno.EPERM, errno.EROFS,
}  # fmt: skip


def cannot_write(error: OSError) -> bool:
    """Tell whether an error is of a file that cannot be written: a full disk, a folder's rights.

    Others, such as of a missing file, may be of a network of the user's own.
    """
    return error.errno in _WHILE_WRITING


def short_message(error: Exception) -> str:
    """Return the first two lines of an error of a library as one line, types in plain words."""
    lines = [line.strip(" -") for line in str(error).splitlines() if line.strip(" -")]
    text = re.sub(r'Parser key "(.*?)": Expected a', r"\1: expected", " ".join(lines[:2]))
    text = re.sub(r"<class '(\w+)'>", r"\1", text)
    text = re.sub(r"typing\.Literal\[([^]]*)\]", r"one of \1", text)
    return textwrap.shorten(text, 400, placeholder=" ...") or type(error).__name__


def require_positive(**sizes: int) -> None:
    """Check the sizes that a network is built with.

    Raises:
        CorrmatError: a size is not positive; the message names it.
    """
    for name, size in sizes.items():
        if size < 1:
            raise CorrmatError(f"{name} {size} is not positive")


def require_choice(name: str, value: object, choices: Collection[object]) -> None:
    """Check a value against its choices.

    Raises:
        CorrmatError: it is none of them; the message names them.
    """
    if value not in choices:
        raise CorrmatError(f"{name} = {value!r}; choices: {', '.join(map(str, choices))}")


def check_choices(settings: object) -> None:
    """Check the fields of a dataclass whose type is a Literal, which Python itself does not.

    Raises:
        CorrmatError: a value is none of its choices.
    """
    hints = typing.get_type_hints(type(settings))
    for field in dataclasses.fields(settings):  # pyright: ignore[reportArgumentType]
        if typing.get_origin(hints[field.name]) is typing.Literal:
            choices = typing.get_args(hints[field.name])
            require_choice(field.name, getattr(settings, field.name), choices)
