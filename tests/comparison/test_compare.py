"""The driver of a comparison: order, resuming, failures, and real processes once."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from result_folders import finish

from sb3_follow_object.command import cli
from sb3_follow_object.common.files import lock
from sb3_follow_object.common.reports import Trouble
from sb3_follow_object.comparison import executors, figures
from sb3_follow_object.comparison.cells import Cell, Settings, prepare
from sb3_follow_object.comparison.compare import Comparison, runs_left, share_cores
from sb3_follow_object.comparison.cross import CROSS_TESTS
from sb3_follow_object.comparison.executors import LocalExecutor, Message
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.comparison.grid_display import GridDisplay
from sb3_follow_object.comparison.ledger import read_grid
from sb3_follow_object.comparison.results import read_results, write_tables
from sb3_follow_object.comparison.worker import CROSS, STAGE, TRAIN, Job, run_job
from sb3_follow_object.runs import experiment
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.runs.object_stage_files import OBJECT_STAGE
from sb3_follow_object.runs.run_folder import POLICY, RESULT
from sb3_follow_object.settings.presets import load_config, parse_override

SETTINGS = Settings(steps=1000)
TINY = ["policy_kwargs.net_arch=[8]", "batch_size=16", "gradient_steps=2", "n_envs=2"]
TINY += ["eval_every=400", "n_eval_episodes=2", "n_final_episodes=2", "buffer_size=2000"]


class FakeExecutor:
    """Does jobs at once, as it is told, and remembers them."""

    def __init__(self, do: Callable[[Job], list[Message]], slots: int = 2):
        self.slots = slots
        self.do = do
        self.jobs: list[Job] = []
        self.most = 0
        self.stops = 0
        self._told: list[tuple[str, Message]] = []

    def start(self, job: Job) -> None:
        told = self.do(job)
        self.jobs.append(job)
        self._told += [(job.name, message) for message in told]
        self.most = max(self.most, sum("finished" in message for _, message in self._told))

    def messages(self, timeout: float) -> list[tuple[str, Message]]:
        told, self._told = self._told, []
        return told

    def stop(self) -> None:
        self.stops += 1
        for job in self.jobs:
            self._told.append((job.name, {"stopped": True}))

    def names(self, kind: str) -> list[str]:
        return [job.name for job in self.jobs if job.kind == kind]


def do_it(job: Job) -> list[Message]:
    """Leave what a job would."""
    folder = Path(job.folder)
    assert (folder / "config.json").exists()
    if job.kind == STAGE:
        (folder / "predictor").mkdir(exist_ok=True)
        (folder / "predictor" / "predictor.json").write_text("{}")
        (folder / OBJECT_STAGE).write_text('{"object_steps": 7}')
    elif job.kind == TRAIN:
        (folder / POLICY).write_text("")
        finish(folder)
    else:
        tested = {job.other.split("/")[1][:-3]: {"success_rate": 0.5, "episodes": 380}}
        (folder / CROSS_TESTS).write_text(json.dumps(tested))
    figures = {"env_steps": 500, "success_rate": 0.5, "k_max": None}
    told: list[Message] = [{"say": "hello"}]
    return [*told, *([{"figures": figures}] if job.kind == TRAIN else []), {"finished": True}]


def comparison(
    folder: Path, executor: Any, cells: list[Cell], **options: Any
) -> tuple[Comparison, GridDisplay]:
    display = GridDisplay(quiet=True)
    return Comparison(folder, cells, SETTINGS, executor, 1, display, **options), display


def small_plan(folder: Path, methods: tuple[str, ...] = ("fo", "her")) -> list[Cell]:
    return plan(folder, ["PnPShelf", "PushSideGap"], methods, [0], SETTINGS)


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


def test_remaining_time_follows_the_steps_of_this_call_alone() -> None:
    now = [0.0]
    display = GridDisplay(quiet=True, clock=lambda: now[0])
    display.expect("a", 1000, 400)
    display.expect("b", 1000, 0)
    assert display.remaining() is None
    display.started("a", TRAIN)
    for now[0], steps in ((10.0, 500), (20.0, 600)):
        figures = {"env_steps": steps, "success_rate": None, "k_max": None}
        display.update("a", {"figures": figures})
    assert display.remaining() == pytest.approx(1400 * 20.0 / 100)
    display.ended("a", finished=True)
    assert display.remaining() == pytest.approx(1000 * 20.0 / 100)


def test_what_a_finished_run_is_said_to_have_is_its_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    display, told = GridDisplay(), []
    monkeypatch.setattr(display, "say", told.append)
    for name, kind in (("a", TRAIN), ("object/a", STAGE)):
        display.expect(name, 1000, 0)
        display.started(name, kind)
    figures = {"env_steps": 1000, "success_rate": 0.5, "k_max": 25}
    display.update("a", {"figures": figures})
    for name in ("a", "object/a"):
        display.update(name, {"say": "checkpoint at 1000 env steps: 0.2 MB"})
        display.ended(name, finished=True)
    assert told[2:] == ["a: train finished, success 0.50, k_max 25", "object/a: stage finished"]


def test_what_looks_like_markup_is_shown_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich draws as on a terminal
    monkeypatch.setenv("TERM", "xterm")
    with GridDisplay() as display:
        display.expect("run[/a]", 1000, 0)
        display.started("run[/a]", TRAIN)
        display.update("run[/a]", {"say": "wrote odd[/z]"})
        display.refresh()
    printed = capsys.readouterr().out
    assert "run[/a]" in printed and "odd[/z]" in printed


@pytest.mark.parametrize("quiet", [False, True])
def test_trouble_of_a_job_is_said(
    quiet: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*arguments: Any, report: Callable[[str], None], **options: Any) -> None:
        report("checkpoint at 500 env steps")
        report(Trouble("the checkpoint is not kept: No space left on device"))

    monkeypatch.setattr(experiment, "train", full)
    monkeypatch.setattr("sb3_follow_object.settings.presets.load_config", lambda folder: None)
    display = GridDisplay(quiet=quiet)
    display.started("a", TRAIN)
    told: list[Message] = []
    run_job(Job(TRAIN, "a", "a"), told.append)
    capsys.readouterr()
    for message in told:
        display.update("a", json.loads(json.dumps(message)))
    printed = capsys.readouterr()
    sentence = "a: the checkpoint is not kept: No space left on device\n"
    assert (printed.err if quiet else printed.out) == sentence


def finished_job(executor: LocalExecutor) -> Message:
    """Wait for the only job's last message."""
    while True:
        for _, message in executor.messages(1.0):
            if {"finished", "stopped", "failed"} & set(message):
                return message


