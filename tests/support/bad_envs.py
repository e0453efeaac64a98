"""Environments that nobody should train in, by gymnasium ids of their own."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import toy
from gymnasium import spaces


class NoGoal(toy.PointEnv):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space = self.observation_space["observation"]


class NoAchieved(toy.PointEnv):
    def __init__(self) -> None:
        super().__init__()
        keys = ("observation", "desired_goal")
        self.observation_space = spaces.Dict({key: self.observation_space[key] for key in keys})


class Discrete(toy.PointEnv):
    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Discrete(3)


class CannotBeMade(toy.PointEnv):
    def __init__(self) -> None:
        raise OSError("the robot's model is missing")


class RaisesInReset(toy.PointEnv):
    def reset(self, **options: Any) -> Any:
        raise ZeroDivisionError("no start")


class RaisesInStep(toy.PointEnv):
    """Works for a while: the run has a checkpoint by then."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        if AFTER_STEPS[0] <= 0:
            self.fail(obs)
        AFTER_STEPS[0] -= 1
        return obs, reward, terminated, truncated, info

    def fail(self, obs: dict[str, np.ndarray]) -> None:
        raise ZeroDivisionError("the gripper left the table")


class ReturnsNan(RaisesInStep):
    def fail(self, obs: dict[str, np.ndarray]) -> None:
        obs["achieved_goal"][1] = np.nan


class NoSuccess(toy.PointEnv):
    compute_reward = is_success = None  # type: ignore[assignment]

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        return self._observe(), -1.0, False, self.steps >= toy.HORIZON, {}


class NoReward(toy.PointEnv):
    compute_reward = None  # type: ignore[assignment]


AFTER_STEPS = [0]  # of all copies together, until RaisesInStep and ReturnsNan fail
for kind in (
    NoGoal,
    NoAchieved,
    Discrete,
    CannotBeMade,
    RaisesInReset,
    RaisesInStep,
    ReturnsNan,
    NoSuccess,
    NoReward,
):
    gym.register(f"{kind.__name__}-v0", entry_point=kind, max_episode_steps=toy.HORIZON)
gym.register("Endless-v0", entry_point=toy.PointEnv)
gym.register("Good-v0", entry_point=toy.PointEnv, max_episode_steps=toy.HORIZON)
