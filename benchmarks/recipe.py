"""Keep what runs of the default preset came to, finished or not: a curve and a row each.

    python benchmarks/recipe.py runs/*

A run takes the place of one of the same task, method and seed in benchmarks/recipe. The tables of
README and of docs/reaching.md are made of all that are there, beside FO and HER as they were before
0.2.0 (benchmarks/results), and that of docs/robots.md of those on environments of others.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from pathlib import Path
from statistics import median
from typing import Any

from sb3_follow_object.envs import TASKS

HERE = Path(__file__).parent
KEPT, BEFORE = HERE / "recipe", HERE / "results"
README, DOCS = HERE.parent / "README.md", HERE.parent / "docs"
PAGE, ROBOTS = DOCS / "reaching.md", DOCS / "robots.md"
BEGIN, END = "<!-- recipe: python benchmarks/recipe.py -->\n", "<!-- end of recipe -->"
ENOUGH = 0.9
STOPPED = "stopped before its end; no final test"


def name_of(row: dict[str, Any]) -> str:
    """Return the name of a run's curve."""
    return f"{row['task'].replace('/', '-')}-{row['method']}-{row['seed']}"


def validations(file: Path) -> list[dict[str, str]]:
    """Return the rows of an evaluations.csv."""
    with open(file, newline="") as lines:
        return list(csv.DictReader(lines))


def first_good(file: Path) -> dict[str, str] | None:
    """Return the first validation that is good enough."""
    return next((v for v in validations(file) if float(v["success_rate"]) >= ENOUGH), None)


def read_row(run: Path) -> dict[str, Any]:
    """Return what is kept of a run besides its curve."""
    config = json.loads((run / "config.json").read_text())
    task = config["env_id"].rpartition(":")[2].removeprefix("FollowObject/").removesuffix("-v0")
    row = {"task": task, "method": config["method"], "seed": config["seed"]}
    if (run / "result.json").exists():
        row |= json.loads((run / "result.json").read_text())
    else:
        last = validations(run / "evaluations.csv")[-1]
        row |= {"env_steps": int(last["env_steps"]), "stopped": STOPPED}
        row |= {"command": (run / "command.txt").read_text().strip()}
    return {**row, "task": task, "versions": json.loads((run / "versions.json").read_text())}


def keep(runs: list[Path]) -> list[dict[str, Any]]:
    """Copy the runs' curves and return the rows of all that are kept."""
    KEPT.mkdir(exist_ok=True)
    file = KEPT / "runs.json"
    rows = {name_of(r): r for r in json.loads(file.read_text())} if file.exists() else {}
    for run in runs:
        row = read_row(run)
        shutil.copyfile(run / "evaluations.csv", KEPT / f"{name_of(row)}.csv")
        rows[name_of(row)] = row
    ordered = [rows[name] for name in sorted(rows)]
    file.write_text(json.dumps(ordered, indent=1) + "\n")
    return ordered


def there(good: dict[str, str] | None) -> tuple[str, str]:
    """Return env steps and minutes to a validation, in words."""
    if good is None:
        return "not yet", ""
    return f"{int(good['env_steps']):,}", f"{float(good['wall_s']) / 60:.0f}"


def in_the_end(row: dict[str, Any]) -> str:
    """Return what a run ended with, in words."""
    if "stopped" in row:
        last = validations(KEPT / f"{name_of(row)}.csv")[-1]
        rate = float(last["success_rate"])
        return f"{rate:.2f} of {last['episodes']} when stopped, at {row['env_steps']:,}"
    itself = ", solved" if row.get("solved") else ""
    return f"{row['success_rate']:.2f} at {row['env_steps']:,}{itself}"


def is_before(run: Path) -> bool:
    """Whether a run is one of before 0.2.0."""
    versions = json.loads((run / "versions.json").read_text())
    return bool(versions["sb3-follow-object"] == "0.1.0")


def earlier(task: str) -> str:
    """Return after how many env steps FO was good enough before 0.2.0, seed by seed."""
    runs = (run for run in sorted(BEFORE.glob(f"{task}-fo-[0-9]*")) if is_before(run))
    found = [first_good(run / "evaluations.csv") for run in runs]
    return ", ".join(f"{int(good['env_steps']):,}" for good in found if good)


def her(task: str) -> str:
    """Return HER's final success before 0.2.0, the median of its seeds."""
    results = [json.loads(f.read_text()) for f in BEFORE.glob(f"{task}-her-[0-9]*/result.json")]
    return f"{median(r['success_rate'] for r in results):.2f}" if results else "not run"


def small_table(rows: list[dict[str, Any]]) -> str:
    """Return README's table, a line a task: seed 0 of FO."""
    head = ("task", "0.9 after env steps", "minutes", "FO in the end", "FO before 0.2.0", "HER")
    lines = []
    for task in TASKS:
        found = [r for r in rows if (r["task"], r["method"], r["seed"]) == (task, "fo", 0)]
        steps, minutes, end = "not run", "", ""
        if found:
            steps, minutes = there(first_good(KEPT / f"{name_of(found[0])}.csv"))
            rate = found[0].get("success_rate")
            end = "stopped" if rate is None else f"{rate:.2f}"
        lines.append((task, steps, minutes, end, earlier(task), her(task)))
    return table(head, lines)


def run_cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Return what a table says of a run."""
    steps, minutes = there(first_good(KEPT / f"{name_of(row)}.csv"))
    commit = str(row["versions"]["commit"])[:7]
    who = (row["task"], row["method"].upper(), str(row["seed"]))
    return (*who, steps, minutes, in_the_end(row), commit)


def table(head: tuple[str, ...], lines: list[tuple[str, ...]]) -> str:
    """Return a table in Markdown."""
    rows = (head, ("---",) * len(head), *lines)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


HEAD = ("task", "method", "seed", "0.9 after env steps", "minutes", "in the end", "commit")


def full_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of docs/reaching.md, a line a run of the package's own tasks."""
    own = [row for row in rows if row["task"] in TASKS]
    lines = [(*run_cells(row), earlier(row["task"])) for row in own]
    return table((*HEAD, "0.9 before 0.2.0"), lines)


def robots_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of docs/robots.md, a line a run of an environment of others."""
    return table(HEAD, [run_cells(row) for row in rows if row["task"] not in TASKS])


def tables(rows: list[dict[str, Any]]) -> dict[Path, str]:
    """Return the table of each page."""
    return {README: small_table(rows), PAGE: full_table(rows), ROBOTS: robots_table(rows)}


def with_table(text: str, written: str) -> str:
    """Return a page with the table between its marks written anew."""
    head, rest = text.split(BEGIN)
    return head + BEGIN + written + END + rest.split(END)[1]


def main() -> None:
    """Keep the runs named on the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="run folders")
    rows = keep(parser.parse_args().runs)
    for page, text in tables(rows).items():
        page.write_text(with_table(page.read_text(), text))
    print(f"{len(rows)} runs in {KEPT}")


if __name__ == "__main__":
    main()
