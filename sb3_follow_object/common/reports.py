"""What runs say while they go on."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[str], None]


class Trouble(str):
    """A sentence about what went wrong, which `--quiet` does not silence."""

    __slots__ = ()
