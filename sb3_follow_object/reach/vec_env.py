"""Reaching first in a vectorised environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecNormalize,
    is_vecenv_wrapped,
    unwrap_vec_wrapper,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from ..common.vec_env_copies import CopyableVecEnvWrapper
from ..imagination.goal_env import LAST, with_terminal_observations
from ..imagination.vec_env import ImaginedGoalVecEnv
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


class ReachFirstVecEnv(CopyableVecEnvWrapper):
    """Let the effector reach for the object first in a share of the episodes.

    While it reaches, the actions given are replaced; infos carry "executed_action", which
    `FollowObjectReplayBuffer` stores. Put it outside of ImaginedGoalVecEnv and inside VecMonitor
    and VecNormalize.

    Args:
        venv: vectorised environment with Dict goal observations.
        settings: of `ReachFirstSettings`; the standoff "auto" is that of a task of this package.

    Raises:
        ValueError: an invalid setting, or the observations do not hold the effector
            where the settings say, in metres.
    """

    def __init__(self, venv: VecEnv, **settings: Any) -> None:
        if not isinstance(venv, VecEnv):
            raise ValueError(
                f"ReachFirstVecEnv takes a VecEnv, not {type(venv).__name__}; around a single "
                "environment put ReachFirstWrapper"
            )
        super().__init__(venv)
        spec = venv.get_attr("spec", indices=[0])[0] if venv.has_attr("spec") else None
        reach = reach_first_settings(settings, type(self).__name__, spec)
        check_reachable(venv.observation_space, venv.action_space, reach)
        if is_vecenv_wrapped(venv, VecNormalize):
            raise ValueError(
                "ReachFirstVecEnv needs observations in metres: put it inside VecNormalize, not "
                "around it"
            )
        actions = cast(spaces.Box, venv.action_space)
        self.approach = Approach(venv.num_envs, actions, reach)
        self._obs: Observation = {}
        self._given = self._executed = np.zeros((venv.num_envs, *actions.shape))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments and the reaching; takes effect at the next reset."""
        seeds = self.venv.seed(seed)
        first = seed if seed is not None else seeds[0]
        self.approach.rng = np.random.default_rng(None if first is None else [first, STREAM])
        return seeds

    def reach_settings(self) -> ReachFirstSettings:
        """Return how it reaches."""
        return self.approach.settings

    def reach_observation(self) -> np.ndarray:
        """Return the "observation" that it reaches by, (n_envs, d)."""
        return self._obs["observation"]

    def take_counts(self) -> np.ndarray:
        """Return `Approach.counts` since the last call, (2, 2) int."""
        return self.approach.take_counts()

    def set_reach(self, actor: ReachActor, share: float) -> None:
        """Reach with this policy from now on, in this share of the episodes that begin."""
        self.approach.actor = actor
        self.approach.share = share

    def reset(self) -> Observation:
        """Start an episode in every copy."""
        self._obs = cast(Observation, self.venv.reset())
        self.reset_infos = self.venv.reset_infos
        rows = np.arange(self.num_envs)
        self.approach.begin(rows, self._obs, self._ahead(rows))
        return self._obs

    def step_async(self, actions: np.ndarray) -> None:
        """Step with what is executed."""
        self._given, self._executed = actions, self.approach.act(self._obs, actions)
        self.venv.step_async(self._executed)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step and tell what was executed."""
        venv_obs, rewards, dones, infos = self.venv.step_wait()
        obs = cast(Observation, venv_obs)
        self.approach.arrive(with_terminal_observations(obs, dones, infos), dones)
        infos = [
            {**info, GIVEN: given, EXECUTED: executed}
            for info, given, executed in zip(infos, self._given, self._executed, strict=True)
        ]
        self._obs = obs
        ended = np.flatnonzero(dones)
        for i in ended:
            infos[i][LAST] = infos[i]["terminal_observation"]
        if ended.size:
            self.approach.begin(ended, obs, self._ahead(ended))
        return obs, rewards, dones, infos

    def get_state(self) -> dict[str, Any] | None:
        """Return the reaching's state and the inner one, None where that cannot be told."""
        if not hasattr(self.venv, "get_state"):
            return None
        return {
            "approach": self.approach.state_dict(),
            "venv": self.venv.get_state(),
            "obs": self._obs,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`."""
        self.venv.set_state(state["venv"])  # type: ignore[attr-defined]
        self.approach.load_state_dict(state["approach"])
        self._obs = state["obs"]

    def _ahead(self, rows: np.ndarray) -> np.ndarray:
        """Return where each object shall go next, (m, 3): along F_phi's path, else its goal."""
        if self.approach.settings.standoff:
            imagined = unwrap_vec_wrapper(self.venv, ImaginedGoalVecEnv)
            if imagined is not None:
                return imagined.ahead(rows, AHEAD)
            if self.venv.has_attr("ahead"):  # each copy has an ImaginedGoalWrapper
                return np.array(self.venv.env_method("ahead", AHEAD, indices=rows))
        return self._obs["desired_goal"][rows]
