"""The driver of a comparison: order, resuming and failures."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from fake_jobs import SETTINGS, FakeExecutor, comparison, do_it, small_plan
from result_folders import finish

from sb3_follow_object.comparison.cells import prepare
from sb3_follow_object.comparison.compare import runs_left, share_cores
from sb3_follow_object.comparison.cross import CROSS_TESTS
from sb3_follow_object.comparison.executors import Message
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.comparison.ledger import read_grid
from sb3_follow_object.comparison.results import read_results, write_tables
from sb3_follow_object.comparison.worker import STAGE, TRAIN, Job
from sb3_follow_object.runs.object_stage_files import OBJECT_STAGE


def test_grid_runs_as_many_at_once_as_there_are_places(tmp_path: Path) -> None:
    executor = FakeExecutor(do_it, slots=3)
    cells = small_plan(tmp_path)
    runs, display = comparison(tmp_path, executor, cells)
    assert runs.run() == []
    assert all(cell.finished for cell in cells)
    assert sorted(executor.names(TRAIN)) == sorted(cell.name for cell in cells)
    assert executor.names(STAGE) == ["object/PnPShelf-0", "object/PushSideGap-0"]
    assert executor.most == 3
    assert display.remaining() == 0.0


def test_stage_is_learned_once_and_every_run_that_uses_it_tells_its_cost(tmp_path: Path) -> None:
    executor = FakeExecutor(do_it)
    first, second = plan(tmp_path, ["PnPShelf"], ["fo", "her"], [0], SETTINGS)
    # Any two methods with the same object stage do; her is told to need it too.
    second = replace(second, config=replace(second.config, settings=first.config.settings))
    assert comparison(tmp_path, executor, [first, second])[0].run() == []
    assert executor.names(STAGE) == ["object/PnPShelf-0"]
    for cell in (first, second):
        assert json.loads((cell.folder / OBJECT_STAGE).read_text()) == {"object_steps": 7}


def test_finished_runs_are_never_repeated(tmp_path: Path) -> None:
    comparison(tmp_path, FakeExecutor(do_it), small_plan(tmp_path))[0].run()
    again = FakeExecutor(do_it)
    assert comparison(tmp_path, again, small_plan(tmp_path))[0].run() == []
    assert again.jobs == []
    more = FakeExecutor(do_it)
    cells = plan(tmp_path, ["PnPShelf"], ["her"], [0, 1], SETTINGS)
    comparison(tmp_path, more, cells)[0].run()
    assert more.names(TRAIN) == ["PnPShelf-her-1"]


def test_failed_run_is_tried_twice_and_the_others_go_on(tmp_path: Path) -> None:
    def do(job: Job) -> list[Message]:
        return [{"failed": "RuntimeError: diverged"}] if "Shelf-her" in job.name else do_it(job)

    executor = FakeExecutor(do)
    assert comparison(tmp_path, executor, small_plan(tmp_path))[0].run() == ["PnPShelf-her-0"]
    assert executor.names(TRAIN).count("PnPShelf-her-0") == 2
    grid = read_grid(tmp_path)
    assert grid is not None
    assert grid["cells"]["PnPShelf-her-0"]["error"] == "RuntimeError: diverged"
    assert sum(cell.finished for cell in small_plan(tmp_path)) == 3

    later = FakeExecutor(do_it)
    assert comparison(tmp_path, later, small_plan(tmp_path))[0].run() == ["PnPShelf-her-0"]
    assert later.jobs == [], "a run that was given up is left alone"
    retried = comparison(tmp_path, later, small_plan(tmp_path), retry_failed=True)[0]
    assert retried.run() == []
    assert later.names(TRAIN) == ["PnPShelf-her-0"]


def test_run_that_fails_once_comes_through(tmp_path: Path) -> None:
    failed: list[str] = []

    def do(job: Job) -> list[Message]:
        if job.kind == TRAIN and job.name not in failed:
            failed.append(job.name)
            return [{"failed": "OSError: no space left"}]
        return do_it(job)

    executor = FakeExecutor(do)
    assert comparison(tmp_path, executor, small_plan(tmp_path))[0].run() == []
    assert len(failed) == 4
    grid = read_grid(tmp_path)
    assert grid is not None
    assert {cell["failures"] for cell in grid["cells"].values()} == {0}


def test_failed_stage_fails_the_runs_that_need_it_and_no_others(tmp_path: Path) -> None:
    def do(job: Job) -> list[Message]:
        return [{"failed": "ValueError: no"}] if job.kind == STAGE else do_it(job)

    executor = FakeExecutor(do)
    failed = comparison(tmp_path, executor, small_plan(tmp_path))[0].run()
    assert failed == ["PnPShelf-fo-0", "PushSideGap-fo-0"]
    assert executor.names(STAGE).count("object/PnPShelf-0") == 2
    write_tables(read_results(tmp_path), tmp_path)
    line = "- PnPShelf-fo-0 failed: its object stage failed: ValueError: no\n"
    assert line in (tmp_path / "table.md").read_text()
    assert sorted(executor.names(TRAIN)) == ["PnPShelf-her-0", "PushSideGap-her-0"]


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_the_jobs_and_the_next_call_goes_on(tmp_path: Path, signum: int) -> None:
    def begin(job: Job) -> list[Message]:
        os.kill(os.getpid(), signum)
        return [{"figures": {"env_steps": 10, "success_rate": None, "k_max": None}}]

    executor = FakeExecutor(begin, slots=1)
    with pytest.raises(KeyboardInterrupt):
        comparison(tmp_path, executor, small_plan(tmp_path, ("her",)))[0].run()
    assert executor.stops == 1
    assert len(executor.jobs) == 1, "nothing is started after the signal"
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    later = FakeExecutor(do_it)
    assert comparison(tmp_path, later, small_plan(tmp_path, ("her",)))[0].run() == []
    assert later.names(TRAIN) == ["PnPShelf-her-0", "PushSideGap-her-0"]
    grid = read_grid(tmp_path)
    assert grid is not None
    assert {cell["failures"] for cell in grid["cells"].values()} == {0}, "a stop is no failure"


def test_what_cannot_be_started_stops_the_others(tmp_path: Path) -> None:
    def start(job: Job) -> list[Message]:
        if executor.jobs:
            raise OSError(28, "No space left on device")
        return []

    executor = FakeExecutor(start)
    work, _ = comparison(tmp_path, executor, small_plan(tmp_path, ("her",)))
    with pytest.raises(OSError, match="No space left"):
        work.run()
    assert executor.stops == 1


@pytest.mark.parametrize(
    ("n_cores", "n_runs", "jobs", "threads", "expected"),
    [
        (2, 8, None, None, (2, 1)),
        (8, 2, None, None, (2, 4)),
        (8, 20, None, 4, (2, 4)),
        (8, 20, 3, None, (3, 2)),
        (2, 20, 4, None, (4, 1)),
        (1, 5, None, 3, (1, 3)),
    ],
)
def test_cores_are_shared_out(
    n_cores: int,
    n_runs: int,
    jobs: int | None,
    threads: int | None,
    expected: tuple[int, int],
) -> None:
    assert share_cores(n_cores, n_runs, jobs, threads) == expected


def test_cores_are_shared_out_among_what_is_left(tmp_path: Path) -> None:
    def do(job: Job) -> list[Message]:
        return [{"failed": "RuntimeError: diverged"}] if "Shelf" in job.name else do_it(job)

    tasks = ["PnPShelf", "PushSideGap", "PnPSimpleV1"]
    cells = plan(tmp_path, tasks, ["her"], [0, 1], SETTINGS)
    assert runs_left(tmp_path, cells) == 6
    comparison(tmp_path, FakeExecutor(do), cells[:-1])[0].run()
    assert runs_left(tmp_path, cells) == 1, "others are finished or given up"
    assert runs_left(tmp_path, cells, retry_failed=True) == 3
    (cells[2].folder / CROSS_TESTS).unlink()
    assert runs_left(tmp_path, cells) == 2
    assert runs_left(tmp_path, cells[1:2]) == 1, "nothing is left"


def test_no_places_are_refused() -> None:
    with pytest.raises(ValueError, match="jobs is 0; it must be at least 1"):
        share_cores(2, 1, 0, None)


def test_run_finished_after_it_was_given_up_is_no_failure(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    runs, _ = comparison(tmp_path, FakeExecutor(do_it), [cell])
    runs._ledger.note_failure(cell.name, "diverged", final=True)
    prepare(cell, None)
    finish(cell.folder)
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    assert comparison(tmp_path, FakeExecutor(do_it), [cell])[0].run() == []
