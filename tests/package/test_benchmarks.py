"""The scripts under benchmarks/ can be imported, and what they measure by name is there."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
from tree import ROOT

SCRIPTS = sorted((ROOT / "benchmarks").glob("*.py"))


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmark_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_script_can_be_imported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    assert load(path).__doc__


def test_parts_that_are_timed_exist() -> None:
    for _, owner, method in load(ROOT / "benchmarks" / "paper_scale.py").PARTS:
        assert callable(getattr(owner, method))
