"""The scripts under benchmarks/ can be imported, and what they measure by name is there."""

from __future__ import annotations

import importlib.util
import json
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


ROW = {"task": "PnPShelf", "seed": 0, "env_steps": 1000, "wall_s": 60.0, "success_rate": 0.5}


def test_tables_can_be_made_of_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rivals before FO, and runs of a wheel, which knows no commit."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    collect = load(ROOT / "benchmarks" / "collect.py")
    rows = [
        {**ROW, "method": method, "commit": None, "validations": []} for method in ("her", "rher")
    ]
    assert "| PnPShelf | not run | not run | 0.50 | 0.50 |" in collect.reaching_table(rows)
    others = collect.robots_table([{**row, "task": "Another-v0"} for row in rows])
    assert others.count("| Another-v0 |") == 2


def test_a_copy_that_was_broken_off_is_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    collect = load(ROOT / "benchmarks" / "collect.py")
    monkeypatch.setattr(collect, "RESULTS", tmp_path)
    monkeypatch.setattr(collect, "OF_OTHERS", tmp_path / "none")
    for name in ("PnPShelf-fo-0", ".PnPShelf-fo-0.new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "versions.json").write_text('{"commit": "abc"}')
        (tmp_path / name / "result.json").write_text(json.dumps({**ROW, "method": "fo"}))
    assert len(collect.read_rows()) == 1
