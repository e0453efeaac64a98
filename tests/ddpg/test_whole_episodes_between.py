"""What others do with a HerDDPG's environment between two `learn` calls enters no episode."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numbered import NumberedEnv, assert_true_episodes, learner, numbered
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from tiny import TASK
from toy import HORIZON

from sb3_follow_object.envs import make_vec


def in_processes(n: int) -> SubprocVecEnv:
    return SubprocVecEnv([lambda: Monitor(NumberedEnv())] * n)


@pytest.mark.parametrize("n", [2 * HORIZON, 13], ids=["between episodes", "in the middle"])
@pytest.mark.parametrize("make", [numbered, in_processes])
def test_evaluating_in_its_environment_ends_the_running_episodes(
    make: Callable[[int], VecEnv], n: int
) -> None:
    model = learner("HerDDPG", make(2), train_freq=1)
    model.learn(2 * n)
    evaluate_policy(model, model.get_env(), n_eval_episodes=3)
    model.learn(2 * 2 * HORIZON, reset_num_timesteps=False)
    model.get_env().close()
    assert assert_true_episodes(model.replay_buffer) == 2 * (-(-n // HORIZON) + 2)


def test_so_it_is_in_the_batched_environments() -> None:
    model = learner("HerDDPG", make_vec(TASK, 2, 1), learning_starts=10**6)
    model.learn(2 * 50)
    model.get_env().reset()
    model.learn(2 * 50, reset_num_timesteps=False)
    buffer = model.replay_buffer
    goals = [half["desired_goal"][:100] for half in (buffer.observations, buffer.next_observations)]
    np.testing.assert_array_equal(*goals)


def test_without_that_no_episode_is_drawn_anew() -> None:
    model = learner("HerDDPG", numbered(2))
    for _ in range(3):
        model.learn(2 * HORIZON, reset_num_timesteps=False)
        model.predict(model._last_obs)
    numbers: Any = model.replay_buffer.observations["observation"][: 3 * HORIZON : HORIZON, 0, 0]
    assert numbers.tolist() == [1, 2, 3]


def test_a_copy_goes_on_in_its_own_environment() -> None:
    model = learner("HerDDPG", numbered(2))
    model.learn(2 * HORIZON)
    other = copy.deepcopy(model)
    for each in (model, other):
        each.learn(2 * HORIZON, reset_num_timesteps=False)
    stored = [each.replay_buffer.observations["observation"] for each in (model, other)]
    np.testing.assert_array_equal(*stored)
