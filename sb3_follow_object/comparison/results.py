"""A folder of runs as rows, and tables of them."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.extras import MissingExtra
from ..common.files import atomic_write
from ..envs import TASKS
from ..runs.run_folder import CONFIG, RESULT, read_result, task_label, trained_steps
from ..settings.methods import METHODS
from ..settings.run_config import RunConfig
from .cross import cross_name, needs_cross_test
from .ledger import given_up, read_grid
from .statistics import (
    Estimate,
    interquartile_means,
    probabilities_of_improvement,
    quartiles,
)
from .variants import read_configs, run_folders, words_apart

FINISHED, FAILED, UNFINISHED, NOT_RUN = "finished", "failed", "unfinished", "not run"

TABLE_CSV, TABLE_MD = "table.csv", "table.md"


@dataclass(frozen=True)
class Run:
    """One run of a results folder, or one that should be there.

    Attributes:
        folder: of the run, whether it exists or not.
        task: its short name, or another environment's id.
        method: its name.
        seed: its seed.
        status: FINISHED, FAILED, UNFINISHED or NOT_RUN.
        env_steps: so far; None where nothing tells.
        wall_s: seconds that the whole run took; None before its end.
        success_rate: of the final test, in [0, 1]; None before the end.
        error: why it failed; None where it did not.
        cross_error: why its cross test was given up; None where it was not.
    """

    folder: Path
    task: str
    method: str
    seed: int
    status: str
    env_steps: int | None = None
    wall_s: float | None = None
    success_rate: float | None = None
    error: str | None = None
    cross_error: str | None = None


@dataclass(frozen=True)
class Group:
    """All seeds of a method on a task.

    Attributes:
        task: its name.
        method: its name.
        runs: those that a folder or a grid names; none where nobody asked for any.
    """

    task: str
    method: str
    runs: tuple[Run, ...]

    def of(self, status: str) -> list[Run]:
        """Return the runs of one status."""
        return [run for run in self.runs if run.status == status]

    @property
    def success(self) -> np.ndarray:
        """Final success rates of the finished runs, (n,)."""
        return np.array([run.success_rate for run in self.of(FINISHED)], dtype=np.float64)

    @property
    def status(self) -> str:
        """FINISHED when every run is, else what most needs saying."""
        if not self.runs:
            return NOT_RUN
        found = {run.status for run in self.runs}
        return next(s for s in (FAILED, UNFINISHED, NOT_RUN, FINISHED) if s in found)

    @property
    def missing(self) -> str:
        """What is not finished, in words; empty where everything is."""
        if not self.runs:
            return NOT_RUN
        counts = {status: len(self.of(status)) for status in (FAILED, UNFINISHED, NOT_RUN)}
        one = len(self.runs) == 1
        return ", ".join(s if one else f"{n} {s}" for s, n in counts.items() if n)


def read_results(folder: str | os.PathLike[str]) -> list[Run]:
    """Read a folder of run folders, and the runs that its grid file names beside them.

    Where runs of a task and method differ in more than their seed, their methods are told apart by
    what is not the preset's, on all tasks. A run that two names lead to is one run.

    Raises:
        ValueError: it holds no runs, two folders hold the same finished one, or a file of a run is
            damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder of results")
    cells = (read_grid(folder) or {"cells": {}})["cells"]
    configs = read_configs(run_folders(folder))
    runs = {
        path.name: _read_run(path, config, cells.get(path.name, {}))
        for path, config in configs.items()
    }
    for name, cell in cells.items():
        if name not in runs:
            status, error = (FAILED, cell["error"]) if given_up(cell) else (NOT_RUN, None)
            place = (folder / name, cell["task"], cell["method"], cell["seed"])
            runs[name] = Run(*place, status=status, error=error)
    if not runs:
        raise ValueError(f"{folder} holds no runs: no folder in it has a {CONFIG}")
    told_apart = _told_apart(list(runs.values()), words_apart(configs), cells)
    return sorted(told_apart, key=lambda run: (run.task, run.method, run.seed))


