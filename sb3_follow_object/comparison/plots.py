"""Learning curves: success and k_max against env steps and wall time."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from ..common.extras import need
from ..common.files import atomic_write
from ..runs.run_folder import EVALUATIONS
from ..settings.presets import read_config
from .variants import decisive, in_words, names_apart, read_configs

X_AXES = {"env_steps": ("env steps", 1.0), "wall_s": ("wall time (minutes)", 60.0)}
_Y = {"success_rate": "success on original goals", "k_max": "k_max"}


@dataclass(frozen=True)
class Curve:
    """What a run's validations came to.

    Attributes:
        task: gymnasium id.
        method: its name.
        columns: arrays (n,) of env_steps, wall_s, success_rate and, where imagined goals were
            shown, k_max.
        settings: what its result hangs on besides task, method and seed, by dotted names.
    """

    task: str
    method: str
    columns: dict[str, np.ndarray]
    settings: dict[str, Any] = field(default_factory=dict)


def read_curve(folder: str | os.PathLike[str]) -> Curve:
    """Read a run folder, of a finished run or of one that is still going on.

    Raises:
        ValueError: it holds no run, one without a validation so far, or a damaged file of them.
    """
    config = read_config(folder)
    path = Path(folder) / EVALUATIONS
    rows = _read_rows(path)
    if not rows:
        raise ValueError(f"the run in {folder} has not been validated yet: nothing to plot")
    names = [*X_AXES, *(name for name in _Y if rows[0].get(name))]
    try:
        columns = {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a file of evaluations ({error})") from error
    return Curve(config.env_id, config.method, columns, decisive(config))


def was_validated(folder: str | os.PathLike[str]) -> bool:
    """Whether a run has been validated at least once, so that it has a curve.

    Args:
        folder: of the run, whether it exists or not.

    Raises:
        ValueError: the file of its validations is damaged.
    """
    return bool(_read_rows(Path(folder) / EVALUATIONS))


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a file of evaluations, none where there is no such file."""
    rows = read_rows(path, "file of evaluations") if path.exists() else []
    if any(None in (*row, *row.values()) for row in rows):
        raise ValueError(f"{path} is not a file of evaluations (a line is cut, or too long)")
    return rows


def read_rows(path: Path, kind: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file.

    Args:
        path: of the file.
        kind: what it should be, for the error.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (csv.Error, ValueError) as error:  # a quote that never ends; bytes that are no text
        raise ValueError(f"{path} is not a {kind} ({error})") from error


def spread(curves: Sequence[Curve], x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a common axis and the quartiles of several runs there.

    Args:
        curves: runs that differ in their seed, >= 1.
        x: column of the axis; runs are compared where all of them have been.
        y: column of the values, interpolated between validations.

    Returns:
        points (n,); 25%, 50% and 75% quantiles over the runs, shape (3, n).
    """
    axes = [curve.columns[x] for curve in curves]
    points = np.unique(np.concatenate(axes))
    common = (points >= max(axis[0] for axis in axes)) & (points <= min(axis[-1] for axis in axes))
    if common.any():  # else one run began after another's end; both are held at their ends
        points = points[common]
    values = [np.interp(points, curve.columns[x], curve.columns[y]) for curve in curves]
    return points, np.quantile(values, [0.25, 0.5, 0.75], axis=0)


def by_settings(curves: Sequence[Curve]) -> dict[str, list[Curve]]:
    """Return runs of one method and task by the settings in which they differ, in words.

    Args:
        curves: of one method and task; those that differ in nothing come under "".
    """
    groups: dict[str, list[Curve]] = {}
    names = names_apart([curve.settings for curve in curves])
    for curve in curves:
        groups.setdefault(in_words(curve.settings, names), []).append(curve)
    return groups


def draw_curves(folders: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str]) -> None:
    """Draw runs in one figure: a line a method, task and choice of settings, over the seeds.

    Lines are medians, with quartiles around them.

    Args:
        folders: of the runs, >= 1; one that is named twice is drawn once.
        out: PNG file to create or replace.

    Raises:
        MissingExtra: matplotlib is not installed.
        ValueError: a folder holds nothing to plot, or two hold the same finished run.
    """
    figure_module = need("matplotlib.figure", "plots")
    ticker = need("matplotlib.ticker", "plots")
    groups: dict[tuple[str, str], list[Curve]] = {}
    for curve in map(read_curve, read_configs(map(Path, folders))):
        groups.setdefault((curve.task, curve.method), []).append(curve)
    tasks = sorted({task for task, _ in groups})
    shown = [
        y for y in _Y if any(y in curve.columns for group in groups.values() for curve in group)
    ]
    figure = figure_module.Figure(figsize=(10, 3.2 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), len(X_AXES), squeeze=False)
    for (task, method), group in sorted(groups.items()):
        for settings, alike in sorted(by_settings(group).items()):
            label = method if len(tasks) == 1 else f"{task} {method}"
            label += f" {shorten(settings, 60)}" if settings else ""
            label += f" ({len(alike)} runs)" if len(alike) > 1 else ""
            _draw_group(axes, shown, alike, label)
    for row, y in zip(axes, shown, strict=True):
        for axis, (name, _) in zip(row, X_AXES.values(), strict=True):
            axis.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
            axis.set(xlabel=name, ylabel=_Y[y], xlim=(0, None), ylim=(0, None))
            if y == "success_rate":
                axis.set_ylim(-0.02, 1.02)
            axis.grid(alpha=0.3)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center")
    if len(tasks) == 1:
        figure.suptitle(tasks[0])
    save_png(figure, out, dpi=120)


def save_png(figure: Any, path: str | os.PathLike[str], dpi: int) -> None:
    """Write a figure of matplotlib's, whole or not at all."""
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=dpi)
    atomic_write(path, image.getvalue())


def _draw_group(axes: Any, shown: Sequence[str], group: Sequence[Curve], label: str) -> None:
    """Draw one method's runs into every panel."""
    for row, y in zip(axes, shown, strict=True):
        if not all(y in curve.columns for curve in group):
            for axis in row:
                axis.plot([], [])  # keeps the colours the same in every panel
            continue
        for axis, (x, (_, unit)) in zip(row, X_AXES.items(), strict=True):
            points, (low, middle, high) = spread(group, x, y)
            (line,) = axis.plot(points / unit, middle, label=label)
            if len(group) > 1:
                axis.fill_between(points / unit, low, high, alpha=0.2, color=line.get_color())
