"""Collect run folders, and write the tables and figures of all that have been collected.

    python benchmarks/collect.py runs/*

A run takes the place of one of the same task, method, seed and settings in benchmarks/results, or
in benchmarks/robots/results where the environment is of others; of one of other settings with
--replace. Its configuration, versions and learning curve are copied. Seed 0 of FO and of HER with
reaching, on this package's tasks, keeps its policy, with 16 bits a weight where the final test
comes out the same, and its predictor:
`sb3-follow-object evaluate benchmarks/results/<run>` makes the test again. A run that was stopped
has no final test, and the tables say so. Runs of benchmarks/stock_sb3.py have a curve and a result.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import Any

import torch as th

from sb3_follow_object.common.array_trees import load_tree, save_tree
from sb3_follow_object.comparison.cells import file_name
from sb3_follow_object.comparison.cross import CROSS_TESTS
from sb3_follow_object.comparison.figures import draw_methods, draw_results
from sb3_follow_object.comparison.plots import draw_curves
from sb3_follow_object.comparison.results import ordered, read_results, write_tables
from sb3_follow_object.envs import TASKS
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.runs.evaluation import evaluate
from sb3_follow_object.runs.run_folder import POLICY, difference, noted_command, task_label
from sb3_follow_object.settings.methods import METHODS
from sb3_follow_object.settings.presets import load_config

HERE = Path(__file__).parent
RESULTS, DOCS = HERE / "results", HERE.parent / "docs"
OF_OTHERS = HERE / "robots" / "results"  # runs on environments that need not be installed
README = HERE.parent / "README.md"
BEGIN, END = "<!-- results: python benchmarks/collect.py -->\n", "<!-- end of results -->"
STEPS = ("env_steps", "object_steps", "test_steps")
COLUMNS = ("task", "method", "seed", *STEPS)
COLUMNS += ("wall_s", "success_rate", "episodes", "command", "commit")
KEPT = ("config.json", "result.json", "versions.json", "evaluations.csv", CROSS_TESTS)
WITH_POLICY = ("fo", "rher")
PREDICTOR = "predictor"
ENOUGH = 0.9
NAMES = {
    "fo": "FO",
    "her": "HER",
    "rher": "HER + reaching",
    "shaped": "Shaped",
    "fo-sldr": "FO + SLDR",
}
# The curves of the docs, of all seeds.
FEATURED = {"PnPSimpleV2": "pnp-simple-v2.png", "PnPShelf": "pnp-shelf.png"}
COMPARED = ("fo", "rher", "her")

Row = dict[str, Any]


def read_row(run: Path) -> Row:
    """Return what a run came to; one that was stopped has no success_rate."""
    versions = json.loads((run / "versions.json").read_text())
    row: Row = {"commit": versions["commit"], "validations": read_validations(run)}
    if (run / "config.json").exists():
        config = json.loads((run / "config.json").read_text())
        row |= {"task": task_label(config["env_id"]), "command": noted_command(run)}
        row |= {name: config[name] for name in ("method", "seed")}
    if (run / "result.json").exists():
        result = json.loads((run / "result.json").read_text())
        row |= {**result, "task": row.get("task", result["task"])}  # stock runs have no config.json
    elif row["validations"]:
        row |= {k: row["validations"][-1].get(k) for k in ("env_steps", "object_steps", "wall_s")}
    if "task" not in row:
        raise ValueError(f"{run} has neither config.json nor result.json: it was broken off")
    return {**row, "task": row["task"].rpartition(":")[2]}


def read_validations(run: Path) -> list[dict[str, float]]:
    """Return the rows of a run's learning curve."""
    if not (run / "evaluations.csv").exists():
        return []
    with open(run / "evaluations.csv", newline="") as file:
        return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]


def folder_of(row: Row) -> Path:
    """Return where a run is kept."""
    folder = RESULTS if row["task"] in TASKS else OF_OTHERS
    return folder / f"{file_name(row['task'])}-{row['method']}-{row['seed']}"


