"""The folder in which what takes minutes to make is kept from one program to the next."""

from __future__ import annotations

import os
import sys
from pathlib import Path

CACHE_VARIABLE = "SB3_FOLLOW_OBJECT_CACHE"
SET_THE_VARIABLE = f"set {CACHE_VARIABLE} to a folder that can be written"


def cache_folder() -> Path:
    """Return the folder that predictors and recorded resets are kept in; it need not exist.

    Raises:
        ValueError: there is no home folder to find it in.
    """
    given = os.environ.get(CACHE_VARIABLE, "")
    try:
        if given.strip():
            return Path(given).expanduser()
        return _users_cache() / "sb3_follow_object"
    except RuntimeError as error:
        where = f"{CACHE_VARIABLE} is {given!r}, but " if given.strip() else ""
        raise ValueError(
            f"{where}there is no home folder to keep predictors in; {SET_THE_VARIABLE}"
        ) from error


def _users_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home())
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return given if given.is_absolute() else Path.home() / ".cache"  # as its specification says
