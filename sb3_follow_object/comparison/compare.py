"""A comparison: a grid of tasks, methods and seeds, run as many at once as there are places."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from ..common.reports import Trouble, reason
from ..common.signals import stop_signals_to
from ..runs.run_folder import POLICY, trained_steps
from .cells import OBJECT, Cell, Settings, prepare, shared_stage, stage_is_ready
from .cross import cross_name, needs_cross_test, partner
from .executors import Executor, Message
from .grid_display import GridDisplay
from .ledger import ATTEMPTS, Ledger, given_up, read_grid
from .worker import CROSS, STAGE, TRAIN, Job

_POLL = 1.0  # seconds


def share_cores(
    n_cores: int, n_runs: int, jobs: int | None, threads: int | None
) -> tuple[int, int]:
    """Return how many runs go at once and how many cores each of them gets.

    Args:
        n_cores: that there are, >= 1.
        n_runs: that are left to do, >= 1; more at once than that would leave cores idle.
        jobs: at once, >= 1; None takes as many as fit.
        threads: of each run, >= 1; None shares the cores out.

    Raises:
        ValueError: a number below 1.
    """
    for name, value in (("jobs", jobs), ("threads", threads)):
        if value is not None and value < 1:
            raise ValueError(f"{name} is {value}; it must be at least 1")
    if jobs is None:
        jobs = max(1, min(n_runs, n_cores // (threads or 1)))
    return jobs, threads or max(1, n_cores // jobs)


def runs_left(
    folder: str | os.PathLike[str], cells: Sequence[Cell], retry_failed: bool = False
) -> int:
    """Return how many runs of a grid, or their cross tests, are left to do; 1 where none is.

    Args:
        folder: of the results.
        cells: the runs that are wanted, from `plan`.
        retry_failed: whether runs that were given up will be tried again.
    """
    kept = {} if retry_failed else (read_grid(Path(folder)) or {"cells": {}})["cells"]

    def is_left(cell: Cell) -> bool:
        if given_up(kept.get(cell.name, {}), cross=cell.finished):
            return False
        return not cell.finished or needs_cross_test(cell.folder, cell.config)

    return max(1, sum(map(is_left, cells)))


class Comparison:
    """Runs what is missing of a grid.

    Args:
        folder: of the results.
        cells: the runs that are wanted, from `plan`.
        settings: that they were planned with.
        executor: runs the jobs.
        threads: cores of each job, >= 1.
        display: shows how they go.
        retry_failed: give runs and cross tests that failed before another two attempts.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        cells: Sequence[Cell],
        settings: Settings,
        executor: Executor,
        threads: int,
        display: GridDisplay,
        retry_failed: bool = False,
    ):
        self._cells = {cell.name: cell for cell in cells}
        self._ledger = Ledger(Path(folder), settings, cells, retry_failed)
        self._executor = executor
        self._threads = threads
        self._display = display
        self._jobs: dict[str, Job] = {}  # under way, by their names
        self._stage_errors: dict[str, list[str]] = {}  # of object stages, one an attempt
        self._requests = 0  # to stop
        self._stopping = False

    def run(self) -> list[str]:
        """Run until nothing is left to do; return the names of runs and cross tests that failed.

        Raises:
            KeyboardInterrupt: on Ctrl-C or SIGTERM, once all runs have written a checkpoint.
        """
        for cell in self._cells.values():
            over = cell.finished or self._ledger.failed(cell.name)
            total = 0 if over else cell.config.total_timesteps
            self._display.expect(cell.name, total, trained_steps(cell.folder) or 0)
        with stop_signals_to(self._request_stop):
            try:
                self._fill()
                while self._jobs:
                    self._listen()
                    self._stop_when_asked()
                    self._fill()
                    self._display.refresh()
            except Exception:  # a full disk, say: what runs writes its checkpoint and ends
                self._requests = max(self._requests, 1)
                while self._jobs:
                    self._stop_when_asked()
                    self._listen()
                raise
        if self._requests:
            raise KeyboardInterrupt
        return [name for cell in self._cells.values() if (name := self._failure(cell))]

    def _listen(self) -> None:
        for name, message in self._executor.messages(_POLL):
            self._take(name, message)

    def _request_stop(self) -> None:
        self._requests += 1  # heeded between two jobs: a signal may come while one is started

    def _stop_when_asked(self) -> None:
        if self._requests and not self._stopping:
            self._stopping = True
            self._requests = 1
            self._display.say("stopping: each run writes a checkpoint first")
            self._executor.stop()
        elif self._requests > 1:
            self._requests = 1
            self._executor.stop()

    def _fill(self) -> None:
        """Start jobs while there are places and jobs."""
        while not self._requests and len(self._jobs) < self._executor.slots:
            job = self._next_job()
            if job is None:
                break
            self._executor.start(job)
            self._jobs[job.name] = job
            self._display.started(job.name, job.kind)
        left = [c for c in self._cells.values() if not c.finished and not self._failed(c)]
        finished = sum(cell.finished for cell in self._cells.values())
        failed = len(self._cells) - finished - len(left)
        self._display.count(finished, failed, len(self._cells))

    def _failed(self, cell: Cell) -> bool:
        return self._ledger.failed(cell.name)

    def _failure(self, cell: Cell) -> str | None:
        """Return what failed of a cell, by its name: its run or, after that, its cross test."""
        if not cell.finished:
            return cell.name if self._failed(cell) else None
        failed = self._ledger.failed(cell.name, cross=True)
        untested = failed and needs_cross_test(cell.folder, cell.config)
        return cross_name(cell.name, cell.task) if untested else None

    def _next_job(self) -> Job | None:
        """Return what to do next in the cells' order, None while all that is left must wait."""
        for cell in self._cells.values():
            job = self._job_of(cell)
            if job is not None and job.name not in self._jobs:
                return job
        return None

    def _job_of(self, cell: Cell) -> Job | None:
        """Return the next job that a cell asks for."""
        if cell.finished:
            return self._cross_job(cell)
        if self._failed(cell) or cell.name in self._jobs:
            return None
        stage = shared_stage(cell)
        if stage is not None and not stage_is_ready(stage):
            name = f"{OBJECT}/{stage.name}"
            errors = self._stage_errors.get(name, [])
            if len(errors) >= ATTEMPTS:
                error = f"its object stage failed: {errors[-1]}"
                self._ledger.note_failure(cell.name, error, final=True)
                return None
            return Job(STAGE, name, str(stage), self._threads)
        prepare(cell, stage)
        return Job(TRAIN, cell.name, str(cell.folder), self._threads, command=cell.command)

    def _cross_job(self, cell: Cell) -> Job | None:
        given_up = self._ledger.failed(cell.name, cross=True)
        if given_up or not needs_cross_test(cell.folder, cell.config):
            return None
        other = partner(cell.task)
        assert other is not None
        name = cross_name(cell.name, cell.task)
        if not (cell.folder / POLICY).exists():
            error = f"its run holds no {POLICY}"
            self._ledger.note_failure(cell.name, error, final=True, cross=True)
            self._display.say(Trouble(f"{name} failed: {error}"))
            return None
        env_id = cell.config.env_id.replace(cell.task, other)
        return Job(CROSS, name, str(cell.folder), self._threads, other=env_id)

    def _take(self, name: str, message: Message) -> None:
        """Note what a job told."""
        if "failed" in message or "stopped" in message:
            job = self._jobs.pop(name)
            if not self._stopping:
                self._note_failure(job, message.get("failed") or "it was stopped from outside")
            self._display.ended(name)
        elif "finished" in message:
            job = self._jobs.pop(name)
            if job.kind != STAGE:
                self._ledger.note_success(_cell_of(job), cross=job.kind == CROSS)
            self._display.ended(name, finished=True)
        else:
            self._display.update(name, message)

    def _note_failure(self, job: Job, error: str) -> None:
        if job.kind == STAGE:
            errors = self._stage_errors.setdefault(job.name, [])
            errors.append(error)
            last = len(errors) >= ATTEMPTS
        else:
            cell, cross = _cell_of(job), job.kind == CROSS
            self._ledger.note_failure(cell, error, cross=cross)
            last = self._ledger.failed(cell, cross)
        again = "it failed twice and is given up" if last else "it is taken up once more"
        self._display.say(Trouble(f"{job.name} failed: {error}; {again}"))


def _cell_of(job: Job) -> str:
    """Return the name of the cell whose run or cross test a job is."""
    return Path(job.folder).name


def write_report(folder: Path, say: Callable[[str], None]) -> None:
    """Write the tables and, where they can be drawn, the figures into the results folder."""
    from .figures import draw_results
    from .results import read_results, write_tables

    write_tables(read_results(folder), folder)
    try:
        draw_results(folder, folder / "figures")
    except Exception as error:  # of fonts, caches, disks; the tables hold what was measured
        say(Trouble(f"left out the figures: {reason(error)}"))
