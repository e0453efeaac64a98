"""What earlier versions saved loads and goes on: the files of version 0.1 in tests/saved_before.

They are xz-compressed as that version wrote them. Rounding differs between kinds of processors, so
what it went on to is compared with a tolerance.
"""

from __future__ import annotations

import json
import lzma
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from small_models import weights
from stable_baselines3 import DDPG
from tree import ROOT

from sb3_follow_object.ddpg.actor_files import load_actor
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.settings.presets import load_config

SAVED = ROOT / "tests" / "saved_before"
TASK = "FollowObject/PnPShelf-v0"
RESULTS = ROOT / "benchmarks" / "results"


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """The folder as version 0.1 left it."""
    folder = tmp_path / "saved"
    for file in SAVED.glob("**/*.*"):
        target = folder / file.relative_to(SAVED)
        target.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".xz":
            target.with_suffix("").write_bytes(lzma.decompress(file.read_bytes()))
        else:
            shutil.copy(file, target)
    return folder


def test_a_model_goes_on_with_its_replay_buffer(saved: Path) -> None:
    model = HerDDPG.load(saved / "her_plain.zip", env=make_vec(TASK, 2, 1, seed=5))
    before = weights(model).numpy().copy()
    model.load_replay_buffer(saved / "her_plain_buffer.pkl")
    np.random.seed(0)
    th.manual_seed(0)
    DDPG.set_random_seed(model, 7)  # as then: the generators that were saved go on
    model.learn(100, reset_num_timesteps=False)
    then = np.load(saved / "her_plain_after.npy")
    assert np.abs(then - before).max() > 1e-3
    np.testing.assert_allclose(weights(model).numpy(), then, atol=1e-4)


def test_a_stock_algorithm_goes_on_with_its_replay_buffer(saved: Path) -> None:
    model = DDPG.load(saved / "ddpg.zip", env=make_vec(TASK, 2, 1))
    model.load_replay_buffer(saved / "ddpg_buffer.pkl")
    buffer = model.replay_buffer
    assert isinstance(buffer, FollowObjectReplayBuffer)
    assert (model.num_timesteps, model._n_updates) == (200, 1)
    assert buffer.table.n_transitions() == 200
    model.learn(100, reset_num_timesteps=False)
    assert model.num_timesteps == 300
    assert model._n_updates > 1


def test_a_run_goes_on_from_its_checkpoint(saved: Path) -> None:
    said: list[str] = []
    folder = saved / "run"
    result = train(load_config(folder), folder, resume=True, report=said.append)
    assert any("400" in sentence for sentence in said), said
    assert result["env_steps"] >= 3600


def folders_of(name: str) -> list[Path]:
    return sorted(path.parent for path in RESULTS.glob(f"**/{name}"))


def test_every_result_of_the_benchmarks_loads() -> None:
    spaces: dict[str, tuple[Any, Any]] = {}
    folders = folders_of("policy.safetensors")
    assert folders
    for folder in folders:
        config = load_config(folder)
        if config.env_id not in spaces:
            env = make_vec(config.env_id, 1)
            spaces[config.env_id] = env.observation_space, env.action_space
            env.close()
        observation_space, action_space = spaces[config.env_id]
        actor, env_id = load_actor(folder / "policy.safetensors", observation_space, action_space)
        assert env_id == config.env_id
        seen = {key: np.zeros((1, *box.shape)) for key, box in observation_space.items()}
        assert np.isfinite(actor.predict(seen, deterministic=True)[0]).all()


def test_every_predictor_of_the_benchmarks_loads() -> None:
    folders = folders_of("predictor.json")
    assert folders
    for folder in folders:
        config = json.loads((folder.parent / "config.json").read_text())
        predictor = GoalPredictor.load(folder, env_id=config["env_id"])
        path = predictor.paths(np.zeros((1, 3)), np.ones((1, 3)))
        assert path.shape[0] == 1 and np.isfinite(path).all()
