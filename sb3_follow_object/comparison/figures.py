"""The paper's figures from a folder of results; what has not been run is drawn as not run."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..common.extras import MissingExtra, need
from ..envs import TASKS
from ..settings.methods import METHODS
from ..settings.presets import read_config
from .cross import PAIR, read_cross_tests
from .plots import X_AXES, Curve, read_curve, save_png, spread, was_validated
from .results import (
    FINISHED,
    UNFINISHED,
    Group,
    Run,
    common_runs,
    group_runs,
    ordered,
    read_results,
    success_rates,
)
from .statistics import performance_profiles, quartiles, sample_efficiency

PNP_SIMPLE, OTHER_TASKS = "pnp_simple.png", "other_tasks.png"
WALL_TIME, FINAL_SUCCESS = "wall_time.png", "final_success.png"
ACROSS_TASKS = "across_tasks.png"

_SHARES = np.linspace(0.0, 1.0, 51)  # of success, and of a task's env steps

_NOTE_WIDTH = 76  # characters of a note above a panel

_HATCH = {"hatch": "///", "facecolor": "none", "edgecolor": "0.6", "linewidth": 0.0}
_BASELINE = "her"  # the paper's HER-a and HER-b
_SHADES = {"a": "0.35", "b": "0.7"}  # no method's colour: the bars name what they show


def draw_results(
    results: str | os.PathLike[str], out: str | os.PathLike[str], methods: Sequence[str] = METHODS
) -> list[Path]:
    """Draw the paper's two figures, success against wall time, final successes, and profiles.

    Args:
        results: folder of runs, as `compare` and benchmarks/results lay it out.
        out: folder for the figures; is created.
        methods: that should be there; one without runs is drawn as not run, and a method that has
            runs is drawn whether it is named or not.

    Returns:
        The PNG files.

    Raises:
        MissingExtra: matplotlib is not installed.
        ValueError: the folder holds no runs.
    """
    runs = read_results(results)
    drawn = _with_variants(methods, runs)
    tasks = [*TASKS, *sorted({run.task for run in runs} - set(TASKS))]
    groups = group_runs(runs, tasks, drawn)
    own = not runs or any(run.task in TASKS for run in runs)
    others = [task for task in tasks if task not in PAIR and (own or task not in TASKS)]
    figures: dict[str, Callable[[], Any]] = {
        PNP_SIMPLE: lambda: _pnp_simple(groups, drawn),
        OTHER_TASKS: lambda: _curves(groups, drawn, others, "env_steps"),
        WALL_TIME: lambda: _curves(groups, drawn, tasks, "wall_s"),
        FINAL_SUCCESS: lambda: _final_success(groups, drawn, tasks),
        ACROSS_TASKS: lambda: _across_tasks(groups, drawn),
    }
    need("matplotlib", "plots")
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    for name, draw in figures.items():
        save_png(draw(), out / name, dpi=110)
    return [out / name for name in figures]


def draw_methods(
    results: str | os.PathLike[str], out: str | os.PathLike[str], methods: Sequence[str]
) -> None:
    """Draw learning curves of these methods alone, a panel for each task that two of them ran.

    Args:
        results: as in `draw_results`.
        out: PNG file to create or replace.
        methods: two or more.

    Raises:
        MissingExtra: matplotlib is not installed.
        ValueError: the folder holds no runs, or no task has runs of two of the methods.
    """
    runs = [run for run in read_results(results) if _plain(run.method) in methods]
    seen = [run for run in runs if run.status in (FINISHED, UNFINISHED)]
    ran = {task: {_plain(run.method) for run in seen if run.task == task} for task in TASKS}
    tasks = [task for task in TASKS if len(ran[task]) > 1]
    if not tasks:
        raise ValueError(f"no task in {results} has runs of two of {', '.join(methods)}")
    drawn = _with_variants(methods, runs)
    save_png(_curves(group_runs(runs, tasks, drawn), drawn, tasks, "env_steps"), out, dpi=110)


def _pnp_simple(groups: Sequence[Group], methods: Sequence[str]) -> Any:
    """Return the paper's figure on PnP-Simple: HER's cross test, and all methods on both."""
    figure, axes = _figure(1, 3)
    _cross_panel(axes[0], groups)
    for axis, task in zip(axes[1:], PAIR, strict=True):
        _curve_panel(axis, groups, methods, task, "env_steps")
    _legend(figure, methods)
    return figure


def _curves(groups: Sequence[Group], methods: Sequence[str], tasks: Sequence[str], x: str) -> Any:
    """Return learning curves, a panel a task; of six tasks they are the paper's last figure."""
    columns = min(3, len(tasks))
    figure, axes = _figure(-(-len(tasks) // columns), columns)
    for axis, task in zip(axes, tasks, strict=False):
        _curve_panel(axis, groups, methods, task, x)
    for axis in axes[len(tasks) :]:
        axis.axis("off")
    _legend(figure, methods)
    return figure


def _final_success(groups: Sequence[Group], methods: Sequence[str], tasks: Sequence[str]) -> Any:
    """Return a matrix of final successes, hatched where there is none."""
    patches = need("matplotlib.patches", "plots")
    figure = need("matplotlib.figure", "plots").Figure(
        figsize=(2.2 + 1.25 * len(methods), 1.2 + 0.55 * len(tasks)), layout="constrained"
    )
    axis = figure.subplots()
    medians = np.full((len(tasks), len(methods)), np.nan)
    for group in groups:
        row, column = tasks.index(group.task), methods.index(group.method)
        lines, color = group.missing.split(", ") if group.missing else [], "black"
        if group.of(FINISHED):
            _, middle, _ = quartiles(group.success)
            medians[row, column] = middle
            lines = [f"{middle:.2f} ({len(group.success)})", *lines]
            color = "black" if middle > 0.6 else "white"
        else:
            axis.add_patch(patches.Rectangle((column - 0.5, row - 0.5), 1, 1, **_HATCH))
        text = "\n".join(lines)
        axis.text(column, row, text, ha="center", va="center", fontsize=8, color=color)
    image = axis.imshow(medians, vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
    axis.set_xticks(range(len(methods)), [_narrow(method) for method in methods], fontsize=8)
    axis.set_yticks(range(len(tasks)), tasks)
    figure.colorbar(image, label="final success, median over seeds")
    return figure


def _across_tasks(groups: Sequence[Group], methods: Sequence[str]) -> Any:
    """Return performance profiles and sample efficiency over tasks that methods share."""
    figure, axes = _figure(1, 2)
    tasks, runs = common_runs(groups)
    budgets = _budgets(runs)
    title = f"{', '.join(tasks)}\nseeds: {', '.join(f'{m} {len(s)}' for m, s in runs.items())}"
    try:
        profiles = performance_profiles({m: success_rates(s) for m, s in runs.items()}, _SHARES)
        means = sample_efficiency({m: _success_over_time(s, budgets) for m, s in runs.items()})
    except MissingExtra as error:
        title, profiles, means = str(error), {}, {}
    for axis, bands in zip(axes, (profiles, means), strict=True):
        for method, (middle, low, high) in bands.items():
            color = _color(methods, method)
            axis.plot(_SHARES, middle, color=color)
            if len(runs[method]) > 1:
                axis.fill_between(_SHARES, low, high, alpha=0.2, color=color)
        axis.set(xlim=(0, 1), ylim=(-0.02, 1.02))
        axis.grid(alpha=0.3)
    axes[0].set(xlabel="success", ylabel="share of runs above it")
    axes[1].set(xlabel="share of a task's env steps", ylabel="interquartile mean of success")
    figure.suptitle(title if tasks else "no task that two methods finished", fontsize=7)
    _legend(figure, methods, drawn=list(runs))
    return figure


def _budgets(runs: Mapping[str, Sequence[Sequence[Run]]]) -> list[int]:
    """Return each task's env steps: the most that a run of any method was to have, in its order."""
    seeds = [seed for of_method in runs.values() for seed in of_method]
    steps = [[read_config(run.folder).total_timesteps for run in seed] for seed in seeds]
    return [max(of_task) for of_task in zip(*steps, strict=True)]


def _success_over_time(runs: Sequence[Sequence[Run]], budgets: Sequence[int]) -> np.ndarray:
    """Return success at shares of the tasks' env steps, (seeds, tasks, n).

    A run that ended before them, because it was solved or was to have fewer, keeps its last.
    """
    rows = [zip(seed, budgets, strict=True) for seed in runs]
    return np.array([[_success_of_budget(run, budget) for run, budget in row] for row in rows])


def _success_of_budget(run: Run, budget: int) -> np.ndarray:
    assert run.env_steps is not None and run.success_rate is not None  # it has finished
    steps, success = np.array([]), np.array([])
    if was_validated(run.folder):
        columns = read_curve(run.folder).columns
        steps, success = columns["env_steps"], columns["success_rate"]
    steps, success = np.append(steps, run.env_steps), np.append(success, run.success_rate)
    return np.interp(_SHARES * budget, steps, success, left=0.0)


def _cross_panel(axis: Any, groups: Sequence[Group]) -> None:
    """Draw how HER, trained on each of the two versions, does on both."""
    cells = {group.task: group for group in groups if group.method == _BASELINE}
    labels = []
    for place, ((letter, trained), tested) in enumerate(
        (version, tested) for version in zip("ab", PAIR, strict=True) for tested in PAIR
    ):
        labels.append(f"HER-{letter} on\n{tested}")
        group = cells.get(trained)
        values = _cross_values(group, tested) if group else np.empty(0)
        crossed = group.runs if group and tested != trained else ()
        n_failed = sum(run.cross_error is not None for run in crossed)
        if not len(values):
            axis.bar(place, 1.0, width=0.8, **_HATCH)
            missing = group.missing if group else ""
            missing = missing or ("failed" if n_failed else "not tested")
            axis.text(place, 0.5, missing, ha="center", va="center", rotation=90)
            continue
        labels[-1] += f"\n{n_failed} failed" if n_failed else ""
        low, middle, high = quartiles(values)
        error = [[middle - low], [high - middle]]
        axis.bar(place, middle, width=0.8, yerr=error, capsize=3, color=_SHADES[letter])
        axis.text(place, middle + 0.02, f"{middle:.2f}", ha="center")
    axis.set_xticks(range(len(labels)), labels, fontsize=7)
    axis.set_title("HER-a and HER-b", pad=16)
    axis.set(ylabel="final success", ylim=(0.0, 1.1))


def _cross_values(group: Group, tested: str) -> np.ndarray:
    """Return the success rates on one version of policies trained on the group's, (n,)."""
    if tested == group.task:
        return group.success
    tests = [read_cross_tests(run.folder) for run in group.of(FINISHED)]
    return np.array([test[tested]["success_rate"] for test in tests if tested in test])


def _curve_panel(
    axis: Any, groups: Sequence[Group], methods: Sequence[str], task: str, x: str
) -> None:
    """Draw all methods' curves on a task: median and quartiles; single runs while unfinished."""
    ticker = need("matplotlib.ticker", "plots")
    label, unit = X_AXES[x]
    notes: dict[str, list[str]] = {}  # methods by what is missing
    for group in (group for group in groups if group.task == task):
        color = _color(methods, group.method)
        finished = _read_curves(group, FINISHED)
        missing = group.missing or ("" if finished else "no validations")
        if missing:
            notes.setdefault(missing, []).append(group.method)
        if finished:
            points, (low, middle, high) = spread(finished, x, "success_rate")
            axis.plot(points / unit, middle, color=color, marker="." if len(points) < 3 else "")
            if len(finished) > 1:
                axis.fill_between(points / unit, low, high, alpha=0.2, color=color)
        for curve in _read_curves(group, UNFINISHED):
            xs = curve.columns[x] / unit
            axis.plot(xs, curve.columns["success_rate"], color=color, linestyle=":", marker=".")
    axis.set(xlabel=label, ylabel="success on original goals", ylim=(-0.02, 1.02))
    note = "; ".join(f"{what}: {', '.join(names)}" for what, names in notes.items())
    lines = textwrap.wrap(note, _NOTE_WIDTH)
    axis.set_title(task, pad=7 + 9 * max(1, len(lines)))
    axis.text(0.5, 1.02, "\n".join(lines), transform=axis.transAxes, ha="center", fontsize=7)
    axis.grid(alpha=0.3)
    if axis.lines:
        axis.set_xlim(0, None)
        axis.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
    else:
        patches = need("matplotlib.patches", "plots")
        axis.add_patch(patches.Rectangle((0, 0), 1, 1, transform=axis.transAxes, **_HATCH))
        axis.set_xticks([])


def _read_curves(group: Group, status: str) -> list[Curve]:
    """Return the curves of a group's runs of one status that were validated at least once."""
    return [read_curve(run.folder) for run in group.of(status) if was_validated(run.folder)]


def _figure(rows: int, columns: int) -> tuple[Any, list[Any]]:
    figure = need("matplotlib.figure", "plots").Figure(
        figsize=(4.4 * columns, 3.2 * rows + 0.5), layout="constrained"
    )
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False)))


