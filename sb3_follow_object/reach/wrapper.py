"""Reaching first in one gymnasium environment."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..common.copies import WholeCopies
from ..imagination.goal_env import LAST
from ..replay.episode_buffer import EXECUTED, GIVEN
from ..settings.stages import ReachFirstSettings
from .actor import ReachActor
from .approach import (
    AHEAD,
    STREAM,
    Approach,
    Observation,
    check_reachable,
    reach_first_settings,
)


class ReachFirstWrapper(
    WholeCopies,
    gym.Wrapper[Observation, np.ndarray, Observation, np.ndarray],
    gym.utils.RecordConstructorArgs,
):
    """Let the effector reach for the object first in a share of the episodes.

    While it reaches, the actions given are replaced; infos carry "executed_action", which
    `FollowObjectReplayBuffer` stores, and "given_action", which it compares with what was chosen.
    Nothing reaches until a `ReachCallback` has taught the reach policy, so the same YAML makes the
    environment that trains and those that evaluate or play. Put it outside of ImaginedGoalWrapper.

    Args:
        env: environment with Dict goal observations.
        settings: of `ReachFirstSettings`; the standoff "auto" is that of a task of this package.

    Raises:
        ValueError: an invalid setting, or the observations do not hold the effector
            where the settings say.
    """

    def __init__(self, env: gym.Env, **settings: Any) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, **settings)
        super().__init__(env)
        reach = reach_first_settings(settings, type(self).__name__, env.spec)
        check_reachable(env.observation_space, env.action_space, reach)
        self.approach = Approach(1, cast(spaces.Box, env.action_space), reach)
        self._obs: Observation = {}
        self._is_running = False  # an episode, as far as the environment inside says

    def set_reach(self, actor: ReachActor, share: float) -> None:
        """Reach with this policy from now on, in this share of the episodes that begin."""
        self.approach.actor = actor
        self.approach.share = share

    def reach_settings(self) -> ReachFirstSettings:
        """Return how it reaches."""
        return self.approach.settings

    def reach_observation(self) -> np.ndarray:
        """Return the "observation" that it reaches by, (1, d)."""
        return self._obs["observation"]

    def take_counts(self) -> np.ndarray:
        """Return `Approach.counts` since the last call, (2, 2) int."""
        return self.approach.take_counts()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode, perhaps with reaching."""
        if seed is not None:
            self.approach.rng = np.random.default_rng([seed, STREAM])
        if self._is_running:  # a wrapper around this one, such as TimeLimit, has ended it
            self.approach.count(np.array([True]))
        self._is_running = False
        obs, info = self.env.reset(seed=seed, options=options)
        self._obs = _batch_of_one(obs)
        ahead = self._obs["desired_goal"]
        if self.approach.settings.standoff and self.has_wrapper_attr("ahead"):
            ahead = self.get_wrapper_attr("ahead")(AHEAD)[None]
        self.approach.begin(np.arange(1), self._obs, ahead)
        return obs, info

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Step with what is executed, and tell it in the info."""
        executed = self.approach.act(self._obs, np.asarray(action)[None])[0]
        obs, reward, terminated, truncated, info = self.env.step(executed)
        self._obs = _batch_of_one(obs)
        ended = terminated or truncated
        self.approach.arrive(self._obs, np.array([ended]))
        self._is_running = not ended
        info = {**info, GIVEN: action, EXECUTED: executed, **({LAST: obs} if ended else {})}
        return obs, float(reward), terminated, truncated, info


def _batch_of_one(obs: Observation) -> Observation:
    return {key: np.asarray(value)[None] for key, value in obs.items()}
