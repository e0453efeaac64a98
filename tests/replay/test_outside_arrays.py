"""Rewards, observations and ends of episodes that do not fit are refused: nothing is broadcast."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from numbered import ALGORITHMS, learner
from small_buffers import as_arrays, fill, make_buffer, make_env
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import HORIZON, THRESHOLD, PointEnv

from sb3_follow_object.replay.device_replay import DeviceReplay


def within(achieved: Any, desired: Any) -> Any:
    return np.linalg.norm(achieved - desired, axis=-1) <= THRESHOLD


def forgets_the_axis(achieved: Any, desired: Any, infos: Any) -> Any:
    return 0.0 if np.linalg.norm(achieved - desired) <= THRESHOLD else -1.0


GOOD: dict[str, Callable[..., Any]] = {
    "(n,)": lambda a, d, i: within(a, d) - 1.0,
    "(n, 1)": lambda a, d, i: within(a, d)[..., None] - 1.0,
    "float64 list": lambda a, d, i: list(np.atleast_1d(within(a, d) - 1.0)),
    "whole numbers": lambda a, d, i: within(a, d).astype(int) - 1,
    "tensor": lambda a, d, i: th.as_tensor(within(a, d) - 1.0),
}
BAD: dict[str, tuple[Callable[..., Any], str]] = {
    "one": (forgets_the_axis, r"must accept batches: .* must return (\d+) numbers, .*not "),
    "(1,)": (lambda a, d, i: np.zeros(1), "must accept batches"),
    "one too few": (lambda a, d, i: np.zeros(len(a) - 1), "must accept batches"),
    "(n, n)": (lambda a, d, i: np.zeros((len(a), len(a))), r"not the shape \(\d+, \d+\)"),
    "(n, 3)": (lambda a, d, i: a - d, r"not the shape \(\d+, 3\)"),
    "nothing": (lambda a, d, i: None, "not something of the type object"),
    "words": (lambda a, d, i: ["good"] * len(a), "not something of the type"),
    "NaN": (lambda a, d, i: np.full(len(a), np.nan), "returned NaN or infinity"),
}


def env_that_pays(reward: Callable[..., Any], n_envs: int = 2) -> DummyVecEnv:
    """Its own steps are paid as they should be; compute_reward is somebody's."""

    class Paying(PointEnv):
        def step(self, action: np.ndarray) -> Any:
            self.position = self.position + 0.05 * np.clip(action, -1, 1)
            self.steps += 1
            obs = self._observe()
            paid = float(within(obs["achieved_goal"], obs["desired_goal"])) - 1.0
            return obs, paid, False, self.steps >= HORIZON, {}

        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return reward(achieved, desired, info)

    return make_env(n_envs, Paying)


@pytest.mark.parametrize("asked", ["compute_reward", "reward_function"])
@pytest.mark.parametrize("case", GOOD)
def test_an_answer_of_one_number_each_is_what_the_samples_hold(case: str, asked: str) -> None:
    env = env_that_pays(GOOD[case])
    own = {"reward_function": GOOD[case]} if asked == "reward_function" else {}
    buffer = make_buffer(env, **own)
    fill([buffer], env, 10 * HORIZON)
    got = as_arrays(buffer.sample(2000))
    expected = within(got["next_achieved"], got["goal"]) - 1.0
    np.testing.assert_array_equal(got["reward"], expected)
    assert 0.05 < (got["reward"] == 0).mean() < 0.95


@pytest.mark.parametrize("asked", ["compute_reward", "reward_function"])
@pytest.mark.parametrize("case", BAD)
def test_any_other_answer_is_one_sentence(case: str, asked: str) -> None:
    reward, sentence = BAD[case]
    env = env_that_pays(reward)
    own = {"reward_function": reward} if asked == "reward_function" else {}
    buffer = make_buffer(env, **own)
    fill([buffer], env, 10 * HORIZON)
    with pytest.raises(ValueError, match=f"{asked} .*{sentence}|{asked} {sentence}"):
        buffer.sample(100)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_algorithms_stop_with_the_sentence(name: str) -> None:
    with pytest.raises(ValueError, match="compute_reward must accept batches"):
        learner(name, env_that_pays(forgets_the_axis)).learn(300)


