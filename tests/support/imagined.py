"""Toy environments that imagine goals, what learns there, and what is true of their episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import toy
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.imagined_goals import imagine
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv

N = 4
Steps = list[dict[str, Any]]


def bare(n: int = N) -> VecEnv:
    return DummyVecEnv([toy.PointEnv] * n)


def imagining(
    curriculum: Curriculum,
    mode: str = "train",
    n: int = N,
    env: Callable[[], gym.Env] = toy.PointEnv,
) -> ImaginedGoalVecEnv:
    venv = ImaginedGoalVecEnv(DummyVecEnv([env] * n), toy.StraightPredictor(), curriculum, mode)
    venv.seed(0)
    return venv


def learner(env: VecEnv, algorithm: Any = DDPG, **options: Any) -> Any:
    defaults: dict[str, Any] = {
        "replay_buffer_class": HerReplayBuffer,
        "learning_starts": 10**9,  # no updates: actions are random, tests play the first policy
        "train_freq": (toy.HORIZON, "step"),
        "buffer_size": 4000,
        "policy_kwargs": {"net_arch": [32, 32]},
        "gamma": 0.9,
        "seed": 0,
    }
    return algorithm("MultiInputPolicy", env, **{**defaults, **options})


def play(venv: VecEnv, steps: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    """Play random actions; give each copy's transitions with their true next observation."""
    rng = np.random.default_rng(seed)
    obs = cast(dict[str, np.ndarray], venv.reset())
    for _ in range(steps):
        actions = rng.uniform(-1, 1, (venv.num_envs, *venv.action_space.shape)).astype(np.float32)
        new_obs, rewards, dones, infos = venv.step(actions)
        new_obs = cast(dict[str, np.ndarray], new_obs)
        for i in range(venv.num_envs):
            if dones[i]:
                next_obs = infos[i]["terminal_observation"]
            else:
                next_obs = {key: value[i] for key, value in new_obs.items()}
            yield {
                "copy": i,
                "obs": {key: value[i].copy() for key, value in obs.items()},
                "next_obs": next_obs,
                "reward": rewards[i],
                "done": dones[i],
                "info": infos[i],
            }
        obs = new_obs


def episodes(venv: VecEnv, steps: int) -> list[Steps]:
    """Return the finished episodes, in the order of their ends."""
    running: list[Steps] = [[] for _ in range(venv.num_envs)]
    finished: list[Steps] = []
    for step in play(venv, steps):
        running[step["copy"]].append(step)
        if step["done"]:
            finished.append(running[step["copy"]])
            running[step["copy"]] = []
    return finished


def expected_goal(curriculum: Curriculum, first: dict[str, Any]) -> np.ndarray:
    info = first["info"]
    if info["imagined_level"] == 0:
        return info["original_goal"]
    return imagine(
        toy.StraightPredictor(),
        curriculum,
        first["obs"]["achieved_goal"][None],
        info["original_goal"][None],
        np.array([info["imagined_level"]]),
    )[0]


def check_transitions(curriculum: Curriculum, finished: list[Steps]) -> None:
    """One goal an episode, which obs, next_obs, reward and success all mean."""
    judge = toy.PointEnv()
    for episode in finished:
        shown = episode[0]["obs"]["desired_goal"]
        np.testing.assert_allclose(shown, expected_goal(curriculum, episode[0]), atol=1e-6)
        for step in episode:
            info, achieved = step["info"], step["next_obs"]["achieved_goal"]
            np.testing.assert_array_equal(step["obs"]["desired_goal"], shown)
            np.testing.assert_array_equal(step["next_obs"]["desired_goal"], shown)
            np.testing.assert_array_equal(
                info["original_goal"], episode[0]["info"]["original_goal"]
            )
            assert info["imagined_level"] == episode[0]["info"]["imagined_level"]
            assert info["is_success"] == bool(judge.is_success(achieved, shown))
            assert step["reward"] == float(judge.compute_reward(achieved, shown, {}))
            assert info["original_success"] == bool(
                judge.is_success(achieved, info["original_goal"])
            )
