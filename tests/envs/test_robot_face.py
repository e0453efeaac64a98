"""Environments of others are shown with goals, success and rewards of -1 and 0."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy

from sb3_follow_object.envs.goal_envs import check_task, success_method
from sb3_follow_object.envs.robot_face import RobotTask, needs_face


class ZeroOne(toy.PointEnv):
    """Pays 1 on the goal, says "success", and judges one goal at a time."""

    is_success = None  # type: ignore[assignment]

    def step(self, action: np.ndarray) -> Any:
        obs, _, terminated, truncated, info = super_step(self, action)
        reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
        return obs, float(reward), terminated, truncated, {"success": bool(reward)}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return float(np.linalg.norm(np.subtract(achieved, desired)) <= toy.THRESHOLD)


def super_step(env: toy.PointEnv, action: np.ndarray) -> Any:
    env.position = env.position + toy.STEP * np.clip(action, -1, 1)
    env.steps += 1
    return env._observe(), 0.0, False, env.steps >= toy.HORIZON, {}


class Vector(toy.PointEnv):
    """Has no goals in its observations, but a simulation's worth of attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = self.observation_space["observation"]

    def _observe(self) -> Any:
        return self.position

    def step(self, action: np.ndarray) -> Any:
        return super_step(self, action)


class Dense(toy.PointEnv):
    is_success = None  # type: ignore[assignment]

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return -np.linalg.norm(np.subtract(achieved, desired), axis=-1)


class Mute(toy.PointEnv):
    is_success = compute_reward = None  # type: ignore[assignment]


gym.register("ZeroOne-v0", ZeroOne, max_episode_steps=toy.HORIZON)
FAR = np.array([5.0, 0.0, 0.0])


def test_rewards_of_one_and_zero_are_shown_as_zero_and_minus_one() -> None:
    assert needs_face(ZeroOne())
    env = RobotTask(ZeroOne())
    obs, _ = env.reset(seed=0)
    assert env.shifted
    goal = obs["desired_goal"]
    rows = np.stack([goal, goal + FAR, goal])
    rewards = env.compute_reward(rows, np.stack([goal] * 3), None)
    np.testing.assert_array_equal(rewards, [0.0, -1.0, 0.0])
    assert rewards.dtype == np.float32
    _, reward, _, _, info = env.step(np.zeros(3))
    assert (reward, info["is_success"], info["success"]) == (-1.0, False, False)


def test_one_goal_at_a_time_is_asked_row_by_row_and_never_broadcast() -> None:
    asked: list[tuple[int, ...]] = []

    def is_success(achieved: np.ndarray, desired: np.ndarray) -> bool:
        asked.append(achieved.shape)
        return bool(np.linalg.norm(achieved - desired) < 0.1)

    env = RobotTask(toy.PointEnv(), is_success=is_success)
    goal = env.reset(seed=0)[0]["desired_goal"]
    asked.clear()
    rows = goal + np.linspace(0.0, 0.2, 4)[:, None] * [[1.0, 0.0, 0.0]]
    told = env.is_success(rows.reshape(2, 2, 3), np.broadcast_to(goal, (2, 2, 3)))
    assert told.tolist() == [[True, True], [False, False]]
    assert asked == [(3,)] * 4


