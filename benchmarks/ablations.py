"""Collect runs that differ from the default preset in a setting or two into one table.

    python benchmarks/ablations.py runs/ab-*

Writes benchmarks/ablations.csv, where a row of the same task, method, seed and setting is replaced
and the others stay: a row a run with what differs, when the curriculum passed each
fifth of its levels, when 0.9 of the validation episodes first succeeded, and the final test. Prints
it as Markdown. Runs need not be finished: the final test is then empty.
"""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym

import sb3_follow_object.envs  # noqa: F401  (registers the ids)
from sb3_follow_object.settings.presets import run_config
from sb3_follow_object.settings.run_config import flat

OUT = Path(__file__).with_name("ablations.csv")
# What does not change what is learned, or is a column of its own.
LIMITS = {"total_timesteps", "settings.n_threads", "seed", "checkpoint_minutes"}
LIMITS |= {"keep_checkpoints", "keep_last_checkpoint", "torch_threads"}


def difference(config: dict[str, Any]) -> str:
    """Say what a run's settings change in the default preset of its method."""
    default = run_config(config["env_id"], method=config["method"], seed=config["seed"])
    ours, theirs = flat(config), flat(json.loads(json.dumps(asdict(default))))
    changed = [
        f"{name.removeprefix('settings.').removeprefix('algorithm.')}={ours.get(name, 'unset')}"
        for name in sorted({*ours, *theirs} - LIMITS)
        if ours.get(name) != theirs.get(name)
    ]
    return ", ".join(changed) or "default"


def read_row(run: Path) -> dict[str, Any]:
    """Return a run's row."""
    config = json.loads((run / "config.json").read_text())
    rows = []
    if (run / "evaluations.csv").exists():  # not before the first validation
        with open(run / "evaluations.csv", newline="") as file:
            rows = list(csv.DictReader(file))

    def first(column: str, value: float) -> str:
        hits = (row["env_steps"] for row in rows if row[column] and float(row[column]) >= value)
        return next(hits, "")

    result = {}
    if (run / "result.json").exists():
        result = json.loads((run / "result.json").read_text())
    curriculum = config["settings"].get("curriculum") or {}
    levels = curriculum.get("n_levels", 25)
    if curriculum.get("levels") != "path":
        levels = gym.spec(config["env_id"]).max_episode_steps or 50
    return {
        "task": config["env_id"].removeprefix("FollowObject/").removesuffix("-v0"),
        "method": config["method"],
        "seed": str(config["seed"]),
        "setting": difference(config),
        **{f"k_{share}": first("k_max", share / 100 * levels) for share in (20, 40, 60, 80, 100)},
        "validated_0.9": first("success_rate", 0.9),
        "last_steps": rows[-1]["env_steps"] if rows else "",
        "last_validation": rows[-1]["success_rate"] if rows else "",
        "success_rate": result.get("success_rate", ""),
        "commit": json.loads((run / "versions.json").read_text())["commit"],
    }


def main() -> None:
    """Collect the runs named on the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    kept: list[dict[str, Any]] = []
    if OUT.exists():
        with open(OUT, newline="") as file:
            kept = [{"task": row["task"], "method": "fo", **row} for row in csv.DictReader(file)]
    kept += [read_row(run) for run in parser.parse_args().runs]
    by_run = {
        tuple(row[name] for name in ("task", "method", "setting", "seed")): row for row in kept
    }
    rows = sorted(
        by_run.values(),
        key=lambda row: (
            row["task"],
            row["method"],
            row["setting"] != "default",
            row["setting"],
            row["seed"],
        ),
    )
    with open(OUT, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    shown = [name for name in rows[0] if name != "commit"]
    print("| " + " | ".join(shown) + " |\n" + "|---" * len(shown) + "|")
    for row in rows:
        print("| " + " | ".join(str(row[name]) for name in shown) + " |")


if __name__ == "__main__":
    main()
