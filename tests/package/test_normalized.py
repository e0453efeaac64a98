"""Around stock algorithms in VecNormalize: what is stored is what happened, to the last bit."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation, TimeAwareObservation
from imagined import imagining
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from toy import HORIZON, PointEnv, StraightPredictor, curriculum

from sb3_follow_object import (
    FollowObjectReplayBuffer,
    ImaginedGoalWrapper,
    ReachFirstVecEnv,
    ReachFirstWrapper,
)

SETTINGS: dict[str, Any] = {"effector": (0, 1, 2), "height": 0.0}


class Leaping(PointEnv):
    """Its point stands still until the last step takes it far away."""

    def step(self, action: np.ndarray) -> Any:
        leap = np.array([0.0, 0.0, 2.0]) if self.steps == HORIZON - 1 else 0.0
        self.position = self.position + leap
        return super().step(0.0 * action)


def imagining_each() -> VecEnv:
    return DummyVecEnv(
        [lambda: ImaginedGoalWrapper(Leaping(), StraightPredictor(), curriculum())] * 2
    )


def reaching_each() -> VecEnv:
    return DummyVecEnv([lambda: ReachFirstWrapper(Leaping(), **SETTINGS)] * 2)


FACES: dict[str, Callable[[], VecEnv]] = {
    "ImaginedGoalVecEnv": lambda: imagining(curriculum(), n=2, env=Leaping),
    "ImaginedGoalWrapper": imagining_each,
    "ReachFirstVecEnv": lambda: ReachFirstVecEnv(DummyVecEnv([Leaping] * 2), **SETTINGS),
    "ReachFirstWrapper": reaching_each,
}


def limited() -> VecEnv:
    def make() -> Any:
        inner = ImaginedGoalWrapper(Leaping(), StraightPredictor(), curriculum())
        return gym.wrappers.TimeLimit(inner, HORIZON - 1)

    return DummyVecEnv([make] * 2)


def learn(env: VecEnv, clip_obs: float = 5.0) -> Any:
    model = DDPG(
        "MultiInputPolicy",
        VecNormalize(env, norm_reward=False, clip_obs=clip_obs),
        replay_buffer_class=FollowObjectReplayBuffer,
        learning_starts=10**9,
        train_freq=HORIZON,
        buffer_size=1000,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    )
    model.learn(10 * HORIZON)
    return model.replay_buffer


@pytest.mark.parametrize("face", FACES)
def test_an_episodes_last_observation_is_not_clipped(face: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        buffer = learn(FACES[face]())
    first, last = (slice(at, buffer.pos, HORIZON) for at in (0, HORIZON - 1))
    for key in ("observation", "achieved_goal"):
        leaps = buffer.next_observations[key][last] - buffer.observations[key][first]
        np.testing.assert_allclose(leaps[..., 2], 2.0, atol=1e-6)
    assert buffer.goals_are_shared, "goals are the same before and after a step"


@pytest.mark.parametrize("make", [lambda: DummyVecEnv([Leaping] * 2), limited])
def test_where_nothing_tells_it_a_warning_says_once_that_it_is_clipped(make: Any) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learn(make(), clip_obs=0.5)
    (sentence,) = [str(each.message) for each in caught if "clip_obs" in str(each.message)]
    assert "last observation at clip_obs 0.5" in sentence


def leaps(buffer: Any, key: str) -> np.ndarray:
    """How far a key's third number went in each episode."""
    first, last = (slice(at, buffer.pos, HORIZON) for at in (0, HORIZON - 1))
    went: np.ndarray = buffer.next_observations[key][last] - buffer.observations[key][first]
    return went[..., 2]


class WithMore(Leaping):
    """Observes another number beside."""

    def __init__(self) -> None:
        super().__init__()
        entries = dict(self.observation_space.spaces)  # type: ignore[attr-defined]
        self.observation_space = spaces.Dict({**entries, "extra": spaces.Box(-1.0, 1.0, (1,))})

    def _observe(self) -> dict[str, np.ndarray]:
        return {**super()._observe(), "extra": np.zeros(1, np.float32)}


def test_what_other_wrappers_add_or_leave_out_does_not_clip_the_rest() -> None:
    def timed() -> Any:
        inner = ImaginedGoalWrapper(Leaping(), StraightPredictor(), curriculum())
        # rl_zoo3 puts another class there, which is the one that is looked for then.
        return TimeAwareObservation(gym.wrappers.TimeLimit(inner, HORIZON), flatten=False)

    def filtered() -> Any:
        inner = ImaginedGoalWrapper(WithMore(), StraightPredictor(), curriculum())
        return FilterObservation(inner, ["observation", "achieved_goal", "desired_goal"])

    for make in (timed, filtered):
        buffer = learn(DummyVecEnv([make] * 2))
        for key in ("observation", "achieved_goal"):
            np.testing.assert_allclose(leaps(buffer, key), 2.0, atol=1e-6)


def test_what_another_wrapper_changes_is_clipped_alone_with_a_warning() -> None:
    class Nudged(gym.ObservationWrapper[Any, Any, Any]):
        def observation(self, observation: Any) -> Any:
            return {**observation, "observation": observation["observation"] + 0.001}

    def nudged() -> Any:
        return Nudged(ImaginedGoalWrapper(Leaping(), StraightPredictor(), curriculum()))

    with pytest.warns(UserWarning, match="VecNormalize has clipped 'observation' of an episode's"):
        buffer = learn(DummyVecEnv([nudged] * 2))
    np.testing.assert_allclose(leaps(buffer, "achieved_goal"), 2.0, atol=1e-6)
    assert leaps(buffer, "observation").min() < 1.0, "it is as the policy saw it"


def test_what_is_not_clipped_there_needs_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learn(DummyVecEnv([Leaping] * 2), clip_obs=1000.0)


def test_what_another_wrapper_has_changed_is_not_taken_back() -> None:
    class Shifted(VecNormalize):
        def step_wait(self) -> Any:
            obs, rewards, dones, infos = super().step_wait()
            for i in np.flatnonzero(dones):
                infos[i]["terminal_observation"]["observation"] += 1.0
            return obs, rewards, dones, infos

    env = Shifted(FACES["ImaginedGoalVecEnv"](), norm_reward=False)
    buffer = FollowObjectReplayBuffer(
        100, env.observation_space, env.action_space, env, n_envs=2, seed=0
    )
    env.reset()
    for _ in range(HORIZON):
        obs, _, dones, infos = env.step(np.zeros((2, 3), np.float32))
    assert dones.all() and isinstance(obs, dict)
    with pytest.warns(UserWarning, match="VecNormalize has clipped 'observation'"):
        kept = buffer._with_last_observations(obs, dones, infos)
    np.testing.assert_array_equal(kept["observation"], obs["observation"])
    told = np.array([info["last_observation"]["achieved_goal"] for info in infos])
    np.testing.assert_allclose(kept["achieved_goal"], told, atol=1e-6)
