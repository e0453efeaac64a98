"""One HTML file of a run or of a comparison, which is read in a browser and needs nothing else."""

from __future__ import annotations

import base64
import html
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..common.files import atomic_write
from ..runs.run_folder import CONFIG, RESULT, VERSIONS, noted_command, read_result, task_label
from ..settings.presets import read_config
from ..settings.run_config import flat
from .plots import Curve, read_curve, read_rows, spread, was_validated
from .results import FINISHED, Run, group_runs, ordered, read_results, table_rows

_TEMPLATE = Path(__file__).parent / "report.html"
_KINDS = {".png": "image/png", ".mp4": "video/mp4"}
_STEPS = "env steps"
_SHARES = (-0.02, 1.02)  # the axis of success rates


@dataclass
class _Page:
    """Parts of a report, in their order, and the data of its charts."""

    parts: list[str] = field(default_factory=list)
    charts: list[dict[str, Any]] = field(default_factory=list)

    def heading(self, text: str) -> None:
        self.parts.append(f"<h2>{html.escape(text)}</h2>")

    def note(self, text: str) -> None:
        self.parts.append(f"<p>{html.escape(text)}</p>")

    def table(self, rows: Iterable[Sequence[Any]], head: Sequence[str] = ()) -> None:
        """Add a table; the first column of one without a head names its rows."""
        lines = ["<div class=scroll><table>"]
        if head:
            lines.append("<tr>" + "".join(f"<th>{html.escape(name)}</th>" for name in head))
        for first, *rest in rows:
            cells = [f"<td>{html.escape(_shown(value))}</td>" for value in rest]
            kind = "td" if head else "th"
            lines.append(f"<tr><{kind}>{html.escape(_shown(first))}</{kind}>{''.join(cells)}")
        self.parts.append("\n".join([*lines, "</table></div>"]))

    def chart_grid(self, charts: Iterable[dict[str, Any]]) -> None:
        lines = ["<div class=grid>"]
        for chart in charts:
            title = html.escape(chart["title"])
            lines.append(
                f'<figure data-chart="{len(self.charts)}"><figcaption>{title}</figcaption></figure>'
            )
            self.charts.append(chart)
        self.parts.append("\n".join([*lines, "</div>"]))

    def picture(self, title: str, path: Path) -> None:
        """Add a picture or a film, its bytes inside."""
        kind = _KINDS[path.suffix]
        source = f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
        alt = html.escape(title)
        shown = (
            f'<video controls loop muted playsinline src="{source}"></video>'
            if kind.startswith("video")
            else f'<img alt="{alt}" src="{source}">'
        )
        self.parts.append(f"<figure><figcaption>{alt}</figcaption>{shown}</figure>")

    def folded(self, title: str) -> None:
        self.parts.append(f"<details><summary>{html.escape(title)}</summary>")

    def unfolded(self) -> None:
        self.parts.append("</details>")

    def write(self, out: Path, title: str, subtitle: str) -> None:
        # "</" would end the script that the data stand in.
        charts = json.dumps(self.charts, separators=(",", ":")).replace("</", "<\\/")
        page = Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
            title=html.escape(title),
            subtitle=html.escape(subtitle),
            content="\n".join(self.parts),
            charts=charts,
        )
        atomic_write(out, page.encode())


def is_run(folder: Path) -> bool:
    """Whether a folder holds one run, not several."""
    return (folder / CONFIG).exists()


def write_run_report(
    folder: str | os.PathLike[str], out: str | os.PathLike[str], pictures: Mapping[str, Path]
) -> None:
    """Write a report of one run, finished or going on: curves, pictures, settings, versions.

    Args:
        folder: of the run.
        out: HTML file to create or replace.
        pictures: PNG and MP4 files by their titles.

    Raises:
        ValueError: the folder holds no run, or one that has not been validated yet, or a file of
            it is damaged.
    """
    folder, page = Path(folder), _Page()
    config, curve = read_config(folder), read_curve(folder)
    facts: list[tuple[str, Any]] = [(_STEPS, int(curve.columns["env_steps"][-1]))]
    if (folder / RESULT).exists():
        result = read_result(folder)
        rate = f"{result['success_rate']:.3f} of {result.get('episodes', '?')} episodes"
        facts = [("success in the final test", rate), (_STEPS, result["env_steps"])]
        facts.append(("minutes", result["wall_s"] / 60.0))
    else:
        facts.append(("success when last validated", float(curve.columns["success_rate"][-1])))
    if command := noted_command(folder):
        facts.append(("command", command))
    page.table(facts)
    page.heading("Curves")
    page.chart_grid(_run_charts(curve))
    if pictures:
        page.heading("Pictures")
        for title, path in pictures.items():
            page.picture(title, path)
    logged = _logged_charts(folder)
    if logged:
        page.folded("Everything that was logged")
        page.chart_grid(logged)
        page.unfolded()
    _add_settings(page, [(folder.name, folder)])
    page.write(Path(out), f"{task_label(config.env_id)}, {config.method}", f"seed {config.seed}")