def test_worker_that_raises_or_dies_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = LocalExecutor(1, tmp_path / "logs")
    executor.start(Job(TRAIN, "raises", str(tmp_path / "none")))
    failure = finished_job(executor)["failed"]
    assert failure.startswith("ValueError: ")
    assert "holds no run" in failure
    assert "Traceback" in (tmp_path / "logs" / "raises.log").read_text()

    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho almost there >&2\nkill -9 $$\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    executor.start(Job(TRAIN, "dies", str(tmp_path)))
    expected = "killed by signal 9; the log's last line: almost there"
    assert finished_job(executor) == {"failed": expected}


def test_worker_stops_with_a_checkpoint_when_its_comparison_is_gone(tmp_path: Path) -> None:
    overrides = dict(parse_override(text) for text in TINY)
    (cell,) = plan(tmp_path, ["PushSideGap"], ["her"], [0], Settings(100_000, overrides=overrides))
    prepare(cell, None)
    executor = LocalExecutor(1, tmp_path / "logs")
    executor.start(Job(TRAIN, cell.name, str(cell.folder)))
    while not any("figures" in message for _, message in executor.messages(1.0)):
        pass
    child = executor._children[cell.name]
    child.stdin.close()  # type: ignore[union-attr]  # as the system does when a process dies
    assert finished_job(executor) == {"stopped": True}
    assert list(cell.folder.glob("checkpoint*"))


def test_real_run_is_stopped_resumed_and_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["compare", "--out", str(tmp_path), "--tasks", "PushSideGap", "--methods", "her"]
    words += ["--seeds", "5", "--steps", "600", "--jobs", "1", "--threads", "1", "--set", *TINY]
    update = GridDisplay.update

    def stop_at_once(self: GridDisplay, name: str, message: Message) -> None:
        update(self, name, message)
        if "figures" in message:
            monkeypatch.setattr(GridDisplay, "update", update)
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(GridDisplay, "update", stop_at_once)
    run = tmp_path / "PushSideGap-her-5"
    with monkeypatch.context() as patch:
        patch.setattr(figures, "draw_results", lambda *arguments: [])
        assert cli.main(words) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert not (run / RESULT).exists()
    assert list(run.glob("checkpoint*")), "it was stopped without a checkpoint"
    assert "unfinished" in (tmp_path / "table.md").read_text()
    assert cli.main(words) == 0
    assert list((tmp_path / "figures").glob("*.png"))
    printed = capsys.readouterr()
    assert "resumed at" in (tmp_path / "logs" / "PushSideGap-her-5.log").read_text()
    assert "| PushSideGap | " in printed.out
    result = json.loads((run / RESULT).read_text())
    assert result["env_steps"] == 600
    assert result["command"].startswith(f"sb3-follow-object train --run {run} --env")
    assert cli.main([*words, "--steps", "700"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    with lock(tmp_path, wait=False):
        assert cli.main(words) == 2
    assert f"another process works in {tmp_path}" in capsys.readouterr().err


def test_job_waits_for_the_worker_of_a_killed_comparison(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PushSideGap"], ["her"], [0], SETTINGS)
    prepare(cell, None)
    other = ExitStack()  # that worker: it has not heard yet that its comparison is gone
    other.enter_context(lock(cell.folder, wait=False))
    with pytest.raises(ValueError, match="another process works in"):
        train(load_config(cell.folder), cell.folder, resume=True, report=pytest.fail)

    def end() -> None:
        finish(cell.folder, env_steps=1000)
        other.close()

    threading.Timer(0.5, end).start()
    told: list[dict[str, Any]] = []
    run_job(Job(TRAIN, cell.name, str(cell.folder)), told.append)
    assert told == [{"say": f"{cell.folder} is finished already"}], "it looks after it waited"


def test_run_finished_after_it_was_given_up_is_no_failure(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    runs, _ = comparison(tmp_path, FakeExecutor(do_it), [cell])
    runs._ledger.note_failure(cell.name, "diverged", final=True)
    prepare(cell, None)
    finish(cell.folder)
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    assert comparison(tmp_path, FakeExecutor(do_it), [cell])[0].run() == []
