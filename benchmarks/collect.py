"""Collect finished run folders into benchmarks/results: one row and two small files a run.

    python benchmarks/collect.py runs/*

A run takes the place of one of the same task, method and seed. Its policy, configuration, versions
and learning curve are copied: `sb3-follow-object evaluate benchmarks/results/<run>` tests it again;
runs of benchmarks/stock_sb3.py have no policy file. Everything else is made of the copied
runs: summary.csv, the table of docs/results.md (medians over seeds), the figures.
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
from sb3_follow_object.comparison.figures import draw_results
from sb3_follow_object.comparison.plots import draw_curves
from sb3_follow_object.comparison.results import read_results, write_tables

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[1] / "docs" / "results.md"
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
# The curves of docs/results.md, of all seeds of FO and HER.
FEATURED = {"PnPSimpleV2": "pnp-simple-v2.png", "PnPShelf": "pnp-shelf.png"}
FO_AND_HER = ("fo", "her")
KEPT = ("config.json", "result.json", "versions.json", "evaluations.csv", "policy.safetensors")


def read_row(run: Path) -> dict[str, str]:
    """Return a finished run's row of summary.csv."""
    result = json.loads((run / "result.json").read_text())
    versions = json.loads((run / "versions.json").read_text())
    result["commit"] = versions["commit"]
    result["success_rate"] = round(result["success_rate"], 4)
    return {column: str(result[column]) for column in COLUMNS}


def keep_files(run: Path) -> None:
    """Copy what evaluating and plotting a run again needs."""
    row = read_row(run)
    target = RESULTS / f"{row['task']}-{row['method']}-{row['seed']}"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for name in (*KEPT, CROSS_TESTS):
        if (run / name).exists():
            shutil.copyfile(run / name, target / name)


Rows = list[dict[str, str]]


def middle(rows: Rows, column: str) -> float:
    """Return a column's median over seeds."""
    return median(float(row[column]) for row in rows)


def full_table(rows: Rows) -> str:
    """Return the results as a Markdown table, a line for each task and method."""
    lines = [
        "| task | method | seeds | env steps | minutes | success |",
        "|---|---|---|---|---|---|",
    ]
    for (task, method), group in groupby(rows, key=lambda row: (row["task"], row["method"])):
        runs = list(group)
        seeds = ", ".join(row["seed"] for row in runs)
        steps, minutes = middle(runs, "env_steps"), middle(runs, "wall_s") / 60
        success = f"{middle(runs, 'success_rate'):.2f}"
        cells = (task, method.upper(), seeds, f"{steps:,.0f}", f"{minutes:.0f}", success)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def with_table(text: str, table: str) -> str:
    """Return a page with the table between its marks written anew."""
    head, rest = text.split(BEGIN)
    return head + BEGIN + table + END + rest.split(END)[1]


def write_page(rows: Rows) -> None:
    """Write the table of the docs."""
    PAGE.write_text(with_table(PAGE.read_text(), full_table(rows)))


def main() -> None:
    """Collect the runs named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, help="finished run folders")
    runs = parser.parse_args().runs
    RESULTS.mkdir(exist_ok=True)
    for run in runs:
        if (run / "result.json").exists():
            keep_files(run)
        else:
            print(f"{run}: not finished, left out")
    ordered = sorted(
        (read_row(file.parent) for file in RESULTS.glob("*/result.json")),
        key=lambda row: (row["task"], row["method"], row["seed"]),
    )
    summary = RESULTS / "summary.csv"
    with open(summary, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(ordered)
    write_tables(read_results(RESULTS), RESULTS)
    draw_results(RESULTS, RESULTS / "figures")
    for task, name in FEATURED.items():
        wanted = [row for row in ordered if row["task"] == task and row["method"] in FO_AND_HER]
        folders = [RESULTS / "-".join((r["task"], r["method"], r["seed"])) for r in wanted]
        draw_curves(folders, RESULTS / name)
    write_page(ordered)
    print(f"{len(ordered)} rows in {summary}")


if __name__ == "__main__":
    main()