def _legend(figure: Any, methods: Sequence[str], drawn: Sequence[str] | None = None) -> None:
    """Say which method has which colour, of those drawn; None, all and unfinished runs too."""
    lines = need("matplotlib.lines", "plots")
    shown = methods if drawn is None else drawn
    handles = [lines.Line2D([], [], color=_color(methods, m), label=m) for m in shown]
    if drawn is None:
        unfinished = {"color": "0.4", "linestyle": ":", "marker": ".", "label": "unfinished"}
        handles.append(lines.Line2D([], [], **unfinished))
    if not handles:
        return
    longest = max(len(handle.get_label()) for handle in handles)
    fit = max(1, int(figure.get_figwidth() / (0.6 + 0.08 * longest)))  # inches of an entry
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), fit))


def _with_variants(methods: Sequence[str], runs: Sequence[Run]) -> list[str]:
    """Return methods and all that runs have, without those that ran under variants' names alone."""
    found = ordered(METHODS, (run.method for run in runs))
    told_apart = {_plain(name) for name in found} - set(found)
    return list(dict.fromkeys([*(name for name in methods if name not in told_apart), *found]))


def _plain(method: str) -> str:
    """Return a method's name without the settings that tell it apart."""
    return method.partition(" (")[0]


def _narrow(method: str) -> str:
    """Return a method's name with the settings that tell it apart a line each, without groups."""
    name, _, settings = method.removesuffix(")").partition(" (")
    lines = re.split(r", (?=[a-z_.]+=)", settings) if settings else []
    return "\n".join((name, *(re.sub(r"^[a-z_.]+\.(?=\w+=)", "", line) for line in lines)))


def _color(methods: Sequence[str], method: str) -> str:
    return f"C{list(methods).index(method) % 10}"
