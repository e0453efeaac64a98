"""A fast goal environment: the object is a point that the action moves."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.goal_predictor import GoalPredictor

HORIZON = 10
STEP = 0.05  # metres an action of 1 moves the point
THRESHOLD = 0.05  # metres
REACH = 0.3  # goals lie this far from the start, metres


class PointEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """The point starts near the origin; the goal lies REACH away, so T steps are enough."""

    def __init__(self, dtype: str = "float64") -> None:
        box = spaces.Box(-np.inf, np.inf, (3,), np.dtype(dtype).type)
        self.observation_space = spaces.Dict(
            {"observation": box, "achieved_goal": box, "desired_goal": box}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.dtype = dtype

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-0.1, 0.1, 3)
        direction = self.np_random.normal(size=3)
        self.goal = self.position + REACH * direction / np.linalg.norm(direction)
        self.steps = 0
        return self._observe(), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        self.position = self.position + STEP * np.clip(action, -1, 1)
        self.steps += 1
        obs = self._observe()
        info = {"is_success": bool(self.is_success(obs["achieved_goal"], obs["desired_goal"]))}
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info))
        return obs, reward, False, self.steps >= HORIZON, info

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return self.is_success(achieved, desired).astype(np.float32) - 1.0

    def is_success(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.subtract(achieved, desired), axis=-1) <= THRESHOLD

    def _observe(self) -> dict[str, np.ndarray]:
        position = self.position.astype(self.dtype)
        return {
            "observation": position,
            "achieved_goal": position.copy(),
            "desired_goal": self.goal.astype(self.dtype),
        }


def paths(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Straight paths at the point's full speed, which then rest on the goal."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(-0.1, 0.1, (n, 3))
    direction = rng.normal(size=(n, 3))
    goal = start + REACH * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    share = np.minimum(1.0, np.arange(HORIZON + 1) * STEP / REACH)
    return start[:, None] + share[:, None] * (goal - start)[:, None], goal


class StraightPredictor(GoalPredictor):
    """Imagines the paths above exactly: what the wrappers show can then be computed."""

    env_id = "Point-v0"

    def __init__(self) -> None:
        self.horizon = HORIZON

    def predict(
        self, start: np.ndarray, goal: np.ndarray, k: np.ndarray, contexts: Any = None
    ) -> np.ndarray:
        share = np.minimum(1.0, np.asarray(k) * STEP / REACH)[:, None]
        return (start + share * (goal - start)).astype(np.float64)


def curriculum(**options: Any) -> Curriculum:
    """A curriculum of the toy's horizon."""
    return Curriculum(HORIZON, **options)
