"""Tiny runs in folders, and what must be equal in two of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.runs import evaluation, experiment
from sb3_follow_object.settings.run_config import RunConfig

TASK = "FollowObject/PushSideGap-v0"
SMALL_NET: dict[str, Any] = {
    "batch_size": 16,
    "buffer_size": 2000,  # SB3's default of a million takes a second to lay out
    "gradient_steps": 2,
    "policy_kwargs": {"net_arch": [8]},
}
TINY: dict[str, Any] = {
    "n_envs": 2,
    "n_threads": 1,
    "algorithm": SMALL_NET,
    "object_algorithm": SMALL_NET,
    "object_n_envs": 4,
    "object_timesteps": 1000,
    "n_paths": 8,
    "predictor_fit": {"hidden": [8], "epochs": 1},
    "inverse_fit": {"hidden": [8], "updates": 10},
    "curriculum": {"threshold": 0.0},  # every test advances: the curriculum is exercised
    "test_every": 1,
}
WALL = ("wall_s", "command")  # what no two runs share


def evaluate_in_few_copies() -> None:
    """Let validations and final tests simulate as many copies as the tiny runs want episodes.

    The others' simulation would take more than half of a tiny run's time.
    """
    evaluation._COPIES = 4


def config(**changes: Any) -> RunConfig:
    """A run of three stages and a final test in a few seconds; it checkpoints at each rollout."""
    settings = {**TINY, **changes.pop("settings", {})}
    defaults: dict[str, Any] = {
        "env_id": TASK,
        "total_timesteps": 3600,
        "settings": settings,
        "eval_every": 700,
        "n_eval_episodes": 4,
        "n_final_episodes": 4,
        "checkpoint_minutes": 1e-9,
    }
    return RunConfig(**{**defaults, **changes})


def bare_run(env_id: str | None = None, **given: Any) -> FollowObject:
    """One with the settings' own defaults, which are quicker than a preset's."""
    return FollowObject(env_id, preset=None, **given)


def quiet(sentence: str) -> None:
    """A report that says nothing."""


def run(folder: Path, **options: Any) -> dict[str, Any]:
    """Train the tiny run in a folder."""
    return experiment.train(options.pop("config", config()), folder, report=quiet, **options)


def run_in_few_copies(folder: Path, resume: bool) -> None:
    """Train the tiny run in a folder; a process of its own begins here."""
    evaluate_in_few_copies()
    run(folder, resume=resume)


def outcome(folder: Path) -> dict[str, Any]:
    """All that must not depend on where a run was interrupted."""
    result = json.loads((folder / "result.json").read_text())
    rows = [row.split(",") for row in (folder / "evaluations.csv").read_text().splitlines()]
    wall = rows[0].index("wall_s")
    files = sorted([*folder.glob("*.safetensors"), *folder.glob("predictor/*")])
    return {
        "result": {name: value for name, value in result.items() if name not in WALL},
        "evaluations": [row[:wall] + row[wall + 1 :] for row in rows],
        **{str(file.relative_to(folder)): file.read_bytes() for file in files},
    }
