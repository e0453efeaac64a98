"""Every method as a run: it trains from its preset, logs what is its own, and resumes exactly."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from sb3_follow_object.config import run_config
from sb3_follow_object.experiment import RunConfig, train

TASK = "FollowObject/PushSideGap-v0"
TINY: dict[str, Any] = {
    "n_envs": 2,
    "n_threads": 1,
    "n_timesteps": 800,
    "eval_every": 300,
    "n_eval_episodes": 2,
    "n_final_episodes": 2,
    "batch_size": 16,
    "buffer_size": 2000,
    "gradient_steps": 2,
    "learning_starts": 0,
    "policy_kwargs.net_arch": [16],
    "checkpoint_minutes": 1e-9,
}
# What a method adds to the log of a run.
LOGGED = {
    "shaped": {"train/reward_mean"},
    "rnd": {"rnd/reward", "rnd/q_mean", "rnd/critic_loss"},
    "cher": {"cher/proximity_weight"},
}


def tiny_run(method: str) -> RunConfig:
    return run_config(TASK, method=method, overrides=TINY)


def quiet(sentence: str) -> None:
    pass


def logged(folder: Path) -> list[dict[str, str]]:
    rows: list[dict[str, str]] = []
    for file in sorted(folder.glob("progress_*.csv")):
        with open(file, newline="") as lines:
            rows += csv.DictReader(lines)
    return rows


@pytest.mark.parametrize("method", LOGGED)
def test_trains_logs_and_resumes_exactly(method: str, tmp_path: Path) -> None:
    config = tiny_run(method)
    whole = train(config, tmp_path / "whole", report=quiet)
    assert (whole["method"], whole["env_steps"]) == (method, 800)
    rows = logged(tmp_path / "whole")
    for name in LOGGED[method]:
        assert rows and all(row[name] for row in rows)
    if method == "shaped":  # metres, not -1 or 0
        assert all(-0.9 < float(row["train/reward_mean"]) < 0.0 for row in rows)

    def interrupt(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 400:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "part", report=quiet, progress=interrupt)
    train(config, tmp_path / "part", resume=True, report=quiet)
    policies = [(tmp_path / run / "last_policy.safetensors").read_bytes() for run in RUNS]
    assert policies[0] == policies[1]
    assert logged(tmp_path / "part")[-1] == rows[-1]


RUNS = ("whole", "part")
