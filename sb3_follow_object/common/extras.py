"""Packages that only some commands need, taken for usable only once they have been imported."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from .reports import reason


class MissingExtra(ValueError):
    """A package that comes with one of this package's extras is not installed, or is broken."""


def need(module: str, extra: str) -> Any:
    """Import a module that an extra brings.

    Raises:
        MissingExtra: it is not installed, and the message says what to install; or it is, and
            cannot be imported.
    """
    name = module.split(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise _broken(name, error) from error
        raise MissingExtra(
            f"{name.replace('_', '-')} is not installed: pip install 'sb3-follow-object[{extra}]'"
        ) from error
    except Exception as error:  # of libraries that do not fit together, of a setting, of a disk
        raise _broken(name, error) from error


def _broken(name: str, error: Exception) -> MissingExtra:
    return MissingExtra(f"{name.replace('_', '-')} cannot be imported: {reason(error)}")