def _told_apart(
    runs: Sequence[Run], words: Mapping[Path, str], cells: Collection[str]
) -> list[Run]:
    """Return runs whose methods say in which settings they differ from others of theirs.

    Args:
        runs: all.
        words: of those that have begun, by folder.
        cells: names of the grid's; those that have not begun will have the others' settings.
    """
    begun = [run for run in runs if run.folder in words and run.folder.name in cells]

    def told(run: Run) -> Run:
        its_words = words.get(run.folder)
        if its_words is None:
            alike = [other for other in begun if other.method == run.method]
            of_task = [other for other in alike if other.task == run.task]
            found = {words[other.folder] for other in of_task or alike}
            its_words = found.pop() if len(found) == 1 else ""
        return replace(run, method=f"{run.method} ({its_words})") if its_words else run

    return [told(run) for run in runs]


def group_runs(
    runs: Sequence[Run], tasks: Iterable[str] | None = None, methods: Iterable[str] | None = None
) -> list[Group]:
    """Return a group for every task and method, with and without runs.

    Args:
        runs: of a results folder.
        tasks: in the order wanted; by default those that have runs, the package's first.
        methods: likewise.
    """
    tasks = ordered(TASKS, (run.task for run in runs)) if tasks is None else tasks
    methods = ordered(METHODS, (run.method for run in runs)) if methods is None else methods
    methods = list(methods)
    return [
        Group(task, method, tuple(r for r in runs if (r.task, r.method) == (task, method)))
        for task in tasks
        for method in methods
    ]


def ordered(known: Iterable[str], found: Iterable[str]) -> list[str]:
    """Return the names that were found, in the known ones' order, the others behind them."""
    names = set(found)
    first = [name for name in known if name in names]
    return first + sorted(names - set(first))


def common_runs(groups: Sequence[Group]) -> tuple[list[str], dict[str, list[list[Run]]]]:
    """Return what methods can be compared on: tasks that each of them has finished runs of.

    Of methods and tasks it is the most that leave no cell empty: methods that ran on few tasks are
    left out, rather than the tasks that they did not run on. The first method is always there.

    Returns:
        The tasks, and by method its finished runs, seed by seed one of each task: as many as it
        has of all of these. Methods come in the groups' order. Empty where no task is common to
        the first and another.
    """
    finished = {(g.task, g.method): g.of(FINISHED) for g in groups if g.of(FINISHED)}
    ran = {method: {task for task, other in finished if other == method} for _, method in finished}
    methods = [method for method in dict.fromkeys(g.method for g in groups) if method in ran]
    if len(methods) < 2:
        return [], {}
    first, *others = methods
    chosen, tasks = [first], ran[first]
    most: tuple[list[str], set[str]] = [], set()
    for method in sorted(others, key=lambda method: -len(ran[method] & ran[first])):
        chosen, tasks = [*chosen, method], tasks & ran[method]
        if tasks and len(chosen) * len(tasks) >= len(most[0]) * len(most[1]):
            most = chosen, tasks
    ordered = [task for task in dict.fromkeys(g.task for g in groups) if task in most[1]]
    return ordered, _seed_by_seed(finished, ordered, [m for m in methods if m in most[0]])


def _seed_by_seed(
    finished: Mapping[tuple[str, str], Sequence[Run]], tasks: Sequence[str], methods: Sequence[str]
) -> dict[str, list[list[Run]]]:
    """Return by method its finished runs, seed by seed one of each task."""
    of_seeds = {m: zip(*(finished[task, m] for task in tasks), strict=False) for m in methods}
    return {method: [list(runs) for runs in seeds] for method, seeds in of_seeds.items()}


def success_rates(runs: Sequence[Sequence[Run]]) -> np.ndarray:
    """Return the final success rates of `common_runs`, shape (seeds, tasks)."""
    return np.array([[run.success_rate for run in seed] for seed in runs], dtype=np.float64)