def keep(run: Path, replace: bool) -> None:
    """Copy what plotting a run, and of some runs evaluating it, takes.

    Raises:
        ValueError: it is no run or has not been validated, or is one of other settings than the
            one in its place, or unfinished in place of a finished one (without `replace`).
    """
    if not (run / "versions.json").exists():
        raise ValueError(f"{run} is no run folder: it has no versions.json")
    row = read_row(run)
    if not row["validations"]:
        raise ValueError(f"{run} has not been validated yet")
    target = folder_of(row)
    if run.resolve() == target.resolve():
        return  # it is here already
    if target.exists() and not replace:
        check_alike(run, row, target)
    fresh = target.with_name(f".{target.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    for name in KEPT:
        if (run / name).exists():
            shutil.copyfile(run / name, fresh / name)
    if "success_rate" not in row:
        (fresh / "command.txt").write_text(f"{row['command']}\n")
    elif row["method"] in WITH_POLICY and row["seed"] == 0 and row["task"] in TASKS:
        keep_policy(run, fresh, row)
    shutil.rmtree(target, ignore_errors=True)
    fresh.rename(target)


def check_alike(run: Path, row: Row, target: Path) -> None:
    """Raise a ValueError where a run should not take the place of the one that is kept."""
    if "success_rate" not in row and "success_rate" in read_row(target):
        raise ValueError(
            f"{run} was stopped, and {target} was not; --replace takes it all the same"
        )
    if not (run / "config.json").exists() or not (target / "config.json").exists():
        return
    settings = [asdict(load_config(folder)) for folder in (target, run)]
    different = difference(*settings)
    if different is not None:
        name, kept, new = different
        raise ValueError(
            f"{run} has {name} {new!r}, and {target} {kept!r}; --replace takes it all the same"
        )


def keep_policy(run: Path, target: Path, row: Row) -> None:
    """Copy policy and predictor, with 16 bits a weight unless the policy's test then differs."""
    save_tree(target / POLICY, halved(load_tree(run / POLICY)))
    env_id = load_config(run).env_id
    tested = evaluate(target / POLICY, env_id, row["episodes"], row["seed"])
    if tested.success_rate != row["success_rate"]:
        print(f"{run.name}: with 16 bits a weight {tested.success_rate:.4f}; kept with 32")
        shutil.copyfile(run / POLICY, target / POLICY)
    if (run / PREDICTOR).exists():
        GoalPredictor.load(run / PREDICTOR).save(target / PREDICTOR, half=True)


def halved(tree: Any) -> Any:
    """Return a tree whose weights have 16 bits."""
    if isinstance(tree, dict):
        return {name: halved(value) for name, value in tree.items()}
    return tree.half() if isinstance(tree, th.Tensor) and tree.dtype == th.float32 else tree


def first_good(row: Row) -> dict[str, float] | None:
    """Return the first validation that is good enough."""
    return next((v for v in row["validations"] if v["success_rate"] >= ENOUGH), None)


def reached(rows: Iterable[Row], column: str) -> float | None:
    """Return the median over runs of env_steps or wall_s at 0.9; None if half did not get there."""
    found = [(first_good(row) or {}).get(column, float("inf")) for row in rows]
    middle = median(found)
    return None if middle == float("inf") else middle


def steps_and_minutes(rows: list[Row]) -> tuple[str, str]:
    """Return after how many env steps and minutes 0.9 succeeded, in words."""
    steps, seconds = reached(rows, "env_steps"), reached(rows, "wall_s")
    return (
        "not yet" if steps is None else f"{steps:,.0f}",
        "" if seconds is None else f"{seconds / 60:.0f}",
    )


def span(rates: list[float]) -> str:
    """Return the lowest and the highest of some rates, in words."""
    ends = sorted({f"{min(rates):.2f}", f"{max(rates):.2f}"})
    return " to ".join(ends)


def in_the_end(rows: list[Row]) -> str:
    """Return the final success of several seeds, in words."""
    final = [row["success_rate"] for row in rows if "success_rate" in row]
    stopped = [row["validations"][-1] for row in rows if "success_rate" not in row]
    said = []
    if final:
        ends = span(final)
        spread = f" ({ends})" if " to " in ends else ""
        said = [f"{median(final):.2f}{spread}"]
    if stopped:
        rates = span([v["success_rate"] for v in stopped])
        how_many = f"{len(stopped)} " if len(rows) > 1 else ""
        said += [f"{rates} of {stopped[0]['episodes']:.0f}, {how_many}stopped"]
    return "; ".join(said)


def end_and_cost(rows: list[Row]) -> tuple[str, str, str]:
    """Return the final success of several seeds, and after how many env steps and minutes."""
    steps, seconds = (median(float(row[name]) for row in rows) for name in ("env_steps", "wall_s"))
    return in_the_end(rows), f"{steps:,.0f}", f"{seconds / 60:.0f}"


def name_of(method: str) -> str:
    """Return a method's name in the tables."""
    return NAMES.get(method, method.upper())


def seeds(rows: list[Row]) -> str:
    """Return the seeds of several runs."""
    return ", ".join(str(row["seed"]) for row in rows)


def table(head: tuple[str, ...], lines: Iterable[tuple[str, ...]]) -> str:
    """Return a table in Markdown."""
    rows = (head, ("---",) * len(head), *lines)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def groups(rows: list[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return the runs of each task and method."""
    return {key: list(found) for key, found in groupby(rows, lambda r: (r["task"], r["method"]))}


def small_table(rows: list[Row]) -> str:
    """Return README's table, a line a task."""
    head = ("task", "FO: 0.9 after env steps", "minutes", "seeds")
    lines = []
    for task in TASKS:
        found = groups(rows)
        fo = found.get((task, "fo"), [])
        of_fo = (*steps_and_minutes(fo), seeds(fo)) if fo else ("not run", "", "")
        ends = (in_the_end(found.get((task, method), [])) or "not run" for method in COMPARED)
        lines.append((task, *of_fo, *ends))
    return table((*head, *(f"{NAMES[m]} in the end" for m in COMPARED)), lines)


def full_table(rows: list[Row]) -> str:
    """Return the table of docs/results.md, a line a task and method."""
    head = ("task", "method", "seeds", "0.9 after env steps", "minutes", "in the end")
    lines = [
        (task, name_of(method), seeds(runs), *steps_and_minutes(runs), *end_and_cost(runs))
        for (task, method), runs in groups(rows).items()
        if task in TASKS
    ]
    return table((*head, "at env steps", "and minutes"), lines)


def reaching_table(rows: list[Row]) -> str:
    """Return the table of docs/reaching.md: what imagined goals add to reaching, task by task."""
    found = groups(rows)
    lines = []
    for task in TASKS:
        of_task = {m: found[task, m] for m in COMPARED if (task, m) in found}
        if len(of_task) < 2:
            continue
        cells = []
        for method in COMPARED:
            runs = of_task.get(method)
            after = reached(runs, "env_steps") if runs else None
            steps = f", 0.9 after {after:,.0f}" if after is not None else ""
            cells.append(f"{in_the_end(runs)}{steps}" if runs else "not run")
        of_fo = [float(row["env_steps"]) for row in of_task.get("fo", ())]
        lines.append((task, f"{median(of_fo):,.0f}" if of_fo else "not run", *cells))
    return table(("task", "env steps of FO", *(NAMES[m] for m in COMPARED)), lines)


def robots_table(rows: list[Row]) -> str:
    """Return the table of docs/robots.md, a line a run of an environment of others."""
    head = ("task", "method", "seed", "0.9 after env steps", "minutes", "in the end")
    lines = []
    for row in rows:
        if row["task"] not in TASKS:
            who = (row["task"], name_of(row["method"]), seeds([row]))
            figures = (*steps_and_minutes([row]), *end_and_cost([row]))
            lines.append((*who, *figures, (row["commit"] or "")[:7]))
    return table((*head, "at env steps", "and minutes", "commit"), lines)


PAGES: dict[Path, Callable[[list[Row]], str]] = {
    README: small_table,
    DOCS / "results.md": full_table,
    DOCS / "reaching.md": reaching_table,
    DOCS / "robots.md": robots_table,
}


def with_table(text: str, written: str) -> str:
    """Return a page with the table between its marks written anew."""
    head, rest = text.split(BEGIN)
    return head + BEGIN + written + END + rest.split(END)[1]


def read_rows() -> list[Row]:
    """Return all runs that are kept: this package's tasks first, in their order."""
    kept = [*RESULTS.glob("*/versions.json"), *OF_OTHERS.glob("*/versions.json")]
    # Names that begin with a dot are of copies that were broken off.
    rows = [read_row(file.parent) for file in kept if not file.parent.name.startswith(".")]
    tasks = ordered(TASKS, (row["task"] for row in rows))
    return sorted(rows, key=lambda row: (tasks.index(row["task"]), row["method"], row["seed"]))


def write_summary(rows: list[Row]) -> None:
    """Write a line a run; one that was stopped has no success_rate."""
    with open(RESULTS / "summary.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n", extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            numbers = {
                k: int(row[k]) for k in ("env_steps", "object_steps", "test_steps") if row.get(k)
            }
            rate = {"success_rate": round(row["success_rate"], 4)} if "success_rate" in row else {}
            writer.writerow({**row, **numbers, **rate})


def draw(rows: list[Row]) -> None:
    """Write the tables of `compare`, its figures and the curves of the docs."""
    write_tables(read_results(RESULTS), RESULTS)
    ran = {row["method"] for row in rows if row["task"] in TASKS}
    draw_results(RESULTS, RESULTS / "figures", [method for method in METHODS if method in ran])
    if len(ran & {*COMPARED}) > 1:
        compared = [method for method in METHODS if method in COMPARED]  # colours as elsewhere
        draw_methods(RESULTS, RESULTS / "figures" / "reaching.png", compared)
    for task, name in FEATURED.items():
        wanted = [row for row in rows if row["task"] == task and row["method"] in COMPARED]
        draw_curves([folder_of(row) for row in wanted], RESULTS / name)


def main() -> None:
    """Collect the runs named on the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="run folders")
    parser.add_argument(
        "--replace", action="store_true", help="take runs of other settings, and stopped ones"
    )
    options = parser.parse_args()
    RESULTS.mkdir(exist_ok=True)
    try:
        for run in options.runs:
            keep(run, options.replace)
    except ValueError as error:
        parser.error(str(error))
    rows = read_rows()
    write_summary(rows)
    for page, text in PAGES.items():
        page.write_text(with_table(page.read_text(), text(rows)))
    draw(rows)
    print(f"{len(rows)} runs in {RESULTS}")


if __name__ == "__main__":
    main()
