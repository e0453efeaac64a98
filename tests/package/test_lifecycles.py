"""What a model lives through: learning, again, stopped, saved, loaded, in another environment.

Every off-policy algorithm that takes continuous actions, with this package's replay buffer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_follow_object import CurriculumCallback, FollowObjectReplayBuffer, ImaginedGoalVecEnv
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec

N = 2  # copies
TASK = "FollowObject/PushSideGap-v0"
ALGORITHMS: dict[str, Any] = {
    "HerDDPG": HerDDPG,
    "DDPG": DDPG,
    "TD3": TD3,
    "SAC": SAC,
    "TQC": TQC,
}

gym.register("LifePoint-v0", entry_point=toy.PointEnv, max_episode_steps=toy.HORIZON)


def single() -> VecEnv:
    return DummyVecEnv([lambda: gym.make("LifePoint-v0")] * N)


def batched() -> VecEnv:
    return make_vec(TASK, N, 1)


def wrapped() -> VecEnv:
    curriculum = toy.curriculum(threshold=0.0, p=0.5)
    return ImaginedGoalVecEnv(single(), toy.StraightPredictor(), curriculum)


FACES: dict[str, Callable[[], VecEnv]] = {
    "single": single,
    "batched": batched,
    "wrapped": wrapped,
}
LIVES = list(itertools.product(ALGORITHMS, FACES))
every_life = pytest.mark.parametrize(("name", "face"), LIVES, ids=map("-".join, LIVES))


class StopAfter(BaseCallback):
    """Stops the training at a step, in the middle of episodes."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        return self.n_calls < self.steps


def horizon(env: VecEnv) -> int:
    return int(env.get_attr("spec")[0].max_episode_steps)


def begin(name: str, face: str, **options: Any) -> Any:
    env = FACES[face]()
    defaults: dict[str, Any] = {
        "replay_buffer_class": FollowObjectReplayBuffer,
        "buffer_size": 1000,
        "learning_starts": N * horizon(env),
        "train_freq": horizon(env),
        "gradient_steps": 2,
        "batch_size": 16,
        "policy_kwargs": {"net_arch": [8]},
        "seed": 0,
    }
    return ALGORITHMS[name]("MultiInputPolicy", env, **{**defaults, **options})


def learn(model: Any, rollouts: int, *callbacks: BaseCallback, anew: bool = False) -> None:
    steps = rollouts * N * horizon(model.env)
    model.learn(steps, callback=[*callbacks], log_interval=None, reset_num_timesteps=anew)


def episodes(buffer: FollowObjectReplayBuffer) -> list[tuple[int, np.ndarray]]:
    """The environment and the slots of every finished episode."""
    facts = buffer.table.facts
    return [
        (int(env), (start + np.arange(length)) % buffer.buffer_size)
        for start, env, length, _ in facts[facts[:, 2] > 0]
    ]


def check(model: Any) -> int:
    """Every episode is one, from its beginning on; networks are finite. Return its transitions."""
    buffer = model.replay_buffer
    steps = 0
    for env, slots in episodes(buffer):
        here = {key: store[slots, env] for key, store in buffer.observations.items()}
        after = {key: store[slots, env] for key, store in buffer.next_observations.items()}
        assert 0 < len(slots) <= horizon(model.env)
        for key in here:
            assert np.isfinite(here[key]).all() and np.isfinite(after[key]).all()
            np.testing.assert_array_equal(after[key][:-1], here[key][1:])
        np.testing.assert_array_equal(here["desired_goal"], after["desired_goal"])
        assert (here["desired_goal"] == here["desired_goal"][0]).all()
        steps += len(slots)
    assert all(bool(parameter.isfinite().all()) for parameter in model.policy.parameters())
    return steps


def predictions(model: Any) -> np.ndarray:
    spaces = model.observation_space.spaces
    obs = {key: np.full((3, *space.shape), 0.4, space.dtype) for key, space in spaces.items()}
    return np.asarray(model.predict(obs, deterministic=True)[0])


def check_moves(buffer: FollowObjectReplayBuffer) -> None:
    """Every transition is one step of the toy: no step in between was lost."""
    for env, slots in episodes(buffer):
        moved = (
            buffer.next_observations["achieved_goal"][slots, env]
            - buffer.observations["achieved_goal"][slots, env]
        )
        np.testing.assert_allclose(moved, toy.STEP * buffer.actions[slots, env], atol=1e-6)


