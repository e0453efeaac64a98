"""Episodes of tests and validations: what they take from policy and environment, what they tell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import toy
from imagined import N
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_follow_object.callbacks.rollout import run_episodes


@pytest.mark.parametrize(
    ("policy", "info", "sentence"),
    [
        (lambda obs: np.zeros(3), {}, r"the policy's actions must have the shape \(4, 3\)"),
        (lambda obs: np.zeros((1, 3)), {}, r"\(4, 3\), not \(1, 3\)"),
        (None, {"is_success": np.nan}, "is_success in the info must give one finite number"),
        (None, {"is_success": np.zeros(2)}, r"one finite number, not the shape \(2,\)"),
        (None, {"is_success": None}, "is_success in the info"),
    ],
)
def test_episodes_take_nothing_that_does_not_fit(
    policy: Any, info: dict[str, Any], sentence: str
) -> None:
    class Odd(toy.PointEnv):
        def step(self, action: np.ndarray) -> Any:
            *rest, own = super().step(action)
            return *rest, {**own, **info}

    zeros = np.zeros((N, 3), np.float32)
    with pytest.raises(ValueError, match=sentence):
        run_episodes(policy or (lambda obs: zeros), DummyVecEnv([Odd] * N), N)


def test_episodes_that_leave_their_goal_have_reached_it() -> None:
    class Passing(toy.PointEnv):
        def step(self, action: np.ndarray) -> Any:
            *rest, truncated, info = super().step(action)
            first = self.steps == 1
            return *rest, truncated, {**info, "is_success": first and self.passes}

        def reset(self, **options: Any) -> Any:
            self.passes = not getattr(self, "passes", False)  # every other episode
            return super().reset(**options)

    episodes = run_episodes(lambda obs: np.zeros((1, 3), np.float32), DummyVecEnv([Passing]), 4)
    assert episodes.success.tolist() == [False] * 4
    assert episodes.reached.tolist() == [True, False, True, False]


def test_rewards_of_a_vectorised_environment_are_not_broadcast() -> None:
    class Scalar(DummyVecEnv):
        def step_wait(self) -> Any:
            obs, rewards, dones, infos = super().step_wait()
            return obs, rewards[0], dones, infos

    with pytest.raises(ValueError, match="the environment's step must accept batches"):
        run_episodes(lambda obs: np.zeros((N, 3)), Scalar([toy.PointEnv] * N), N)
