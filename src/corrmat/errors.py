"""The one error type that a user may see."""


class CorrmatError(Exception):
    """Something the user gave cannot be used; the message names it and says what to do."""