def test_batches_are_asked_where_they_are_answered() -> None:
    asked: list[tuple[int, ...]] = []

    def is_success(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        asked.append(achieved.shape)
        return np.linalg.norm(achieved - desired, axis=-1) < 0.1

    env = RobotTask(toy.PointEnv(), is_success=is_success)
    goal = env.reset(seed=0)[0]["desired_goal"]
    asked.clear()
    assert env.is_success(np.stack([goal, goal + FAR]), np.stack([goal, goal])).tolist() == [1, 0]
    assert asked == [(2, 3)]


def test_two_functions_make_a_goal_environment() -> None:
    def goal(env: Any, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return obs, env.goal

    env = RobotTask(Vector(), goal, lambda a, d: np.linalg.norm(a - d, axis=-1) < 0.05)
    obs, _ = env.reset(seed=3)
    assert env.observation_space.contains(obs)
    np.testing.assert_array_equal(obs["achieved_goal"], env.unwrapped.position)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(obs["desired_goal"], env.unwrapped.goal)  # type: ignore[attr-defined]
    assert env.step(np.ones(3))[4]["is_success"] is False


class Seen(gym.Wrapper):
    """Shows a picture, or a mode, besides numbers."""

    def __init__(self, what: str) -> None:
        super().__init__(toy.PointEnv())
        shown: dict[str, gym.Space] = {
            "camera": gym.spaces.Box(0, 255, (4, 4, 3), np.uint8),
            "mode": gym.spaces.Discrete(4),
        }
        held = {"place": gym.spaces.Box(-1.0, 1.0, (3,)), what: shown[what]}
        keys = self.env.observation_space.spaces  # type: ignore[attr-defined]
        self.observation_space = gym.spaces.Dict({**keys, "observation": gym.spaces.Dict(held)})


def two(env: Any, obs: Any) -> tuple[np.ndarray, np.ndarray]:
    return env.position, env.goal


class Counted(toy.PointEnv):
    """Observations are whole numbers."""

    def __init__(self) -> None:
        super().__init__()
        keys = dict(self.observation_space.spaces)
        keys["observation"] = gym.spaces.Box(-9, 9, (3,), np.int64)
        self.observation_space = gym.spaces.Dict(keys)

    def reset(self, **options: Any) -> Any:
        obs, info = super().reset(**options)
        return {**obs, "observation": np.arange(3)}, info


def test_an_effector_keeps_its_fractions_beside_whole_numbers() -> None:
    env = RobotTask(Counted(), effector=lambda env: np.array([0.25, 0.5, 0.75]))
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(obs["observation"], [0.0, 1.0, 2.0, 0.25, 0.5, 0.75])
    assert env.observation_space.contains(obs) and env.told_effector == (3, 4, 5)


def test_rewards_are_not_asked_where_success_is_said() -> None:
    env = RobotTask(Dense(), is_success=lambda a, d: np.linalg.norm(a - d, axis=-1) < 0.1)
    goal = env.reset(seed=0)[0]["desired_goal"]
    assert env.compute_reward(
        np.stack([goal, goal + FAR]), np.stack([goal] * 2), None
    ).tolist() == [
        0.0,
        -1.0,
    ]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: RobotTask(Vector()), "Vector has no goals: its observations lack achieved_goal"),
        (lambda: RobotTask(Dense()), "Dense pays 0 on the goal and -0.001 at 0.001 m from"),
        (lambda: RobotTask(Mute()), "Mute does not tell when a goal is reached"),
        (
            lambda: RobotTask(toy.PointEnv(), is_success=lambda a, d: np.linalg.norm(a - d) > 1),
            "PointEnv says of its goal that it is not reached there",
        ),
        (
            lambda: RobotTask(Vector(), lambda env, obs: (obs[:2], env.goal)),
            r"two positions of the shape \(3,\); the achieved one has the shape \(2,\)",
        ),
        (
            lambda: RobotTask(toy.PointEnv(), effector=lambda env: env.position[:2]),
            r"effector= must return a position of the shape \(3,\), not \(2,\)",
        ),
        (lambda: RobotTask(Seen("camera"), two), "hold pictures at 'camera', which cannot"),
        (
            lambda: RobotTask(Seen("mode"), two),
            "hold a Discrete at 'mode', which cannot",
        ),
        (
            lambda: RobotTask(Seen("camera"), effector=lambda env: env.position),
            "effector= needs observations that are a row of numbers",
        ),
        (
            lambda: RobotTask(ZeroOne(), two),
            "ZeroOne does not tell when a goal is reached, by is_success; say it with",
        ),
    ],
)
def test_what_tells_too_little_is_refused(make: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make().reset(seed=0)


def test_what_answers_already_is_left_as_it_is() -> None:
    assert not needs_face(toy.PointEnv())
    assert check_task("ZeroOne-v0") == "ZeroOne-v0", "what it lacks can be added"


class Odd(toy.PointEnv):
    """Has a number of the name of its method."""

    is_success = False  # type: ignore[assignment]

    def _is_success(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1) <= toy.THRESHOLD


def test_what_has_the_name_of_a_method_and_is_none_does_not_count() -> None:
    assert success_method(toy.PointEnv().get_wrapper_attr) == "is_success"
    assert success_method(Odd().get_wrapper_attr) == "_is_success"
    assert success_method(Mute().get_wrapper_attr) is None