@pytest.mark.parametrize("case", GOOD)
def test_what_the_stock_buffer_accepts_is_accepted(case: str) -> None:
    """Of arrays; lists it refuses."""
    env = env_that_pays(GOOD[case])
    theirs = HerReplayBuffer(200, env.observation_space, env.action_space, env, "cpu", 2)  # type: ignore[arg-type]
    fill([theirs], env, 3 * HORIZON)
    accepted = True
    try:
        theirs.sample(64)
    except (AttributeError, TypeError):
        accepted = False
    assert accepted or case in ("float64 list", "tensor")


def test_replay_on_the_device_takes_the_same_answers() -> None:
    env = env_that_pays(GOOD["(n, 1)"])
    buffer = make_buffer(env)
    assert DeviceReplay(buffer, th.device("cpu"), 0).reward.threshold == THRESHOLD
    with pytest.raises(ValueError, match="compute_reward must accept batches"):
        DeviceReplay(make_buffer(env_that_pays(forgets_the_axis)), th.device("cpu"), 0)


def test_an_environment_without_compute_reward_is_refused_at_once() -> None:
    class Poor(gym.Wrapper):
        def has_wrapper_attr(self, name: str) -> bool:
            return name != "compute_reward" and super().has_wrapper_attr(name)

        def get_wrapper_attr(self, name: str) -> Any:
            if name == "compute_reward":
                raise AttributeError(name)
            return super().get_wrapper_attr(name)

    env = DummyVecEnv([lambda: Poor(PointEnv())])
    with pytest.raises(ValueError, match="hindsight needs an environment with compute_reward"):
        make_buffer(env)
    make_buffer(env, n_sampled_goal=0)  # asks for nothing
    make_buffer(env, reward_function=GOOD["(n,)"])


def a_step(n_envs: int = 3) -> dict[str, Any]:
    obs = {key: np.zeros((n_envs, 3)) for key in ("observation", "achieved_goal", "desired_goal")}
    return {
        "obs": obs,
        "next_obs": dict(obs),
        "action": np.zeros((n_envs, 3), np.float32),
        "reward": np.zeros(n_envs),
        "done": np.ones(n_envs, dtype=bool),
        "infos": [{"terminal_observation": {key: np.zeros(3) for key in obs}}] * n_envs,
    }


def with_goal(value: Any, half: str = "obs") -> Any:
    return lambda step: step[half].update(desired_goal=value)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (with_goal(np.zeros(3)), r"observation 'desired_goal' has the shape \(3,\), not \(3, 3\)"),
        (with_goal(np.zeros((3, 1)), "next_obs"), "the next observation 'desired_goal'"),
        (with_goal(np.float64(0.0)), r"has the shape \(\)"),
        (with_goal(np.full((3, 3), np.nan)), "'desired_goal' of environment 0 holds NaN"),
        (with_goal(np.full((3, 3), 1e300)), "holds NaN or infinity in float32"),
        (lambda step: step.update(reward=0.0), r"the reward has the shape \(\), not \(3,\)"),
        (lambda step: step.update(reward=np.zeros((3, 3))), r"the reward has the shape \(3, 3\)"),
        (lambda step: step.update(reward=np.array([0, np.inf, 0])), "the reward of environment 1"),
        (lambda step: step.update(action=np.zeros(3)), r"the action has the shape \(3,\)"),
        (lambda step: step.update(done=True), "the end of the episode has the shape"),
        (lambda step: step.update(infos=[{}]), "there are 1 infos for 3 environments"),
        (
            lambda step: step["infos"][0]["terminal_observation"].update(achieved_goal=0.0),
            r"the terminal observation 'achieved_goal' has the shape \(\), not \(3,\)",
        ),
    ],
)
def test_a_step_that_does_not_fit_is_not_stored(change: Any, sentence: str) -> None:
    buffer = make_buffer(make_env(3))
    for _ in range(2):
        buffer.add(**a_step())
    step = a_step()
    change(step)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=sentence):
            buffer.add(**step)
    assert buffer.pos == 2 and buffer.table.n_transitions() == 6
    buffer.add(**a_step())
    assert buffer.table.n_transitions() == 9


def full_of_steps(**options: Any) -> Any:
    """Two slots of three environments: the third step has overwritten the first."""
    buffer = make_buffer(make_env(3), size=6, **options)
    for value in range(3):
        step = a_step()
        step["obs"]["observation"] = np.full((3, 3), float(value))
        buffer.add(**step)
    return buffer


def lacks_an_observation(step: dict[str, Any]) -> None:
    step["next_obs"].pop("observation")


