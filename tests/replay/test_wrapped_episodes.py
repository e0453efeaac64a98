"""Wrappers outside of the Monitor that step in `reset`: their episodes are learned from."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numbered import NumberedEnv, assert_true_episodes, learner
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor
from toy import HORIZON


class Settling(gym.Wrapper[Any, Any, Any, Any]):
    """Lets things settle for a few steps before an episode begins."""

    fewest, most = 2, 2

    def reset(self, **options: Any) -> Any:
        obs, info = self.env.reset(**options)
        for _ in range(self.np_random.integers(self.fewest, self.most, endpoint=True)):
            obs, *_ = self.env.step(np.zeros(3, np.float32))
        return obs, info


class SettlingSomehow(Settling):
    fewest, most = 1, 3


class StopAt(BaseCallback):
    """Stops in the n-th step."""

    def __init__(self, n: int) -> None:
        super().__init__()
        self.left = n

    def _on_step(self) -> bool:
        self.left -= 1
        return self.left > 0


def settling(wrapper: type[Settling] = Settling, n: int = 2) -> VecEnv:
    return make_vec_env(NumberedEnv, n, seed=0, wrapper_class=wrapper)


def counted_by_gymnasium() -> VecEnv:
    return DummyVecEnv([lambda: Settling(gym.wrappers.RecordEpisodeStatistics(NumberedEnv()))] * 2)


def counted_outside() -> VecEnv:
    return VecMonitor(DummyVecEnv([lambda: Settling(NumberedEnv())] * 2))


@pytest.mark.parametrize("make", [settling, counted_by_gymnasium, counted_outside])
@pytest.mark.parametrize("name", ["HerDDPG", "DDPG"])
def test_no_episode_is_dropped_for_steps_in_reset(name: str, make: Any) -> None:
    model = learner(name, make())
    model.learn(2 * 10 * (HORIZON - 2))
    assert assert_true_episodes(model.replay_buffer) == 2 * 10
    assert model._n_updates > 0


def test_a_few_are_where_the_number_of_those_steps_varies() -> None:
    model = learner("DDPG", settling(SettlingSomehow))
    model.learn(400)
    assert assert_true_episodes(model.replay_buffer) >= 2 * 20 - 4


@pytest.mark.parametrize("wrapper", [Settling, SettlingSomehow])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_step_that_was_not_stored_is_found_beside_them(n_envs: int, wrapper: Any) -> None:
    model = learner("DDPG", settling(wrapper, n_envs), learning_starts=10**6)
    model.learn(2 * HORIZON * n_envs)  # one episode tells of the next one's beginning
    for n in (5, 8, 8, 9, 11, 3, 3, 25):
        model.learn(10_000, callback=StopAt(n), reset_num_timesteps=False)
    model.learn(5 * HORIZON * n_envs, reset_num_timesteps=False)
    assert assert_true_episodes(model.replay_buffer) >= 5 * n_envs


def test_a_buffer_without_its_environment_drops_what_it_cannot_tell() -> None:
    model = learner("DDPG", settling(), learning_starts=10**6)
    model.replay_buffer.env = None
    model.learn(10 * HORIZON)
    assert not model.replay_buffer.table.n_transitions()
