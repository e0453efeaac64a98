"""Small replay buffers of a point that moves, and what is in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import PointEnv

from sb3_follow_object.imagination.goal_env import with_terminal_observations
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


class LazyPointEnv(PointEnv):
    """Moves in every second episode only."""

    episodes = 0

    def reset(self, **kwargs: Any) -> Any:
        self.episodes += 1
        return super().reset(**kwargs)

    def step(self, action: np.ndarray) -> Any:
        return super().step(action if self.episodes % 2 else 0.0 * action)


def make_env(n_envs: int = 2, env_class: type[PointEnv] = PointEnv) -> DummyVecEnv:
    env = DummyVecEnv([env_class] * n_envs)
    env.seed(0)
    return env


def fill(buffers: list[Any], env: Any, n_steps: int, seed: int = 0) -> None:
    """Give every buffer the same random steps."""
    rng = np.random.default_rng(seed)
    obs = env.reset()
    for _ in range(n_steps):
        actions = rng.uniform(-1, 1, (env.num_envs, *env.action_space.shape)).astype(np.float32)
        new_obs, rewards, dones, infos = env.step(actions)
        next_obs = with_terminal_observations(new_obs, dones, infos)
        for buffer in buffers:
            buffer.add(dict(obs), dict(next_obs), actions, rewards, dones, infos)
        obs = new_obs


def make_buffer(env: Any, size: int = 2000, **kwargs: Any) -> FollowObjectReplayBuffer:
    return FollowObjectReplayBuffer(
        size, env.observation_space, env.action_space, env, "cpu", env.num_envs, seed=0, **kwargs
    )


def as_arrays(samples: Any) -> dict[str, np.ndarray]:
    return {
        "obs": samples.observations["observation"].numpy(),
        "next_achieved": samples.next_observations["achieved_goal"].numpy(),
        "goal": samples.observations["desired_goal"].numpy(),
        "next_goal": samples.next_observations["desired_goal"].numpy(),
        "reward": samples.rewards.numpy().ravel(),
        "done": samples.dones.numpy().ravel(),
    }
