"""Environments that no goals can be imagined in, and what somebody's methods may answer."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import toy
from gymnasium import spaces
from imagined import N, check_transitions, episodes, imagining, play
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper


def without(*names: str) -> gym.Env:
    """A toy environment that lacks methods."""

    class Poor(toy.PointEnv):
        def __getattribute__(self, name: str) -> Any:
            if name in names:
                raise AttributeError(name)
            return super().__getattribute__(name)

    return Poor()


class FlatGoals(toy.PointEnv):
    """A toy environment whose goals are points of a plane."""

    def __init__(self) -> None:
        super().__init__()
        goal = spaces.Box(-1, 1, (2,), np.float64)
        box = cast(spaces.Dict, self.observation_space)["observation"]
        self.observation_space = spaces.Dict(
            {"observation": box, "achieved_goal": goal, "desired_goal": goal}
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), r"lacks \['achieved_goal', 'desired_goal', 'obs"),
        (FlatGoals, r"goals have the shape \(2,\); .* positions of an object, of the shape \(3,\)"),
        (lambda: without("compute_reward"), "compute_reward"),
        (lambda: without("is_success"), "is_success"),
    ],
)
def test_environments_without_goals_are_refused(make: Callable[[], gym.Env], message: str) -> None:
    predictor, curriculum = toy.StraightPredictor(), toy.curriculum()
    with pytest.raises(ValueError, match=message):
        ImaginedGoalWrapper(make(), predictor, curriculum)
    with pytest.raises(ValueError, match=message):
        ImaginedGoalVecEnv(DummyVecEnv([make]), predictor, curriculum)


def test_what_has_the_name_of_a_method_and_is_none_judges_nothing() -> None:
    class Odd(gym.Wrapper):
        is_success = False

        def _is_success(self, achieved: Any, desired: Any) -> bool:
            return bool(np.linalg.norm(achieved - desired) <= toy.THRESHOLD)

    env = ImaginedGoalWrapper(Odd(toy.PointEnv()), toy.StraightPredictor(), toy.curriculum(p=0.0))
    env.reset(seed=0)
    obs, _, _, _, info = env.step(np.zeros(3, np.float32))
    near = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"]) <= toy.THRESHOLD
    assert info["is_success"] == near


def test_other_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="mode must be one of"):
        imagining(toy.curriculum(), "tset")
    with pytest.raises(ValueError, match="imagines 10 steps, but the curriculum has horizon 50"):
        imagining(Curriculum(50))


def test_rewards_that_take_no_batches_are_refused() -> None:
    class OneByOne(toy.PointEnv):
        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return np.float32(np.linalg.norm(achieved - desired) <= 0.05) - 1

    venv = imagining(toy.curriculum(p=0.0), env=OneByOne)
    venv.reset()
    with pytest.raises(ValueError, match="compute_reward must accept batches"):
        venv.step(np.zeros((N, 3), np.float32))


# What comes from outside


class Answers(toy.PointEnv):
    """Somebody's methods, which give one goal's answer in an array of one."""

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.asarray(toy.PointEnv.is_success(self, achieved, desired))[..., None] - 1.0

    def is_success(self, achieved: Any, desired: Any) -> Any:
        return np.asarray(super().is_success(achieved, desired))[..., None]

    def step(self, action: np.ndarray) -> Any:
        self.position = self.position + toy.STEP * np.clip(action, -1, 1)
        self.steps += 1
        paid = float(toy.PointEnv.is_success(self, self.position, self.goal)) - 1.0
        return self._observe(), paid, False, self.steps >= toy.HORIZON, {}


def many(env: type[gym.Env], **options: Any) -> VecEnv:
    return imagining(toy.curriculum(p=0.0, **options), env=env)


def one(env: type[gym.Env], **options: Any) -> VecEnv:
    curriculum = toy.curriculum(p=0.0, **options)
    wrapped = ImaginedGoalWrapper(env(), toy.StraightPredictor(), curriculum)
    return DummyVecEnv([lambda: wrapped])


@pytest.mark.parametrize("make", [many, one])
def test_answers_in_arrays_of_one_are_numbers(make: Callable[..., VecEnv]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        finished = episodes(make(Answers, k_max=5), 20)
    check_transitions(toy.curriculum(k_max=5), finished)


def returning(method: str, answer: Any) -> type[gym.Env]:
    class Odd(Answers):
        pass

    setattr(Odd, method, lambda self, *asked: answer)
    return Odd


@pytest.mark.parametrize("make", [many, one])
@pytest.mark.parametrize("method", ["compute_reward", "is_success"])
@pytest.mark.parametrize(
    "answer", [None, np.zeros(7), np.zeros((4, 2)), "yes", [1.0, [2.0]], np.nan, [np.nan] * 4]
)
def test_other_answers_are_a_sentence(
    answer: Any, method: str, make: Callable[..., VecEnv]
) -> None:
    with pytest.raises(ValueError, match=f"the environment's {method} (must|returned)"):
        episodes(make(returning(method, answer)), 2)


@pytest.mark.parametrize("make", [many, one])
@pytest.mark.parametrize("when", [3, toy.HORIZON])
def test_goals_that_move_within_an_episode_are_refused(
    when: int, make: Callable[..., VecEnv]
) -> None:
    class Moving(toy.PointEnv):
        def step(self, action: np.ndarray) -> Any:
            if self.steps == when - 1:
                self.goal = self.goal + 0.01
            return super().step(action)

    venv = make(Moving)
    assert sum(1 for _ in play(venv, when - 1)) == (when - 1) * venv.num_envs
    with pytest.raises(ValueError, match=r"goal stays the same within an episode; .* moved"):
        episodes(venv, when)


@pytest.mark.parametrize("make", [many, one])
def test_an_environment_that_ends_at_its_goal_does_so_at_the_original_one(
    make: Callable[..., VecEnv],
) -> None:
    class Ends(toy.PointEnv):
        def step(self, action: np.ndarray) -> Any:
            obs, reward, _, truncated, info = super().step(action)
            return obs, reward, info["is_success"], truncated, info

    venv = make(Ends, k_max=3, sampling="max")
    obs: Any = venv.reset()
    goals = np.array([info["original_goal"] for info in venv.reset_infos])
    early = np.zeros(venv.num_envs, dtype=bool)
    for _ in range(toy.HORIZON - 1):
        way = goals - obs["achieved_goal"]
        way /= np.linalg.norm(way, axis=1, keepdims=True)  # straight, past the goals shown
        before = obs["desired_goal"]
        obs, rewards, dones, infos = venv.step(way.astype(np.float32))
        early |= [info["is_success"] and not done for info, done in zip(infos, dones, strict=True)]
        for i, info in enumerate(infos):
            assert dones[i] == info["original_success"]
            assert rewards[i] == info["is_success"] - 1.0, "paid for the goal shown"
            if dones[i]:
                assert not info["TimeLimit.truncated"]
                shown = info["terminal_observation"]["desired_goal"]
                np.testing.assert_array_equal(shown, before[i])
        if dones.any():
            break
    assert dones.any() and early.all(), "they went on where the goal shown was reached"


def test_observations_and_imagined_goals_of_another_shape_are_refused() -> None:
    class Flat(toy.PointEnv):
        def _observe(self) -> dict[str, np.ndarray]:
            return {**super()._observe(), "desired_goal": np.zeros((1, 3))}

    wrapped = ImaginedGoalWrapper(Flat(), toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match=r"'desired_goal' must have the shape \(3,\), not \(1, 3"):
        wrapped.reset()

    class One(toy.StraightPredictor):
        def predict(self, *asked: Any) -> np.ndarray:
            return super().predict(*asked)[:1]

    venv = ImaginedGoalVecEnv(DummyVecEnv([toy.PointEnv] * N), One(), toy.curriculum(p=0.0))
    with pytest.raises(ValueError, match=r"the predictor imagines must have the shape \(4, 3\)"):
        venv.reset()


def test_a_vectorised_environment_must_tell_how_episodes_end() -> None:
    class Forgets(DummyVecEnv):
        def step_wait(self) -> Any:
            obs, rewards, dones, infos = super().step_wait()
            for info in infos:
                info.pop("terminal_observation", None)
            return obs, rewards, dones, infos

    inner = Forgets([toy.PointEnv] * 2)
    venv = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match="no 'terminal_observation' at the end of an episode"):
        episodes(venv, toy.HORIZON)
