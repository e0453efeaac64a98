"""What goals are is asked of their space: another kind needs no other code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import toy
from gymnasium import spaces
from small_buffers import fill
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_follow_object.envs.goal_space import (
    KINDS,
    POSITIONS,
    GoalSpace,
    followed_space,
    goal_space,
)
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.imagined_goals import draw_goals, points_along
from sb3_follow_object.imagination.predictor_files import FACTS_FILE
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


def test_positions_are_metres_apart() -> None:
    first, second = np.array([[0.0, 0.0, 0.1], [1.0, 1.0, 1.0]]), np.array([0.3, 0.4, 0.1])
    np.testing.assert_allclose(POSITIONS.distance(first, second), [0.5, np.sqrt(1.66)])
    tensors = th.from_numpy(first), th.from_numpy(second)
    np.testing.assert_allclose(POSITIONS.distance(*tensors).numpy(), [0.5, np.sqrt(1.66)])
    np.testing.assert_array_equal(POSITIONS.height(first), [0.1, 1.0])
    np.testing.assert_array_equal(POSITIONS.point(first), first)
    halfway = POSITIONS.between(first, second, np.array([0.5, 0.0]))
    np.testing.assert_allclose(halfway, [[0.15, 0.2, 0.1], [1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(POSITIONS.decode(POSITIONS.encode(first)), first)


def test_other_vectors_are_compared_but_not_followed() -> None:
    assert goal_space((3,)) is followed_space((3,)) is POSITIONS
    plane = goal_space((2,))
    assert (plane.kind, plane.size) == ("vector", 2)
    assert plane.distance(np.zeros(2), np.array([0.3, 0.4])) == pytest.approx(0.5)
    for shape in ((2,), (7,), (1, 3), ()):
        with pytest.raises(ValueError, match=r"have the shape .*; what can be followed are pos"):
            followed_space(shape)
    with pytest.raises(ValueError, match="are of no single shape; what can be followed are pos"):
        followed_space(None)


class Turned(GoalSpace):
    """A position and an angle: 0.1 m as far as a turn by 1 rad."""

    kind = "turned"
    said = "positions with an angle"

    def __init__(self) -> None:
        super().__init__(4)
        self.n_encoded = 5

    def distance(self, first: Any, second: Any) -> Any:
        turn = np.abs(wrapped(first[..., 3] - second[..., 3]))
        return np.maximum(np.linalg.norm(first[..., :3] - second[..., :3], axis=-1), 0.1 * turn)

    def between(self, first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
        way = second - first
        way[..., 3] = wrapped(way[..., 3])
        return first + share[..., None] * way

    def encode(self, goals: np.ndarray) -> np.ndarray:
        angle = goals[..., 3:]
        return np.concatenate([goals[..., :3], np.cos(angle), np.sin(angle)], axis=-1)

    def decode(self, encoded: np.ndarray) -> np.ndarray:
        angle = np.arctan2(encoded[..., 4:], encoded[..., 3:4])
        return np.concatenate([encoded[..., :3], angle], axis=-1)


def wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


class TurningEnv(toy.PointEnv):
    """The point with an angle that follows its first coordinate."""

    def __init__(self) -> None:
        super().__init__()
        goal = spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.observation_space = spaces.Dict(
            {"observation": goal, "achieved_goal": goal, "desired_goal": goal}
        )

    def _observe(self) -> dict[str, np.ndarray]:
        here, there = (turned(place) for place in (self.position, self.goal))
        return {"observation": here, "achieved_goal": here, "desired_goal": there}

    def is_success(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return Turned().distance(np.asarray(achieved), np.asarray(desired)) <= toy.THRESHOLD


def turned(positions: np.ndarray) -> np.ndarray:
    """Positions (..., 3) with an angle that passes from pi to -pi where the first one is 0."""
    return np.concatenate([positions, wrapped(np.pi + 5 * positions[..., :1])], axis=-1)


@pytest.fixture
def another_kind(monkeypatch: pytest.MonkeyPatch) -> Turned:
    space = Turned()
    monkeypatch.setitem(KINDS, space.kind, space)
    return space


def test_another_kind_of_goal_is_imagined_kept_and_replayed(
    another_kind: Turned, tmp_path: Path
) -> None:
    paths, goals = (turned(each) for each in toy.paths(150))
    facts: dict[str, Any] = {"env_id": "Turning-v0", "physics": "abc", "hidden": (64, 64)}
    fitted = GoalPredictor.fit(paths, goals, learning_rate=3e-3, **facts)
    fitted.save(tmp_path)
    assert json.loads((tmp_path / FACTS_FILE).read_text())["goals"] == "turned"
    predictor = GoalPredictor.load(tmp_path)
    assert predictor.space is another_kind
    unseen, aims = (turned(each) for each in toy.paths(50, seed=7))
    imagined = predictor.paths(unseen[:, 0], aims)
    assert another_kind.distance(imagined, unseen).mean() < 0.02, "also where the angle wraps"
    assert np.abs(imagined[..., 3]).max() <= np.pi

    curriculum = Curriculum(toy.HORIZON, levels="path", n_levels=4, p=0.0, min_distance=0.1)
    shown, level = draw_goals(predictor, curriculum, unseen[:, 0], aims, np.random.default_rng(0))
    assert (another_kind.distance(shown, unseen[:, 0])[level > 0] >= 0.1).all() and level.any()
    env = ImaginedGoalVecEnv(DummyVecEnv([TurningEnv] * 2), predictor, curriculum)
    env.seed(0)
    buffer = FollowObjectReplayBuffer(
        200,
        env.observation_space,
        env.action_space,
        env,
        n_envs=2,
        moved_ratio=0.5,
        moved_distance=0.02,
        min_goal_distance=0.05,
        moved_priority="energy",
        imagined_ratio=0.5,
        seed=0,
    )
    fill([buffer], env, toy.HORIZON)
    first, last = (buffer.observations["achieved_goal"][at] for at in (0, toy.HORIZON - 1))
    assert first.shape == (2, 4)
    far = another_kind.distance(last, first) >= 0.05  # what the step before has achieved
    np.testing.assert_array_equal(buffer._far[toy.HORIZON - 2], far)
    assert buffer.sample(32).observations["desired_goal"].shape == (32, 4)


def test_points_along_a_way_are_on_it_in_its_own_space(another_kind: Turned) -> None:
    way = np.array([[[0.0, 0.0, 0.0, 3.0], [0.0, 0.0, 0.0, -3.0]]])  # 0.28 rad by the short way
    (points,) = points_along(way, np.array([0.0, 0.5, 1.0]), another_kind)
    np.testing.assert_allclose(
        wrapped(points[:, 3] - np.pi), [3.0 - np.pi, 0.0, np.pi - 3.0], atol=1e-9
    )
