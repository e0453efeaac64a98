"""Collect finished run folders into benchmarks/results: one row and two small files a run.

    python benchmarks/collect.py runs/*

A row of summary.csv is replaced by a run of the same task, method and seed. Each run's policy,
predictor, configuration, versions and learning curve are copied beside it, so that
`sb3-follow-object evaluate benchmarks/results/<run>` tests it again. README's table is drawn from
summary.csv: medians over seeds. Its figures, the paper's figures and the tables of final success
are drawn from the copied runs.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from itertools import groupby
from pathlib import Path
from statistics import median

from sb3_follow_object.comparison.cross import CROSS_TESTS
from sb3_follow_object.comparison.figures import FINAL_SUCCESS, draw_results
from sb3_follow_object.comparison.plots import draw_curves
from sb3_follow_object.comparison.results import read_results, write_tables

RESULTS = Path(__file__).parent / "results"
README = Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- results: python benchmarks/collect.py -->\n", "<!-- end of results -->"
COLUMNS = (
    "task",
    "method",
    "seed",
    "env_steps",
    "object_steps",
    "test_steps",
    "wall_s",
    "success_rate",
    "episodes",
    "command",
    "commit",
)
FIGURE = (
    "\n![Final success of every method on every task; hatched where there is none]"
    f"(benchmarks/results/figures/{FINAL_SUCCESS})\n"
)
# README's curves, of all seeds of FO and HER.
FEATURED = {"PnPSimpleV2": "pnp-simple-v2.png", "PnPShelf": "pnp-shelf.png"}
KEPT = ("config.json", "result.json", "versions.json", "evaluations.csv", "policy.safetensors")


def read_row(run: Path) -> dict[str, str]:
    """Return a finished run's row of summary.csv."""
    result = json.loads((run / "result.json").read_text())
    versions = json.loads((run / "versions.json").read_text())
    result["commit"] = versions["commit"]
    result["success_rate"] = round(result["success_rate"], 4)
    return {column: str(result[column]) for column in COLUMNS}


def keep_files(run: Path, row: dict[str, str]) -> None:
    """Copy what evaluating and plotting the run again needs."""
    target = RESULTS / f"{row['task']}-{row['method']}-{row['seed']}"
    target.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        shutil.copyfile(run / name, target / name)
    if (run / CROSS_TESTS).exists():
        shutil.copyfile(run / CROSS_TESTS, target / CROSS_TESTS)
    if (run / "predictor").exists():
        shutil.copytree(run / "predictor", target / "predictor", dirs_exist_ok=True)


def table(rows: list[dict[str, str]]) -> str:
    """Return the results as a Markdown table, a line for each task and method."""
    lines = [
        "| task | method | seeds | env steps | minutes | success |",
        "|---|---|---|---|---|---|",
    ]
    for (task, method), group in groupby(rows, key=lambda row: (row["task"], row["method"])):
        runs = list(group)
        seeds = ", ".join(row["seed"] for row in runs)
        steps, seconds, rate = (
            median(float(row[name]) for row in runs)
            for name in ("env_steps", "wall_s", "success_rate")
        )
        cells = (task, method.upper(), seeds, f"{steps:,.0f}", f"{seconds / 60:.0f}", f"{rate:.2f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Collect the runs named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, help="finished run folders")
    runs = parser.parse_args().runs
    RESULTS.mkdir(exist_ok=True)
    summary = RESULTS / "summary.csv"
    rows: dict[tuple[str, ...], dict[str, str]] = {}
    if summary.exists():
        with open(summary, newline="") as file:
            rows = {(r["task"], r["method"], r["seed"]): r for r in csv.DictReader(file)}
    for run in runs:
        if not (run / "result.json").exists():
            print(f"{run}: not finished, left out")
            continue
        row = read_row(run)
        keep_files(run, row)
        rows[row["task"], row["method"], row["seed"]] = row
    with open(summary, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(ordered := [rows[key] for key in sorted(rows)])
    write_tables(read_results(RESULTS), RESULTS)
    draw_results(RESULTS, RESULTS / "figures")
    for task, name in FEATURED.items():
        wanted = [key for key in sorted(rows) if key[0] == task and key[1] in ("fo", "her")]
        draw_curves([RESULTS / "-".join(key) for key in wanted], RESULTS / name)
    text = README.read_text()
    head, rest = text.split(BEGIN)
    README.write_text(head + BEGIN + table(ordered) + FIGURE + END + rest.split(END)[1])
    print(f"{len(rows)} rows in {summary}")


if __name__ == "__main__":
    main()
