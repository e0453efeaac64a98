"""Packages that only some commands need."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class MissingExtra(ValueError):
    """A package is not installed that comes with one of this package's extras."""


def need(module: str, extra: str) -> Any:
    """Import a module that an extra brings.

    Raises:
        MissingExtra: it is not installed; the message says what to install.
    """
    try:
        return import_module(module)
    except ImportError as error:
        name = module.split(".")[0].replace("_", "-")
        raise MissingExtra(
            f"{name} is not installed: pip install 'sb3-follow-object[{extra}]'"
        ) from error