def table_rows(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Return a row for each group: counts, final success over seeds, cost; None where unknown."""
    keyed = {(g.task, g.method): g.success[:, None] for g in groups if len(g.success) > 1}
    try:
        means = interquartile_means(keyed) if keyed else {}
    except MissingExtra:
        means = {}
    rows = []
    for group in groups:
        finished = group.of(FINISHED)
        low, middle, high = quartiles(group.success) if finished else (None, None, None)
        iqm = means.get((group.task, group.method), (None, None, None))
        rows.append(
            {
                "task": group.task,
                "method": group.method,
                "seeds": len(group.runs),
                **{s.replace(" ", "_"): len(group.of(s)) for s in (FINISHED, FAILED, UNFINISHED)},
                "median": middle,
                "q25": low,
                "q75": high,
                "iqm": iqm[0],
                "iqm_low": iqm[1],
                "iqm_high": iqm[2],
                "env_steps": _median([run.env_steps for run in finished]),
                "wall_s": _median([run.wall_s for run in finished]),
                "status": group.missing or FINISHED,
            }
        )
    return rows


def csv_table(groups: Sequence[Group]) -> str:
    """Return the final success as CSV, a row for each task and method."""
    rows = table_rows(groups)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


def markdown_table(groups: Sequence[Group]) -> str:
    """Return the final success as Markdown, a line a task and a column a method.

    A cell holds the median over seeds, the quartiles where there are two seeds or more, the
    number of finished seeds, and what has not been finished.
    """
    methods = list(dict.fromkeys(group.method for group in groups))
    cells = {(group.task, group.method): _cell(group) for group in groups}
    lines = [f"| task | {' | '.join(methods)} |", "|---" * (len(methods) + 1) + "|"]
    for task in dict.fromkeys(group.task for group in groups):
        lines.append(f"| {task} | {' | '.join(cells[task, method] for method in methods)} |")
    lines += ["", "Median [quartiles] of the final success (over this many finished seeds)."]
    return "\n".join([*lines, *_aggregate_lines(groups), *_failure_lines(groups)]) + "\n"


def write_tables(runs: Sequence[Run], folder: str | os.PathLike[str]) -> None:
    """Write table.md and table.csv of all runs into a folder."""
    groups = group_runs(runs)
    atomic_write(Path(folder) / TABLE_MD, markdown_table(groups).encode())
    atomic_write(Path(folder) / TABLE_CSV, csv_table(groups).encode())


def _cell(group: Group) -> str:
    n = len(group.success)
    if not n:
        return group.missing
    low, middle, high = quartiles(group.success)
    text = f"{middle:.2f}" + (f" [{low:.2f}, {high:.2f}]" if n > 1 else "") + f" ({n})"
    return f"{text}; {group.missing}" if group.missing else text


def _aggregate_lines(groups: Sequence[Group]) -> list[str]:
    """Return what holds across tasks: a line a method, and what it is taken over."""
    tasks, runs = common_runs(groups)
    if not tasks:
        only_one = len({group.method for group in groups}) < 2
        none = "No interquartile means: there is no task that all methods have finished a run of."
        return [] if only_one else ["", none]
    scores = {method: success_rates(seeds) for method, seeds in runs.items()}
    first = next(iter(scores))
    try:
        means = interquartile_means(scores)
        better = probabilities_of_improvement(scores, first)
    except MissingExtra as error:
        return ["", f"No interquartile means: {error}."]
    lines = ["", f"| method | seeds | IQM | better than {first} |", "|---|---|---|---|"]
    for method, values in scores.items():
        n = len(values)
        both = min(n, len(scores[first]))
        other = _estimate(better[method], both) if method != first else ""
        lines.append(f"| {method} | {n} | {_estimate(means[method], n)} | {other} |")
    return [
        *lines,
        "",
        f"Interquartile mean, and probability that a run is better than one of {first}, with 95% "
        f"intervals from two seeds on, over the tasks that all of these ran: {', '.join(tasks)}.",
    ]


def _estimate(estimate: Estimate, n_seeds: int) -> str:
    interval = f" [{estimate.low:.2f}, {estimate.high:.2f}]" if n_seeds > 1 else ""
    return f"{estimate.value:.2f}{interval}"


def _failure_lines(groups: Sequence[Group]) -> list[str]:
    runs = [run for group in groups for run in group.runs]
    errors = [(run.folder.name, run.error) for run in runs]
    errors += [(cross_name(run.folder.name, run.task), run.cross_error) for run in runs]
    failed = [f"- {name} failed: {error}" for name, error in errors if error is not None]
    return ["", *failed] if failed else []


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _read_run(path: Path, config: RunConfig, cell: Mapping[str, Any]) -> Run:
    place = (path, task_label(config.env_id), config.method, config.seed)
    if (path / RESULT).exists():
        result = read_result(path)
        figures = {name: result[name] for name in ("env_steps", "wall_s", "success_rate")}
        untested = given_up(cell, cross=True) and needs_cross_test(path, config)
        cross_error = cell["cross"]["error"] if untested else None
        return Run(*place, status=FINISHED, **figures, cross_error=cross_error)
    steps = trained_steps(path)
    if given_up(cell):
        return Run(*place, status=FAILED, env_steps=steps, error=cell["error"])
    return Run(*place, status=UNFINISHED, env_steps=steps)
