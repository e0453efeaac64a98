"""An environment whose observations tell which step they are of, and what is true of a buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import HORIZON, PointEnv

from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


class NumberedEnv(PointEnv):
    """Observes the number of its episode, the step in it, and the action that led there."""

    episode, action = 0, 0.0

    def reset(self, **options: Any) -> Any:
        self.episode, self.action = self.episode + 1, 0.0
        return super().reset(**options)

    def step(self, action: np.ndarray) -> Any:
        self.action = float(action[0])
        return super().step(action)

    def _observe(self) -> dict[str, np.ndarray]:
        return {
            **super()._observe(),
            "observation": np.array([self.episode, self.steps, self.action]),
        }


def stock(name: str) -> Any:
    """An algorithm's class by its name."""
    if name == "TQC":
        from sb3_contrib import TQC

        return TQC
    return {"HerDDPG": HerDDPG, "DDPG": DDPG, "TD3": TD3, "SAC": SAC}[name]


ALGORITHMS = ["HerDDPG", "DDPG", "TD3", "SAC", "TQC"]


def learner(name: str, env: Any, **options: Any) -> Any:
    """A tiny model with our replay buffer."""
    defaults: dict[str, Any] = {
        "replay_buffer_class": FollowObjectReplayBuffer,
        "policy_kwargs": {"net_arch": [8]},
        "buffer_size": 2000,
        "batch_size": 8,
        "gamma": 0.9,
        "gradient_steps": 1,
        "learning_starts": 4 * HORIZON,
        "train_freq": HORIZON,
        "seed": 0,
    }
    return stock(name)("MultiInputPolicy", env, **{**defaults, **options})


def numbered(n_envs: int) -> DummyVecEnv:
    """Copies of it in Monitors, as SB3 makes them."""
    return DummyVecEnv([lambda: Monitor(NumberedEnv())] * n_envs)


def assert_true_episodes(buffer: Any) -> int:
    """Every episode to draw from is a stretch of one that happened; return their number."""
    assert buffer.table.n_transitions() > 0
    rows = np.flatnonzero(buffer.table.length)
    for row in rows:
        start, env, length, _ = buffer.table.facts[row]
        slots = (start + np.arange(length)) % buffer.buffer_size
        assert 1 <= length <= HORIZON
        obs, later = (
            half["observation"][slots, env]
            for half in (buffer.observations, buffer.next_observations)
        )
        goals = [
            half["desired_goal"][slots, env]
            for half in (buffer.observations, buffer.next_observations)
        ]
        assert len(np.unique(np.concatenate(goals), axis=0)) == 1
        assert len({*obs[:, 0], *later[:, 0]}) == 1  # one episode
        np.testing.assert_array_equal(later[:, 1], obs[:, 1] + 1)  # a step each
        np.testing.assert_array_equal(obs[1:, 1], later[:-1, 1])  # none left out
        np.testing.assert_allclose(later[:, 2], buffer.actions[slots, env, 0], atol=1e-6)
    return len(rows)