def write_comparison_report(
    folder: str | os.PathLike[str], out: str | os.PathLike[str], pictures: Mapping[str, Path]
) -> None:
    """Write a report of a folder of runs: the table, a chart a task, figures, settings.

    Args:
        folder: of the results.
        out: HTML file to create or replace.
        pictures: PNG files by their titles.

    Raises:
        ValueError: the folder holds no runs, or a file of one is damaged.
    """
    folder, page = Path(folder), _Page()
    runs = read_results(folder)
    methods = ordered((), (run.method for run in runs))
    rows = [row for row in table_rows(group_runs(runs)) if row["seeds"]]
    names = ["task", "method", "seeds", "median", "q25", "q75", "env_steps", "wall_s", "status"]
    head = ["task", "method", "seeds", "median", "25%", "75%", _STEPS, "seconds", "status"]
    page.heading("Success in the final test, over seeds")
    page.table(([row[name] for name in names] for row in rows), head)
    page.heading("Success on original goals")
    page.chart_grid(_comparison_charts(runs, methods))
    if pictures:
        page.heading("Figures")
        for title, path in pictures.items():
            page.picture(title, path)
    page.folded(f"All {len(runs)} runs")
    page.table(
        ((r.folder.name, r.status, r.env_steps, r.wall_s, r.success_rate, r.error) for r in runs),
        ["run", "status", _STEPS, "seconds", "success", "error"],
    )
    page.unfolded()
    _add_settings(page, [(r.folder.name, r.folder) for r in runs if is_run(r.folder)])
    tasks = {run.task for run in runs}
    subtitle = f"{len(runs)} runs of {', '.join(methods)} on {len(tasks)} tasks"
    page.write(Path(out), f"Comparison {folder.resolve().name}", subtitle)


def _run_charts(curve: Curve) -> list[dict[str, Any]]:
    steps = curve.columns["env_steps"]
    charts = [
        _chart("success on original goals", [_line(curve.method, 0, steps, rate)], _SHARES)
        for rate in [curve.columns["success_rate"]]
    ]
    if "k_max" in curve.columns:
        charts.append(_chart("k_max", [_line("k_max", 0, steps, curve.columns["k_max"])]))
    return charts


def _comparison_charts(runs: Sequence[Run], methods: Sequence[str]) -> list[dict[str, Any]]:
    """Return a chart for each task, with a line for each method that has been validated there."""
    charts = []
    validated = [run for run in runs if is_run(run.folder) and was_validated(run.folder)]
    for group_task in dict.fromkeys(group.task for group in group_runs(runs)):
        series = []
        for number, method in enumerate(methods):
            curves, others = [], []
            for run in validated:
                if (run.task, run.method) == (group_task, method):
                    curve = read_curve(run.folder)
                    if run.status == FINISHED:
                        curves.append(curve)
                    else:
                        others.append((run, curve))
            if curves:
                points, (low, middle, high) = spread(curves, "env_steps", "success_rate")
                name = f"{method} ({len(curves)} seeds)" if len(curves) > 1 else method
                line = _line(name, number, points, middle)
                if len(curves) > 1:
                    line["band"] = _numbers(points, low, high)
                series.append(line)
            for run, curve in others:  # they would cut the median where they are
                columns = curve.columns
                name = f"{method}, seed {run.seed} ({run.status})"
                series.append(_line(name, number, columns["env_steps"], columns["success_rate"]))
        if series:
            charts.append(_chart(group_task, series, _SHARES))
    return charts


def _logged_charts(folder: Path) -> list[dict[str, Any]]:
    """Return a chart for each column of SB3's logs, which each resumption begins anew."""
    columns: dict[str, list[tuple[float, float]]] = {}
    for path in sorted(folder.glob("progress_*.csv"), key=lambda path: path.stat().st_mtime):
        for row in read_rows(path, "file of logged values"):
            for name, text in row.items():
                try:
                    point = (float(row["eval/env_steps"]), float(text))
                except (KeyError, TypeError, ValueError):  # empty, or no number
                    continue
                if np.isfinite(point).all() and name != "eval/env_steps":
                    columns.setdefault(name, []).append(point)
    charts = []
    for name, points in sorted(columns.items()):
        steps, values = np.array(points).T
        charts.append(_chart(name, [_line(name, 0, steps, values)]))
    return charts


def _add_settings(page: _Page, folders: Sequence[tuple[str, Path]]) -> None:
    """Add the settings and versions of runs, those that they share once."""
    found = {name: flat(asdict(read_config(path))) for name, path in folders}
    versions = {
        name: _read_versions(path / VERSIONS)
        for name, path in folders
        if (path / VERSIONS).exists()
    }
    for title, kept in (("Settings", found), ("Versions", versions)):
        if not kept:
            continue
        names = list(dict.fromkeys(name for values in kept.values() for name in values))
        first = next(iter(kept.values()))
        # A setting that is null is another than one that is not there.
        same = [n for n in names if all(v.get(n, "") == first.get(n, "") for v in kept.values())]
        page.folded(f"{title} that all runs share" if len(kept) > 1 else title)
        page.table((name, first.get(name, "")) for name in same)
        page.unfolded()
        others = [name for name in names if name not in same]
        if others:
            page.folded(f"{title} in which they differ")
            page.table(
                ([run, *(values.get(name, "") for name in others)] for run, values in kept.items()),
                ["run", *others],
            )
            page.unfolded()


def _read_versions(path: Path) -> dict[str, Any]:
    """Return what a run was made with, by its name.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (OSError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} does not say what the run was made with ({error})") from error


def _chart(
    title: str, series: list[dict[str, Any]], range_: tuple[float, float] | None = None
) -> dict[str, Any]:
    return {"title": title, "x": _STEPS, "range": range_, "series": series}


def _line(name: str, colour: int, x: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    return {"name": name, "colour": colour, "points": _numbers(x, y)}


def _numbers(*columns: np.ndarray) -> list[list[float]]:
    """Return rows of numbers short enough for a page."""
    return [[float(f"{value:.6g}") for value in row] for row in zip(*columns, strict=True)]


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)
