"""What runs say while they go on."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[str], None]


def reason(error: BaseException) -> str:
    """Return what an error says, in one line."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror if error.filename is None else f"{error.strerror}: {error.filename}"
    return " ".join(text.split()) or type(error).__name__


def named_reason(error: BaseException) -> str:
    """Return an error's kind and what it says, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class Trouble(str):
    """A sentence about what went wrong, which `--quiet` does not silence."""

    __slots__ = ()
