"""Standard output and error as they are found: closed, gone, or unable to spell what is said."""

from __future__ import annotations

import os
import sys
from contextlib import suppress


def open_streams() -> None:
    """Let everything be printed: what is closed swallows it, and letters it lacks are escaped."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # else the first file that is opened would get its number, and its lines
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 for good
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def leave_streams() -> None:
    """Print what is left; where nobody reads it, drop it, or Python ends with a status of its own.

    Call it last.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream.fileno())
                os.close(nowhere)
