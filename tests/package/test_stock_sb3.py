"""Wrapper, buffer and callback around stock algorithms: stored goals are the shown ones."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from tiny import HORIZON, TASK, cache_predictor
from tree import ROOT, run

from sb3_follow_object import (
    Curriculum,
    CurriculumCallback,
    FollowObjectReplayBuffer,
    ImaginedGoalVecEnv,
    ImaginedGoalWrapper,
)
from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.imagined_goals import imagine
from sb3_follow_object.runs.predictor_cache import CACHE_VARIABLE, get_predictor

SETTINGS: dict[str, Any] = {"levels": "path", "threshold": 0.0, "p": 0.4}


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder that predictor="auto" finds a predictor in."""
    folder = tmp_path_factory.mktemp("cache")
    cache_predictor(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


def wrapped(**options: Any) -> ImaginedGoalWrapper:
    """One environment with everything from settings, as YAML gives them."""
    return ImaginedGoalWrapper(gym.make(TASK, **options), predictor="auto", curriculum=SETTINGS)


def batched() -> ImaginedGoalVecEnv:
    return ImaginedGoalVecEnv(
        make_vec(TASK, 2, 1), get_predictor(TASK), Curriculum(HORIZON, **SETTINGS)
    )


FACES = {"gymnasium": wrapped, "VecEnv": batched}


def algorithm(name: str) -> Any:
    if name == "TQC":
        return pytest.importorskip("sb3_contrib").TQC
    return getattr(__import__("stable_baselines3"), name)


def learner(env: Any, name: str = "DDPG", **options: Any) -> Any:
    """A tiny learner that trains after every episode of each copy."""
    defaults: dict[str, Any] = {
        "replay_buffer_class": FollowObjectReplayBuffer,
        "replay_buffer_kwargs": {"copy_info_dict": True},
        "buffer_size": 4000,
        "learning_starts": HORIZON,
        "train_freq": HORIZON,
        "gradient_steps": 3,
        "batch_size": 16,
        "policy_kwargs": {"net_arch": [16]},
        "seed": 0,
    }
    return algorithm(name)("MultiInputPolicy", env, **{**defaults, **options})


class Logged(BaseCallback):
    """What was recorded at the end of each rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.rows.append(dict(self.logger.name_to_value))


def check_stored_goals(buffer: FollowObjectReplayBuffer) -> set[int]:
    """Every row's goal is the one that its episode's level means; give the levels met."""
    predictor, curriculum = get_predictor(TASK), Curriculum(HORIZON, **SETTINGS)
    judge = gym.make(TASK).unwrapped
    levels = set()
    assert buffer.pos > 0 and buffer.pos % HORIZON == 0
    for copy in range(buffer.n_envs):
        for begin in range(0, buffer.pos, HORIZON):
            rows = np.arange(begin, begin + HORIZON)
            assert (buffer.ep_length[rows, copy] == HORIZON).all()
            infos = buffer.infos[rows, copy]
            level, expected = infos[0]["imagined_level"], infos[0]["original_goal"]
            if level > 0:
                start = buffer.observations["achieved_goal"][begin, copy]
                (expected,) = imagine(
                    predictor, curriculum, start[None], expected[None], np.array([level])
                )
            for store in (buffer.observations, buffer.next_observations):
                goals = store["desired_goal"][rows, copy]
                np.testing.assert_allclose(goals, np.tile(expected, (HORIZON, 1)), atol=1e-5)
            achieved = buffer.next_observations["achieved_goal"][rows, copy]
            rewards = judge.compute_reward(achieved, goals, {})  # type: ignore[attr-defined]
            np.testing.assert_array_equal(buffer.rewards[rows, copy], rewards)
            assert [info["is_success"] for info in infos] == list(rewards == 0.0)
            levels.add(level)
    return levels


@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize("name", ["DDPG", "TD3", "SAC", "TQC"])
def test_stored_goals_are_the_shown_ones_and_tests_are_logged(name: str, face: str) -> None:
    model = learner(FACES[face](), name)
    callback, logged = CurriculumCallback(n_episodes=2, every=3), Logged()
    n_envs = model.n_envs
    test_steps = HORIZON * max(2, n_envs)  # two episodes, one after the other or side by side
    budget = 2 * (3 * n_envs * HORIZON + test_steps)
    model.learn(budget, callback=[callback, logged])

    levels = check_stored_goals(model.replay_buffer)
    assert {0, 2, 3} <= levels  # original goals, and h_max of both tests at least
    # Two tests, which always pass with threshold 0, in six cycles.
    assert [row["curriculum/k_max"] for row in logged.rows] == [2, 2, 3, 3, 3, 4]
    assert [row["curriculum/test_steps"] for row in logged.rows] == [
        *[0, 0, test_steps, test_steps, test_steps, 2 * test_steps]
    ]
    assert 0.0 <= logged.rows[2]["curriculum/test_success"] <= 1.0
    assert model.num_timesteps == budget
    assert model.replay_buffer.pos * n_envs == budget  # tests are stored
    assert model._n_updates >= 12


def test_settings_show_original_goals_until_a_callback_comes() -> None:
    env = wrapped()
    for _ in range(10):
        obs, info = env.reset(seed=3)
        assert info["imagined_level"] == 0
        np.testing.assert_array_equal(obs["desired_goal"], info["original_goal"])
    env.load_curriculum(Curriculum(HORIZON, **{**SETTINGS, "k_max": 9}).state_dict())
    assert {env.reset()[1]["imagined_level"] for _ in range(60)} == set(range(10))


def test_original_goals_need_no_predictor(tmp_path: Path) -> None:
    env = ImaginedGoalWrapper(gym.make(TASK), predictor=tmp_path / "none")
    env.reset()
    with pytest.raises(ValueError, match="none"):
        _ = env.predictor


def test_a_loaded_model_trains_on_at_its_k_max(tmp_path: Path) -> None:
    model = learner(wrapped())
    model.learn(2 * HORIZON, callback=CurriculumCallback(n_episodes=1))
    model.save(tmp_path / "model")
    loaded = DDPG.load(tmp_path / "model", wrapped())
    callback = CurriculumCallback(n_episodes=1)
    loaded.learn(2 * HORIZON, callback=callback)
    assert callback.curriculum.k_max == 4


# Spawned processes see the cache folder of this module; a server that forks them may be older.
SPAWNED = partial(SubprocVecEnv, start_method="spawn")


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SPAWNED], ids=["Dummy", "Subproc"])
def test_copies_made_from_settings_follow_one_curriculum(vec_env: Any) -> None:
    env: VecEnv = vec_env([lambda: wrapped(reward_type="dense")] * 2)
    try:
        model = learner(env)
        callback = CurriculumCallback(n_episodes=2)
        model.learn(4 * 2 * HORIZON, callback=callback)
        assert callback.curriculum.k_max == 4
        assert [one.k_max for one in env.get_attr("curriculum")] == [4, 4]
        assert env.get_attr("active") == [True, True]
        start, goal = np.array([[1.3, 0.7, 0.42]]), np.array([[1.4, 0.8, 0.42]])
        np.testing.assert_array_equal(
            callback.test_env.get_attr("predictor")[0].paths(start, goal),
            get_predictor(TASK).paths(start, goal),
        )
        # The tests, rows T to 2T, have the training's kind of reward.
        tests = model.replay_buffer.rewards[HORIZON : 2 * HORIZON]
        assert ((tests > -1.0) & (tests < 0.0)).all()
    finally:
        env.close()


def test_a_callback_says_that_no_goals_are_imagined() -> None:
    with pytest.raises(ValueError, match="ImaginedGoalWrapper; this one imagines no goals"):
        learner(gym.make(TASK)).learn(1, callback=CurriculumCallback())


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"curriculum": {"kmax": 3}}, "kmax"),
        ({"curriculum": {"p": 2.0}}, r"p is 2.0; it must lie in \[0, 1\]"),
        (
            {"curriculum": {"k_max": HORIZON + 1}},
            f"k_max is {HORIZON + 1}; it must be at most {HORIZON}",
        ),
    ],
)
def test_wrong_settings_are_a_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        ImaginedGoalWrapper(gym.make(TASK), **options)


def test_a_predictor_for_another_task_is_refused(cache: Path) -> None:
    (folder,) = (cache / TASK).iterdir()
    env = ImaginedGoalWrapper(gym.make("FollowObject/PnPShelf-v0"), predictor=folder)
    with pytest.raises(ValueError, match="PushSideGap"):
        _ = env.predictor


def test_the_script_in_the_docs_runs(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "sb3.md").read_text()
    script, single = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (played,) = re.findall(r"```py\n(.*?)```", page, re.DOTALL)
    assert len(script.strip().splitlines()) <= 22
    for written, tried in (("300_000", "4_900"), ("PnPShelf", "PushSideGap")):
        assert script.count(written) == 1
        script = script.replace(written, tried)
    still = "assert played.training is False and not played.has_attr('curriculum')\n"
    output = run([sys.executable, "-c", script + played + still], cwd=tmp_path)
    assert "test_success" in output and "k_max" in output and "critic_loss" in output
    assert (tmp_path / "shelf.zip").exists()
    exec(single, names := {})
    names["env"].close()
