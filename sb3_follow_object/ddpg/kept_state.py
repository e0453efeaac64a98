"""What is kept of an algorithm: in SB3's files, in copies, and for a run that is resumed."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from ..common.copies import WholeCopies
from ..common.torch_helpers import load_optimizer
from ..replay.device_replay import DeviceReplay
from ..replay.her_replay_buffer import FollowObjectReplayBuffer
from .auxiliary import AuxiliaryCritic
from .input_moments import InputMoments
from .policies import HerPolicy
from .whole_episodes import WholeEpisodesDDPG


class KeptDDPG(WholeCopies, WholeEpisodesDDPG):
    """DDPG with input moments, a generator and perhaps a second critic, which are kept with it.

    `HerDDPG` makes them and learns.
    """

    _COUNTERS: ClassVar = ("num_timesteps", "_n_updates", "_episode_num")
    policy: HerPolicy
    rng: np.random.Generator
    moments: InputMoments
    auxiliary_critic: AuxiliaryCritic | None
    _device_replay: DeviceReplay | None

    def _buffer_was_replaced(self, buffer: ReplayBuffer) -> None:
        self.moments.buffer_was_loaded(buffer)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed as SB3 does, and begin the generators anew that a new algorithm would have.

        A replay buffer with a seed of its own goes on with its generator.
        """
        super().set_random_seed(seed)
        if seed is None or not hasattr(self, "policy"):  # `_setup_model` seeds before it makes them
            return
        own_seed = self.replay_buffer_kwargs.get("seed") is not None
        if isinstance(self.replay_buffer, FollowObjectReplayBuffer) and not own_seed:
            self.replay_buffer.seed(np.random.randint(2**31))
        self.rng = np.random.default_rng(np.random.randint(2**31))
        if self._device_replay is not None:
            self._device_replay.generator.manual_seed(np.random.randint(2**31))

    def __getstate__(self) -> dict[str, Any]:
        state = vars(self).copy()
        state.pop("_stood", None)  # known by identity
        if "_logger" in state:  # its files and terminal are the original's
            state |= {"_logger": Logger(None, []), "_custom_logger": False}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        buffer = self.replay_buffer
        if isinstance(buffer, HerReplayBuffer) and buffer.env is None and self.env is not None:
            buffer.set_env(self.env)  # a pickled buffer leaves it out

    def _excluded_save_params(self) -> list[str]:
        names = ("auxiliary_critic", "_updates", "_device_replay")
        return [*super()._excluded_save_params(), *names]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        if self.auxiliary_critic is not None:
            names.append("auxiliary_critic")
            names += [f"auxiliary_critic.{name}" for name in self.auxiliary_critic.optimizers]
        return names, variables

    def set_parameters(  # noqa: D102
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        super().set_parameters(load_path_or_dict, exact_match, device)
        self._leave_graphs()

    def _leave_graphs(self) -> None:
        """Forget what optimisers need in graphs on CUDA, which set it themselves."""
        for optimizer in (self.actor.optimizer, self.critic.optimizer):
            for group in optimizer.param_groups:
                group["capturable"] = False

    def training_state(self) -> dict[str, Any]:
        """Return everything that the next rollout and update depend on, between rollouts.

        The environment has its own state, and so has the replay buffer. Tensors are those that
        training changes: to come back to a state later, keep a `copy.deepcopy` of it.
        """
        return {
            "policy": self.policy.state_dict(),
            "mirrors": [mirror.plain() for mirror in self.policy.mirrors],
            "actor_optimizer": self.actor.optimizer.state_dict(),
            "critic_optimizer": self.critic.optimizer.state_dict(),
            "auxiliary": None
            if self.auxiliary_critic is None
            else self.auxiliary_critic.training_state(),
            "moments": self.moments.state_dict(),
            "rng": self.rng.bit_generator.state,
            "device_rng": None
            if self._device_replay is None
            else self._device_replay.generator.get_state(),
            "last_obs": None if self._step_is_open else self._last_obs,
            "counters": {name: getattr(self, name) for name in self._COUNTERS},
        }

    def load_training_state(self, state: dict[str, Any]) -> None:
        """Continue from `training_state` of an algorithm with the same networks.

        Raises:
            ValueError: they fold over other planes.
        """
        mirrors = [mirror.plain() for mirror in self.policy.mirrors]
        if state.get("mirrors", mirrors) != mirrors:
            raise ValueError(
                f"the policy was trained with the mirrors {state['mirrors']}, not {mirrors}"
            )
        self.policy.load_state_dict(state["policy"])
        load_optimizer(self.actor.optimizer, state["actor_optimizer"])
        load_optimizer(self.critic.optimizer, state["critic_optimizer"])
        self._leave_graphs()
        if self.auxiliary_critic is not None:
            self.auxiliary_critic.load_training_state(state["auxiliary"])
        assert self.replay_buffer is not None
        self.moments.load_state_dict(state["moments"], self.replay_buffer)
        self.rng.bit_generator.state = state["rng"]
        if self._device_replay is not None and state["device_rng"] is not None:
            generator, saved = self._device_replay.generator, state["device_rng"]
            if saved.shape == generator.get_state().shape:  # not of another kind of device
                generator.set_state(saved)
        self._last_obs = state["last_obs"]
        self._stood = None  # the environment is brought there by others
        self._last_episode_starts = np.ones(self.n_envs, dtype=bool)
        for name in self._COUNTERS:
            setattr(self, name, state["counters"][name])

    def expect_new_replay(self) -> None:
        """Take in for the moments what is stored from now on: the replay buffer begins anew."""
        assert self.replay_buffer is not None
        self.moments.begin_anew(self.replay_buffer)
