"""A fast environment in which an effector can reach for an object, and what reaches in it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.reach.actor import ReachActor
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer

HORIZON = 20
STEP = 0.05  # metres an action of 1 moves the effector
NEAR = 0.04  # metres within which the effector carries the object
TASK = "ReachToy-v0"
REACH: dict[str, Any] = {"tolerance": 0.03, "height": 0.05}


class ReachToyEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """An effector that carries the object where it touches it; the fourth entry does nothing.

    observation: effector (3,) and object (3,), metres. The object lies 0.2 m from the effector and
    0.2 m from its goal.
    """

    def __init__(self, scale: float = 1.0) -> None:
        box = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-np.inf, np.inf, (6,), np.float64),
                "achieved_goal": box,
                "desired_goal": box,
            }
        )
        self.action_space = spaces.Box(-scale, scale, (4,), np.float32)
        self.scale = scale

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.effector = self.np_random.uniform(-0.05, 0.05, 3)
        self.object = self.effector + self._flat_direction(0.2)
        self.goal = self.object + self._flat_direction(0.2)
        return self._observe(), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(np.asarray(action, np.float32))
        move = STEP * np.asarray(action[:3], dtype=np.float64) / self.scale
        if np.linalg.norm(self.effector - self.object) <= NEAR:
            self.object = self.object + move
        self.effector = self.effector + move
        obs = self._observe()
        success = bool(self.is_success(self.object, self.goal))
        return obs, float(success) - 1.0, False, False, {"is_success": success}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return self.is_success(achieved, desired).astype(np.float32) - 1.0

    def is_success(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.subtract(achieved, desired), axis=-1) <= 0.05

    def _flat_direction(self, length: float) -> np.ndarray:
        angle = self.np_random.uniform(0.0, 2.0 * np.pi)
        return length * np.array([np.cos(angle), np.sin(angle), 0.0])

    def _observe(self) -> dict[str, np.ndarray]:
        return {
            "observation": np.concatenate([self.effector, self.object]),
            "achieved_goal": self.object.copy(),
            "desired_goal": self.goal.copy(),
        }


gym.register(TASK, entry_point=f"{__name__}:ReachToyEnv", max_episode_steps=HORIZON)


class StraightActor(ReachActor):
    """Goes straight to the place at full speed; the toy's fourth entry is idle."""

    def __init__(self) -> None:
        self.idle = np.array([False, False, False, True])

    def __call__(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        actions = np.clip((goal - observation[:, :3]) / STEP, -1.0, 1.0)
        return np.concatenate([actions, np.zeros((len(goal), 1))], axis=1)


def algorithm(name: str) -> Any:
    """An algorithm by its name, of this package, SB3 or sb3_contrib."""
    if name == "HerDDPG":
        return HerDDPG
    module = "sb3_contrib" if name == "TQC" else "stable_baselines3"
    return getattr(__import__(module), name)


def learner(env: Any, name: str = "HerDDPG", **options: Any) -> Any:
    """A tiny learner that trains after an episode of every copy."""
    defaults: dict[str, Any] = {
        "buffer_size": 4000,
        "learning_starts": 0,
        "train_freq": HORIZON,
        "gradient_steps": 2,
        "batch_size": 16,
        "policy_kwargs": {"net_arch": [16]},
        "seed": 0,
    }
    if name != "HerDDPG":
        defaults["replay_buffer_class"] = FollowObjectReplayBuffer
    return algorithm(name)("MultiInputPolicy", env, **{**defaults, **options})
