"""Tests of a policy on the other version of its task: when they are made, and how they fail."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_jobs import SETTINGS, FakeExecutor, comparison, do_it

from sb3_follow_object.command import cli
from sb3_follow_object.comparison import executors, figures
from sb3_follow_object.comparison.cross import CROSS_TESTS
from sb3_follow_object.comparison.executors import Message
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.comparison.ledger import read_grid
from sb3_follow_object.comparison.results import read_results, write_tables
from sb3_follow_object.comparison.worker import CROSS, Job
from sb3_follow_object.runs.run_folder import POLICY


def test_versions_of_pnp_simple_are_tested_on_each_other(tmp_path: Path) -> None:
    executor = FakeExecutor(do_it)
    cells = plan(tmp_path, ["PnPSimpleV1", "PnPSimpleV2", "PnPShelf"], ["her"], [0], SETTINGS)
    assert comparison(tmp_path, executor, cells)[0].run() == []
    crossed = {job.name: job.other for job in executor.jobs if job.kind == CROSS}
    assert crossed == {
        "PnPSimpleV1-her-0 on PnPSimpleV2": "FollowObject/PnPSimpleV2-v0",
        "PnPSimpleV2-her-0 on PnPSimpleV1": "FollowObject/PnPSimpleV1-v0",
    }
    short = {"PnPSimpleV2": {"success_rate": 1.0, "episodes": 4}}  # by a user, with `evaluate`
    (tmp_path / "PnPSimpleV1-her-0" / CROSS_TESTS).write_text(json.dumps(short))
    executor = FakeExecutor(do_it)
    assert comparison(tmp_path, executor, cells)[0].run() == []
    assert [job.name for job in executor.jobs] == ["PnPSimpleV1-her-0 on PnPSimpleV2"]


def test_cross_test_that_fails_twice_is_a_failure_until_it_is_asked_for_again(
    tmp_path: Path,
) -> None:
    failing = {"PnPSimpleV1-her-0 on PnPSimpleV2": 2, "PnPSimpleV2-her-0 on PnPSimpleV1": 1}

    def do(job: Job) -> list[Message]:
        if failing.get(job.name, 0) == 0:
            return do_it(job)
        failing[job.name] -= 1
        return [{"failed": "MemoryError"}]

    cells = plan(tmp_path, ["PnPSimpleV1", "PnPSimpleV2", "PnPShelf"], ["her"], [0], SETTINGS)
    executor = FakeExecutor(do)
    failed = comparison(tmp_path, executor, cells)[0].run()
    assert failed == ["PnPSimpleV1-her-0 on PnPSimpleV2"]
    assert len(executor.names(CROSS)) == 4
    grid = read_grid(tmp_path)
    assert grid is not None
    entries = {name: entry.get("cross") for name, entry in grid["cells"].items()}
    assert entries == {
        "PnPSimpleV1-her-0": {"failures": 2, "error": "MemoryError"},
        "PnPSimpleV2-her-0": None,
        "PnPShelf-her-0": None,
    }

    later = FakeExecutor(do)
    assert comparison(tmp_path, later, cells)[0].run() == failed
    assert later.jobs == [], "a cross test that was given up is left alone"
    retried = comparison(tmp_path, later, cells, retry_failed=True)[0]
    assert retried.run() == []
    assert later.names(CROSS) == failed


def test_cross_test_that_was_given_up_is_in_the_table_until_it_is_made(tmp_path: Path) -> None:
    def do(job: Job) -> list[Message]:
        return [{"failed": "MemoryError"}] if job.kind == CROSS else do_it(job)

    def table() -> str:
        write_tables(read_results(tmp_path), tmp_path)
        return (tmp_path / "table.md").read_text()

    cells = plan(tmp_path, ["PnPSimpleV1", "PnPShelf"], ["her"], [0], SETTINGS)
    comparison(tmp_path, FakeExecutor(do), cells)[0].run()
    line = "- PnPSimpleV1-her-0 on PnPSimpleV2 failed: MemoryError\n"
    assert line in table()
    by_evaluate = {"PnPSimpleV2": {"success_rate": 1.0, "episodes": 380}}
    (cells[0].folder / CROSS_TESTS).write_text(json.dumps(by_evaluate))
    assert line not in table()
    assert comparison(tmp_path, FakeExecutor(do), cells)[0].run() == []


def test_finished_run_without_a_policy_fails_its_cross_test(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def do(job: Job) -> list[Message]:
        told = do_it(job)
        (Path(job.folder) / POLICY).unlink(missing_ok=True)
        return told

    cells = plan(tmp_path, ["PnPSimpleV1"], ["her"], [0], SETTINGS)
    executor = FakeExecutor(do)
    failed = ["PnPSimpleV1-her-0 on PnPSimpleV2"]
    assert comparison(tmp_path, executor, cells)[0].run() == failed
    assert executor.names(CROSS) == []
    sentence = f"{failed[0]} failed: its run holds no policy.safetensors"
    assert sentence in capsys.readouterr().err
    write_tables(read_results(tmp_path), tmp_path)
    assert f"- {sentence}\n" in (tmp_path / "table.md").read_text()


def test_command_says_which_cross_test_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def do(job: Job) -> list[Message]:
        return [{"failed": "MemoryError"}] if job.kind == CROSS else do_it(job)

    monkeypatch.setattr(executors, "LocalExecutor", lambda jobs, logs: FakeExecutor(do))
    monkeypatch.setattr(figures, "draw_results", lambda *arguments: [])
    words = ["compare", "--out", str(tmp_path), "--tasks", "PnPSimpleV1", "PnPShelf"]
    assert cli.main([*words, "--methods", "her", "--seeds", "0", "--steps", "1000"]) == 2
    sentence = "1 of 2 runs failed: PnPSimpleV1-her-0 on PnPSimpleV2"
    assert sentence in capsys.readouterr().err
