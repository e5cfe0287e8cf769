"""The one error type that users see, and a check that networks share."""


class CorrmatError(Exception):
    """User input cannot be used. The message names the input and says what to do."""


def require_positive(**sizes: int) -> None:
    """Check the sizes that a network is built with.

    Raises:
        ValueError: a size is not positive; the message names it.
    """
    for name, size in sizes.items():
        if size < 1:
            raise ValueError(f"{name} {size} is not positive")
