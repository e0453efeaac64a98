"""Every method as a run: it trains from its preset, logs what is its own, and resumes exactly."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sb3_follow_object.comparison.cells import needs_object_stage, stage_settings
from sb3_follow_object.object_stage.networks import FILE, ObjectNetworks
from sb3_follow_object.runs.checkpoints import checkpoint_files
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.runs.object_stage_files import OBJECT_STAGE
from sb3_follow_object.runs.run_folder import claim
from sb3_follow_object.settings.presets import run_config
from sb3_follow_object.settings.run_config import RunConfig

TASK = "FollowObject/PushSideGap-v0"
ROBOT_STEPS = 800
TINY: dict[str, Any] = {
    "n_envs": 2,
    "n_threads": 1,
    "n_timesteps": ROBOT_STEPS,
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
TINY_STAGES: dict[str, Any] = {
    "object_timesteps": 800,
    "object_n_envs": 8,
    "object_algorithm.policy_kwargs.net_arch": [16],
    "object_algorithm.batch_size": 16,
    "object_algorithm.buffer_size": 1000,
    "object_algorithm.gradient_steps": 1,
    "n_paths": 8,
    "predictor_fit.hidden": [8],
    "predictor_fit.epochs": 1,
    "inverse_fit.hidden": [8],
    "inverse_fit.updates": 20,
    "n_test_episodes": 2,
}
TINY_REACHING: dict[str, Any] = {"reach.n_updates": 3, "reach.batch_size": 16}
RUNS = ("whole", "part")
# What a method adds to the log of a run.
LOGGED = {
    "shaped": {"train/reward_mean"},
    "rnd": {"rnd/reward", "rnd/q_mean", "rnd/critic_loss"},
    "cher": {"cher/proximity_weight"},
    "sldr": {"sldr/reward", "sldr/q_mean", "sldr/critic_loss"},
    "fo-sldr": {"sldr/reward", "curriculum/k_max"},
    "rher": {"reach/share", "reach/success", "reach/own_success"},
}
# The object's 800 end with their second rollout, before any test; F_phi needs 8 paths of T steps.
OBJECT_STEPS = {"sldr": 800, "fo-sldr": 800 + 8 * 50}


def tiny_run(method: str) -> RunConfig:
    overrides = dict(TINY)
    if method in ("fo-sldr", "rher"):
        overrides |= TINY_REACHING
    if "sldr" in method:
        overrides |= {**TINY_STAGES, "n_timesteps": ROBOT_STEPS + OBJECT_STEPS[method]}
    return run_config(TASK, method=method, overrides=overrides)


def quiet(sentence: str) -> None:
    pass


def logged(folder: Path) -> list[dict[str, str]]:
    rows: list[dict[str, str]] = []
    files = folder.glob("progress_*.csv")  # a resumed run begins another, named by its steps
    for file in sorted(files, key=lambda file: int(file.stem.split("_")[1])):
        with open(file, newline="") as lines:
            rows += csv.DictReader(lines)
    return rows


@pytest.mark.parametrize("method", LOGGED)
def test_trains_logs_and_resumes_exactly(method: str, tmp_path: Path) -> None:
    config = tiny_run(method)
    whole = train(config, tmp_path / "whole", report=quiet)
    object_steps = OBJECT_STEPS.get(method, 0)
    assert (whole["method"], whole["object_steps"]) == (method, object_steps)
    assert whole["env_steps"] == ROBOT_STEPS + object_steps
    assert (whole["k_max"] is None) == ("fo" not in method.split("-"))
    rows = logged(tmp_path / "whole")
    for name in LOGGED[method]:
        assert rows and all(row[name] for row in rows)
    if method == "shaped":  # metres, not -1 or 0
        assert all(-0.9 < float(row["train/reward_mean"]) < 0.0 for row in rows)

    def interrupt(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 400 + object_steps:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "part", report=quiet, progress=interrupt)
    train(config, tmp_path / "part", resume=True, report=quiet)
    policies = [(tmp_path / run / "policy.safetensors").read_bytes() for run in RUNS]
    assert policies[0] == policies[1]
    assert logged(tmp_path / "part")[-1] == rows[-1]


def test_lost_object_networks_are_missed_before_anything_starts(tmp_path: Path) -> None:
    config = tiny_run("sldr")

    def interrupt(figures: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "run", report=quiet, progress=interrupt)
    assert not (tmp_path / "run" / "predictor").exists(), "SLDR alone imagines no goals"
    networks = ObjectNetworks.load(tmp_path / "run" / FILE, env_id=TASK)
    (tmp_path / "run" / FILE).unlink()
    with pytest.raises(ValueError, match="of the finished object stage is missing"):
        train(config, tmp_path / "run", resume=True, report=pytest.fail)
    networks.env_id = "FollowObject/PnPShelf-v0"
    networks.save(tmp_path / "run" / FILE)
    with pytest.raises(ValueError, match="were made for env_id"):
        train(config, tmp_path / "run", resume=True, report=pytest.fail)


def test_sldr_counts_of_a_shared_object_stage_what_it_uses(tmp_path: Path) -> None:
    """The comparison copies a whole stage, with F_phi, into the folders of the runs."""
    config = tiny_run("sldr")
    alone = train(config, tmp_path / "alone", report=quiet)
    both = replace(config, settings={**config.settings, "imagine": True}, keep_last_checkpoint=True)
    told: list[str] = []
    train(both, tmp_path / "stage", report=told.append, object_stage_only=True)
    assert any(said.startswith("checkpoint at 400") for said in told)
    assert not checkpoint_files(tmp_path / "stage"), "no run goes on from a shared stage's"
    claim(tmp_path / "shared", config)
    for name in ("predictor", FILE, OBJECT_STAGE):
        (tmp_path / "stage" / name).rename(tmp_path / "shared" / name)
    shared = train(config, tmp_path / "shared", resume=True, report=quiet)
    assert shared["object_steps"] == alone["object_steps"] == OBJECT_STEPS["sldr"]
    policies = [(tmp_path / n / "policy.safetensors").read_bytes() for n in ("alone", "shared")]
    assert policies[0] == policies[1]
    assert needs_object_stage(config) and needs_object_stage(both)
    assert not needs_object_stage(tiny_run("rnd"))
    assert stage_settings(config) == stage_settings(tiny_run("fo-sldr"))
