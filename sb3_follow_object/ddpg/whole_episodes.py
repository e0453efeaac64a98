"""SB3's DDPG with a replay buffer that knows its environment and holds true episodes only."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3 import DDPG
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from ..common.torch_helpers import usual_defaults
from ..replay.following import end_running_episodes, follow_env
from ..replay.her_replay_buffer import FollowObjectReplayBuffer


class WholeEpisodesDDPG(DDPG):
    """DDPG whose replay buffer follows when environment or buffer are replaced.

    SB3 resets the environment where `learn` begins anew, and forgets a step in the middle of which
    it was stopped. Here the episodes that ran until then end where they stand. It can also be
    loaded without an environment, to act; the replay buffer is then made by `set_env`.
    """

    _step_is_open = False  # whether an action was chosen whose outcome has not been stored
    _known_buffer: ReplayBuffer | None = None  # that was looked at last
    # The observation after the last step that was stored, and what a VecEnv replaces in `reset`.
    _stood: tuple[Any, Any] | None = None

    def _setup_model(self) -> None:
        with usual_defaults():
            if self.env is None and self.replay_buffer is None:
                # SB3 makes a buffer where there is none, and hindsight needs an environment.
                self.replay_buffer = _NO_REPLAY
                super()._setup_model()
                self.replay_buffer = None
            else:
                super()._setup_model()
        self._known_buffer = self.replay_buffer

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Go on in another environment, as in SB3; the replay buffer asks it from now on.

        Raises:
            ValueError: it is in VecNormalize, not one that the auxiliary reward was made for, or
                lacks what the replay buffer asks for; nothing is changed then.
        """
        env = self._wrap_env(env, self.verbose)
        self._check_env(env)
        if isinstance(self.replay_buffer, FollowObjectReplayBuffer):
            self.replay_buffer.check_env(env)
        super().set_env(env, force_reset)
        self._stood = None
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self._follow()

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """Load a replay buffer as SB3 does.

        Where the model has moments of its inputs already, they are those of what it loads.
        """
        if self.env is None:
            raise ValueError("the model has no environment yet: call set_env(env) first")
        super().load_replay_buffer(path, truncate_last_traj)
        self._follow()

    def _check_env(self, env: Any) -> None:
        """Raise a ValueError for an environment that the algorithm cannot learn in."""

    def _buffer_was_replaced(self, buffer: ReplayBuffer) -> None:
        """Called once `replay_buffer` is another one than it was."""

    def _make_replay_buffer(self) -> ReplayBuffer:
        assert self.replay_buffer_class is not None
        options = dict(self.replay_buffer_kwargs)
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            options["env"] = self.env
        return self.replay_buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **options,
        )

    def _follow(self) -> None:
        """Let the replay buffer ask the environment that the algorithm has."""
        buffer = self.replay_buffer
        if buffer is None or self.env is None:
            return
        follow_env(buffer, self.env)
        buffer.device = self.device
        if buffer is not self._known_buffer:
            self._known_buffer = buffer
            self._buffer_was_replaced(buffer)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> Any:
        if self.env is None:
            raise ValueError("the model was loaded without an environment: call set_env(env) first")
        self._follow()
        if self._step_is_open or self._was_reset():
            self._last_obs = None  # the environment is elsewhere: SB3 resets it then
            self._step_is_open = False
        if reset_num_timesteps or self._last_obs is None:
            end_running_episodes(self.replay_buffer)
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)

    def _store_transition(self, *args: Any, **kwargs: Any) -> None:
        super()._store_transition(*args, **kwargs)
        self._step_is_open = False
        self._stood = (self._last_obs, self._options_of_env())

    def _options_of_env(self) -> Any:
        """Options for the next reset: SB3's environments make others in each, and in no step."""
        return None if self.env is None else getattr(self.env.unwrapped, "_options", None)

    def _was_reset(self) -> bool:
        """Whether the environment was reset since the last step without a word to the algorithm."""
        if self._stood is None or self._last_obs is not self._stood[0]:
            return False
        return self._options_of_env() is not self._stood[1]

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # A rollout's end and tests may lie beyond the last step; schedules end at 0.
        super()._update_current_progress_remaining(
            min(num_timesteps, total_timesteps), total_timesteps
        )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_known_buffer", "_stood"]


_NO_REPLAY: Any = np.empty(0)
