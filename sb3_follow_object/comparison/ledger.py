"""The grid file: what a folder of results was compared with, and which of its runs failed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..common.files import atomic_write
from ..runs.run_folder import difference
from .cells import Cell, Settings

GRID = "grid.json"
ATTEMPTS = 2  # a run or a cross test that failed is taken up again once
_FORMAT = 1
# What reading a damaged grid file raises.
_DAMAGE = (OSError, AttributeError, KeyError, OverflowError, RecursionError, TypeError, ValueError)


class Ledger:
    """The grid file: the settings, the cells that were ever asked for, and their failures.

    A cell's entry says under "cross" how its cross test failed, where it did.

    Args:
        folder: of the results; is created.
        settings: of all runs, which `plan` has checked.
        cells: the runs that are wanted now; those of the file stay.
        retry_failed: forget earlier failures of these cells.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        cells: Iterable[Cell],
        retry_failed: bool = False,
    ):
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / GRID
        self._content = read_grid(folder) or {"format": _FORMAT, **_plain(settings), "cells": {}}
        self.cells: dict[str, dict[str, Any]] = self._content["cells"]
        for cell in cells:
            row = {"task": cell.task, "method": cell.method, "seed": cell.seed}
            entry = self.cells.setdefault(cell.name, {**row, "failures": 0, "error": None})
            if retry_failed:
                entry |= {"failures": 0, "error": None}
                entry.pop("cross", None)
        self._write()

    def failed(self, name: str, cross: bool = False) -> bool:
        """Whether a cell, or its cross test, has used up its attempts."""
        return given_up(self.cells[name], cross)

    def note_failure(self, name: str, error: str, final: bool = False, cross: bool = False) -> None:
        """Count a failure of a cell, or of its cross test; a final one uses up its attempts."""
        entry = self.cells[name]
        if cross:
            entry = entry.setdefault("cross", {"failures": 0, "error": None})
        entry["failures"] = ATTEMPTS if final else entry["failures"] + 1
        entry["error"] = error
        self._write()

    def note_success(self, name: str, cross: bool = False) -> None:
        """Forget the failure of a cell, or of its cross test: the second attempt came through."""
        entry = self.cells[name]
        if cross and "cross" in entry:
            del entry["cross"]
            self._write()
        elif not cross and entry["failures"]:
            entry |= {"failures": 0, "error": None}
            self._write()

    def _write(self) -> None:
        atomic_write(self._path, json.dumps(self._content, indent=1).encode())


def given_up(entry: Mapping[str, Any], cross: bool = False) -> bool:
    """Whether a cell has used up its attempts by its entry in the grid file, or its cross test."""
    counted = entry.get("cross", {}) if cross else entry
    return bool(counted.get("failures", 0) >= ATTEMPTS)


def read_grid(folder: Path) -> dict[str, Any] | None:
    """Return the grid file's content, None where the folder has no such file.

    Raises:
        ValueError: the file is damaged.
    """
    path = folder / GRID
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_text("utf-8"))
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is {content['format']!r}, not {_FORMAT}")
        content["cells"] = {name: _entry(cell) for name, cell in content["cells"].items()}
    except _DAMAGE as error:
        raise ValueError(f"{path} is not the file of a comparison's grid ({error})") from error
    return dict(content)


def _entry(cell: Mapping[str, Any]) -> dict[str, Any]:
    """Return a cell's entry with each number as a number, however the file has it."""
    named = {"task": str(cell["task"]), "method": str(cell["method"]), "seed": int(cell["seed"])}
    crossed = {"cross": _failures(cell["cross"])} if "cross" in cell else {}
    return {**named, **_failures(cell), **crossed}


def _failures(counted: Mapping[str, Any]) -> dict[str, Any]:
    return {"failures": int(counted["failures"]), "error": counted["error"]}


def check_settings(folder: Path, settings: Settings) -> None:
    """Raise a ValueError where a folder's runs were compared with other settings."""
    kept = read_grid(folder)
    if kept is None:
        return
    wanted = _plain(settings)
    different = difference({n: _told(kept.get(n)) for n in wanted}, _told(wanted))
    if different is not None:
        name, old, new = different
        raise ValueError(
            f"{folder} was compared with {name} {old!r}, not {new!r}; use the same settings or "
            "another folder"
        )


def _told(value: Any) -> Any:
    """Return settings that tell null from what is not set."""
    if isinstance(value, dict):
        return {name: _told(inner) for name, inner in value.items()}
    return "null" if value is None else value


def _plain(settings: Settings) -> dict[str, Any]:
    return {
        "steps": settings.steps,
        "preset": settings.preset,
        "set": dict(settings.overrides or {}),
        "paper_evaluation": settings.paper_evaluation,
    }