@pytest.mark.parametrize("moves", [False, True], ids=["still", "moving goal"])
@pytest.mark.parametrize(
    ("change", "error"),
    [
        (with_goal(np.full((3, 3), np.nan), "next_obs"), "NaN"),
        (lambda step: step["next_obs"].update(observation=np.full((3, 3), np.nan)), "NaN"),
        (lambda step: step.update(infos=[{}] * 2), "there are 2 infos for 3"),
        (lacks_an_observation, "observation"),
    ],
)
def test_a_step_that_is_refused_leaves_all_as_it_was(change: Any, error: str, moves: bool) -> None:
    buffer = full_of_steps()
    before = copy.deepcopy(buffer)
    step = a_step()
    step["obs"]["observation"] = np.full((3, 3), 9.0)
    if moves:
        step["next_obs"]["desired_goal"] = np.full((3, 3), 2.0)
    change(step)
    with pytest.raises((ValueError, KeyError), match=error):
        buffer.add(**step)
    assert buffer.table.n_transitions() == 6
    assert buffer.goals_are_shared
    assert buffer.next_observations["desired_goal"] is buffer.observations["desired_goal"]
    for name, store in before._stores().items():
        np.testing.assert_array_equal(buffer._stores()[name], store, err_msg=name)
    assert set(buffer.sample(100).observations["observation"].ravel().tolist()) == {1.0, 2.0}


@pytest.mark.parametrize("key", ["executed_action", "given_action"])
@pytest.mark.parametrize("lacking", [0, 2])
def test_what_was_executed_is_told_of_every_environment_or_refused(key: str, lacking: int) -> None:
    told = {"executed_action": np.full(3, 0.5, np.float32), "given_action": np.zeros(3, np.float32)}
    buffer, step = full_of_steps(), a_step()
    step["infos"] = [{**info, **told} for info in step["infos"]]
    buffer.add(**step)
    assert (buffer.actions[1] == 0.5).all()
    del step["infos"][lacking][key]
    with pytest.raises(ValueError, match=f"must hold '{key}'; that of environment {lacking} does"):
        buffer.add(**step)
    step["infos"][lacking][key] = np.zeros(2)
    with pytest.raises(ValueError, match=rf"the info '{key}' has the shape \(2,\), not \(3,\)"):
        buffer.add(**step)
    assert buffer.table.n_transitions() == 6 and buffer.n_added == 4


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda info: info.pop("context"), "must hold 'context'; that of environment 1 does not"),
        (lambda info: info.update(context=np.zeros(3)), r"'context' has the shape \(3,\), not \(2"),
        (lambda info: info.update(original_goal=np.zeros(2)), "the original goal has the shape"),
    ],
)
def test_facts_that_do_not_fit_lose_no_older_step(change: Any, sentence: str) -> None:
    buffer = full_of_steps(scene_distance=0.01)
    buffer.contexts = np.zeros((2, 3, 2), np.float32)
    step = a_step()
    step["infos"] = [{**info, "context": np.ones(2)} for info in step["infos"]]
    buffer.add(**step)
    assert (buffer.contexts[1] == 1.0).all() and (buffer.contexts[0] == 0.0).all()
    before = copy.deepcopy(buffer)
    change(step["infos"][1])
    step["obs"]["observation"] = np.full((3, 3), 9.0)
    with pytest.raises(ValueError, match=sentence):
        buffer.add(**step)
    assert buffer.table.n_transitions() == 6 and buffer.pos == before.pos
    for name, store in before._stores().items():
        np.testing.assert_array_equal(buffer._stores()[name], store, err_msg=name)


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.0), (-1.0, np.inf), (-np.inf, np.inf)])
def test_actions_that_cannot_be_scaled_are_refused_at_once(low: float, high: float) -> None:
    class Odd(PointEnv):
        def __init__(self) -> None:
            super().__init__()
            bounds = np.array([-1.0, -1.0, low]), np.array([1.0, 1.0, high])
            self.action_space = spaces.Box(*(each.astype(np.float32) for each in bounds))

    with pytest.raises(ValueError, match=r"the action space must have finite bounds.* it is Box"):
        make_buffer(make_env(1, Odd))


def test_what_float32_cannot_tell_from_zero_is_zero() -> None:
    buffer = make_buffer(make_env(3))
    step = a_step()
    step["obs"]["observation"] = np.full((3, 3), 1e-300)
    with np.errstate(all="raise"):
        buffer.add(**step)
        buffer.sample(50)
    assert (buffer.observations["observation"][0] == 0.0).all()