def callbacks_of(face: str) -> list[BaseCallback]:
    return [CurriculumCallback()] if face == "wrapped" else []


@every_life
def test_learning_twice_counts_on_in_whole_episodes(name: str, face: str) -> None:
    model = begin(name, face)
    learn(model, 2, anew=True)
    assert check(model) == model.num_timesteps == 2 * N * horizon(model.env)
    updates = model._n_updates
    assert updates > 0
    learn(model, 2)
    assert check(model) == model.num_timesteps == 4 * N * horizon(model.env)
    assert model._n_updates == updates + 2 * 2
    learn(model, 1, anew=True)
    assert model.num_timesteps == N * horizon(model.env)
    assert check(model) == 5 * N * horizon(model.env)


@pytest.mark.parametrize("anew", [True, False], ids=["anew", "on"])
@every_life
def test_a_learning_that_is_broken_off_mixes_no_episodes(name: str, face: str, anew: bool) -> None:
    model = begin(name, face)
    callbacks = callbacks_of(face)
    whole = horizon(model.env)
    learn(model, 2, *callbacks, StopAfter(whole + 3), anew=True)
    check(model)
    learn(model, 2, *callbacks, anew=anew)
    finished = check(model)
    # All else is what runs now.
    assert 0 <= N * model.replay_buffer.pos - finished < N * whole
    lengths = [len(slots) for _, slots in episodes(model.replay_buffer)]
    assert lengths.count(whole) >= 2 * N
    samples = model.replay_buffer.sample(64)
    assert all(bool(value.isfinite().all()) for value in samples.observations.values())
    # A stock algorithm drops the step that it stops in and goes on from before it, unless told.
    if face != "batched" and (name == "HerDDPG" or callbacks):
        check_moves(model.replay_buffer)


@every_life
def test_a_saved_model_goes_on_where_it_was(name: str, face: str, tmp_path: Path) -> None:
    model = begin(name, face)
    callbacks = callbacks_of(face)
    learn(model, 4, *callbacks, anew=True)
    steps = model.num_timesteps
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")

    env = FACES[face]()
    loaded = ALGORITHMS[name].load(tmp_path / "model", env=env)
    np.testing.assert_array_equal(predictions(loaded), predictions(model))
    assert loaded.num_timesteps == steps
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.env is loaded.env
    assert check(loaded) == check(model)
    learn(loaded, 4, *callbacks_of(face))
    assert loaded.num_timesteps == steps + 4 * N * horizon(env)
    assert check(loaded) == loaded.num_timesteps
    assert loaded._n_updates > model._n_updates
    if face == "wrapped":
        # Two cycles of training and two tests, which always pass, in each learning.
        assert model.curriculum_state["k_max"] == 4
        assert loaded.curriculum_state["k_max"] == env.get_attr("curriculum")[0].k_max == 6


@every_life
def test_a_model_can_be_loaded_to_act_alone(name: str, face: str, tmp_path: Path) -> None:
    model = begin(name, face)
    learn(model, 2, anew=True)
    model.save(tmp_path / "model")
    # SB3's own must be told that there is nothing to relabel.
    plain = {"replay_buffer_class": DictReplayBuffer, "replay_buffer_kwargs": {}, "buffer_size": 1}
    loaded = ALGORITHMS[name].load(tmp_path / "model", **({} if name == "HerDDPG" else plain))
    np.testing.assert_array_equal(predictions(loaded), predictions(model))


@every_life
def test_a_model_follows_its_new_environment(name: str, face: str) -> None:
    model = begin(name, face)
    callbacks: list[Any] = callbacks_of(face)
    learn(model, 2, *callbacks, anew=True)
    steps, old, new = model.num_timesteps, model.env, FACES[face]()
    model.set_env(new)
    if name != "HerDDPG" and not callbacks:
        model.replay_buffer.set_env(model.env)  # nobody else could tell it
    old.close()
    asked = []
    ask = new.env_method
    new.env_method = lambda *given, **more: asked.append(given[0]) or ask(*given, **more)  # type: ignore
    learn(model, 2, *callbacks)
    assert model.num_timesteps == steps + 2 * N * horizon(new)
    assert check(model) == model.num_timesteps
    assert model.replay_buffer.env is model.env is new
    asked.clear()
    model.replay_buffer.sample(64)
    assert set(asked) == {"compute_reward"}
    for callback in callbacks:
        assert callback.curriculum is new.get_attr("curriculum")[0]
        assert model.curriculum_state == callback.curriculum.state_dict()
