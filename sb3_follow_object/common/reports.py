"""What runs say while they go on."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[str], None]


def reason(error: BaseException) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


class Trouble(str):
    """A sentence about what went wrong, which `--quiet` does not silence."""

    __slots__ = ()
