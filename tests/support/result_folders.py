"""Folders of runs that nobody trained."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.runs.run_folder import CONFIG, EVALUATIONS, RESULT
from sb3_follow_object.settings.run_config import RunConfig


def finish(run: Path, success: float = 0.5, env_steps: int = 1000) -> None:
    """Give a run's folder its result."""
    result = {"env_steps": env_steps, "wall_s": 60.0, "success_rate": success, "episodes": 8}
    (run / RESULT).write_text(json.dumps(result))


def write_run(
    folder: Path,
    task: str,
    method: str,
    seed: int,
    success: float | None = None,
    curve: tuple[float, ...] = (0.1, 0.2, 0.4),
    **settings: Any,
) -> Path:
    """Write a run with a learning curve; it is finished where it has a final success."""
    run = folder / f"{task}-{method}-{seed}"
    run.mkdir(parents=True)
    config = RunConfig(f"FollowObject/{task}-v0", method, seed, settings=settings)
    (run / CONFIG).write_text(json.dumps(asdict(config)))
    rows = [",".join(OriginalGoalEvalCallback.COLUMNS)]
    for i, rate in enumerate(curve, start=1):
        rows.append(f"{300 * i},{300 * i},0,0,{20.0 * i},{rate},-1.0,8,")
    (run / EVALUATIONS).write_text("\n".join(rows) + "\n")
    if success is not None:
        finish(run, success)
    return run


def write_grid(folder: Path, cells: dict[str, dict[str, Any]]) -> None:
    """Write a grid file that names cells, e.g. {"PnPShelf-fo-0": {"failures": 2, "error": "x"}}."""
    rows = {}
    for name, entry in cells.items():
        task, method, seed = name.rsplit("-", 2)
        place = {"task": task, "method": method, "seed": int(seed)}
        rows[name] = {**place, "failures": 0, "error": None, **entry}
    content = {"format": 1, "steps": None, "preset": "default", "set": {}, "cells": rows}
    (folder / "grid.json").write_text(json.dumps(content))
