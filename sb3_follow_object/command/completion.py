"""What a shell asks of a command: its version, and completion of its words."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import shtab

_PACKAGE = "sb3-follow-object"


def add_shell_options(parser: argparse.ArgumentParser) -> None:
    """Add `--version` and `--print-completion SHELL`; paths complete to files and folders.

    Args:
        parser: has all its commands already.
    """
    parser.add_argument("--version", action="version", version=f"{_PACKAGE} {version(_PACKAGE)}")
    shtab.add_argument_to(parser, help="print what makes this shell complete the command's words")
    for action in _actions(parser):
        if action.type is Path:
            action.complete = shtab.FILE


def _actions(parser: argparse.ArgumentParser) -> Iterator[Any]:
    """All of a parser's arguments and of its commands'."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
