"""Reaching first in a vectorised environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from ..common.vec_env_copies import CopyableVecEnvWrapper
from ..imagination.vec_env import ImaginedGoalVecEnv
from ..replay.episode_buffer import EXECUTED
from ..settings.stages import ReachSettings
from .actor import ReachActor
from .approach import AHEAD, STREAM, Approach, Observation, check_reachable


class ReachFirstVecEnv(CopyableVecEnvWrapper):
    """Let the effector reach for the object first in a share of the episodes.

    While it reaches, the actions given are replaced; infos carry "executed_action", which
    `FollowObjectReplayBuffer` stores. Put it outside of ImaginedGoalVecEnv and inside VecMonitor.

    Args:
        venv: vectorised environment with Dict goal observations.
        settings: of `ReachSettings`.

    Raises:
        ValueError: the observations do not hold the effector where the settings say.
    """

    def __init__(self, venv: VecEnv, **settings: Any) -> None:
        super().__init__(venv)
        reach = ReachSettings(**settings)
        check_reachable(venv.observation_space, reach)
        self.approach = Approach(venv.num_envs, reach)
        self._obs: Observation = {}
        self._executed = np.zeros((venv.num_envs, *cast(spaces.Box, venv.action_space).shape))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments and the reaching; takes effect at the next reset."""
        seeds = self.venv.seed(seed)
        first = seed if seed is not None else seeds[0]
        self.approach.rng = np.random.default_rng(None if first is None else [first, STREAM])
        return seeds

    def take_counts(self) -> np.ndarray:
        """Return what `Approach.counts` has had since the last call, (4,) int."""
        return self.approach.take_counts()

    def set_reach(self, actor: ReachActor, share: float) -> None:
        """Reach with this policy from now on, in this share of the episodes that begin."""
        self.approach.actor = actor
        self.approach.share = share

    def reset(self) -> Observation:
        """Start an episode in every copy."""
        self._obs = cast(Observation, self.venv.reset())
        rows = np.arange(self.num_envs)
        self.approach.begin(rows, self._obs, self._ahead(rows))
        return self._obs

    def step_async(self, actions: np.ndarray) -> None:
        """Step with what is executed."""
        self._executed = self.approach.act(self._obs, actions)
        self.venv.step_async(self._executed)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step and tell what was executed."""
        venv_obs, rewards, dones, infos = self.venv.step_wait()
        obs = cast(Observation, venv_obs)
        last = obs
        if dones.any():
            last = {key: value.copy() for key, value in obs.items()}
            for i in np.flatnonzero(dones):
                for key in ("observation", "achieved_goal"):
                    last[key][i] = infos[i]["terminal_observation"][key]
        self.approach.arrive(last, dones)
        infos = [
            {**info, EXECUTED: action} for info, action in zip(infos, self._executed, strict=True)
        ]
        ended = np.flatnonzero(dones)
        if ended.size:
            self.approach.begin(ended, obs, self._ahead(ended))
        self._obs = obs
        return obs, rewards, dones, infos

    def get_state(self) -> dict[str, Any] | None:
        """Return the reaching's state and the inner one, None where that cannot be told."""
        if not hasattr(self.venv, "get_state"):
            return None
        state = {"approach": self.approach.state_dict(), "venv": self.venv.get_state()}
        state["obs"] = self._obs
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`."""
        self.venv.set_state(state["venv"])  # type: ignore[attr-defined]
        self.approach.load_state_dict(state["approach"])
        self._obs = state["obs"]

    def _ahead(self, rows: np.ndarray) -> np.ndarray:
        """Return where each object shall go next, (m, 3): along F_phi's path, else its goal."""
        if not isinstance(self.venv, ImaginedGoalVecEnv) or not self.approach.settings.standoff:
            return self._obs["desired_goal"][rows]
        return self.venv.ahead(rows, AHEAD)
