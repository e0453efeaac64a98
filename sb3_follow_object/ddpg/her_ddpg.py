"""SB3's DDPG with what goal-conditioned learning from sparse rewards needs besides."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import (
    DictReplayBufferSamples,
    GymEnv,
    Schedule,
    TrainFreq,
    TrainFrequencyUnit,
)

from ..common.numbers import checked_whole, shown
from ..common.torch_helpers import matmul_at, threads_at, usual_defaults
from ..replay.device_replay import DeviceReplay, device_replay_of, samples_otherwise
from ..replay.her_replay_buffer import FollowObjectReplayBuffer
from ..settings.learning import AlgorithmSettings
from .auxiliary import Transitions, make_auxiliary, resolve_auxiliary
from .env_checks import check_goals, check_rewards, check_wrappers, horizon_of
from .exploration import explored
from .folding import resolved_mirrors, warn_of_other_planes
from .input_moments import InputMoments
from .kept_state import KeptDDPG
from .policies import HerPolicy, NormalizedGoalExtractor
from .updates import COLUMNS, Updates

# Transitions drawn from the buffer in one call: enough to spread the fixed cost, small in memory.
_SAMPLE_CHUNK = 32_768
# The same on the learner's device, where memory is plenty and a chunk is a graph.
_DEVICE_CHUNK = 262_144


class HerDDPG(KeptDDPG):
    """DDPG as the HER papers run it: normaliser, target clip, action L2, random actions.

    The differences from SB3's DDPG (section 3.2 of the paper and its references):

    - inputs are standardised by running moments of everything stored, clipped to +-5;
    - the critic's targets are clipped to [-1/(1 - gamma), 0], where returns of a -1/0 reward lie;
    - with `hindsight_bound` a target is at least what the stored episode proves to be possible;
    - the actor's loss has `action_l2` times the mean squared action added;
    - with probability `random_action_prob` an action is uniform, else Gaussian noise is added;
    - episodes may be collected from several environments at once: `train_freq=(n, "episode")`;
    - `predict` may use an average of the actor's weights over the last updates: `average_decay`;
    - target networks may be moved once every `target_update_interval` updates;
    - a second reward with a critic of its own may be added: `auxiliary`.

    Args:
        env: with Dict observations "observation", "achieved_goal", "desired_goal", of which the
            first says where what is to be moved is: the networks read it and the desired goal.
        gamma: in [0, 1); by default 1 - 1/T for episodes of T steps.
        train_freq: in episodes of every environment, or in steps of every environment.
        noise_std: of the Gaussian noise on each action in [-1, 1]; `action_noise` replaces it.
        random_action_prob: in [0, 1].
        action_l2: weight, >= 0.
        target_clip: (low, high) bounds of the targets; "auto" is [-1/(1 - gamma), 0]; None, none.
        hindsight_bound: raise the target of a transition, whose episode was on the hindsight goal j
            steps later, to -(1 - gamma^j)/(1 - gamma): the return of doing the same and staying
            there. Distances are then read off the episodes instead of spreading step by step
            through the targets. Beyond the paper; for rewards of -1 and 0, objects that can be
            made to stay, and a `FollowObjectReplayBuffer`.
        target_update_interval: in gradient updates, >= 1. The authors: once a cycle of 40.
        policy_delay: critic updates for each of the actor, >= 1, as TD3 has it. Beyond the paper.
        average_decay: share in [0, 1) that an update leaves of the averaged actor, which `predict`,
            validation and saved policies use while the actor itself explores and learns; 0, the
            actor itself. Beyond the paper: the actor's success moves up and down by a tenth and
            more from one validation to the next, its average's by less.
        matmul_precision: of the float32 matrix products of an update, as in
            `torch.set_float32_matmul_precision`: "medium" lets processors with bfloat16 units
            multiply in bfloat16 and add up in float32, which is faster; others ignore it.
        auxiliary: a second reward, whose critic the actor maximises beside the main one:
            {"name": "rnd"} or {"name": "sldr"} (or a subclass of `AuxiliaryReward` as the name),
            with the keyword arguments of the reward's class and "weight", 1 by default, of its
            critic. Its targets have bounds of their own; `hindsight_bound` does not touch them.
        update_threads: PyTorch's threads in gradient steps; None, as many as it has otherwise.
        replay_on_device: keep a copy of the replay buffer on the learner's device and draw, relabel
            and reward there, so that no batch is copied. None: on CUDA, where the buffer's settings
            and the environment's reward allow it (`DeviceReplay`). True: also on the CPU, and an
            error where they do not.
        policy_kwargs: of `HerPolicy`, `critic_layer_norm` among them; `mirrors` may be "auto", what
            the environment's attribute `mirrors` names.

    The other arguments are DDPG's, without `n_steps`: hindsight relabels single steps.

    Raises:
        ValueError: for an environment without goals or with images, in VecNormalize or in
            VecFrameStack, an argument outside its range, or, at the first update in it, rewards
            outside of [-1, 0] with `target_clip` "auto" or others than -1 and 0 with
            `hindsight_bound`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": HerPolicy}
    replay_buffer: FollowObjectReplayBuffer | None
    # Of `train_freq` in episodes of several environments: as asked for, and what it stands for.
    _episodes: TrainFreq | None = None
    _steps_of_episodes: TrainFreq | None = None
    _rewards_are_checked = False  # those of the environment that it has

    def __init__(
        self,
        policy: str | type[HerPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = AlgorithmSettings.learning_rate,
        buffer_size: int = AlgorithmSettings.buffer_size,
        learning_starts: int = AlgorithmSettings.learning_starts,
        batch_size: int = AlgorithmSettings.batch_size,
        tau: float = AlgorithmSettings.tau,
        gamma: float | None = AlgorithmSettings.gamma,
        train_freq: int | tuple[int, str] = AlgorithmSettings.train_freq,
        gradient_steps: int = AlgorithmSettings.gradient_steps,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        noise_std: float = AlgorithmSettings.noise_std,
        random_action_prob: float = AlgorithmSettings.random_action_prob,
        action_l2: float = AlgorithmSettings.action_l2,
        target_clip: tuple[float, float] | str | None = AlgorithmSettings.target_clip,
        hindsight_bound: bool = AlgorithmSettings.hindsight_bound,
        target_update_interval: int = AlgorithmSettings.target_update_interval,
        policy_delay: int = AlgorithmSettings.policy_delay,
        average_decay: float = AlgorithmSettings.average_decay,
        matmul_precision: str = AlgorithmSettings.matmul_precision,
        auxiliary: dict[str, Any] | None = AlgorithmSettings.auxiliary,
        update_threads: int | None = AlgorithmSettings.update_threads,
        replay_on_device: bool | None = AlgorithmSettings.replay_on_device,
        tensorboard_log: str | None = AlgorithmSettings.tensorboard_log,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = AlgorithmSettings.verbose,
        seed: int | None = None,
        device: th.device | str = AlgorithmSettings.device,
        _init_setup_model: bool = True,
    ):
        if optimize_memory_usage:
            raise ValueError("hindsight replay cannot have optimize_memory_usage; leave it out")
        own_policy = policy in ("MultiInputPolicy", HerPolicy)
        own_buffer = replay_buffer_class in (None, FollowObjectReplayBuffer)
        if not isinstance(action_noise, ActionNoise | None):
            raise ValueError(f"action_noise must be SB3's ActionNoise, not {shown(action_noise)}")
        settings = AlgorithmSettings(
            policy=policy,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            noise_std=noise_std,
            random_action_prob=random_action_prob,
            action_l2=action_l2,
            target_clip=target_clip,
            hindsight_bound=hindsight_bound,
            target_update_interval=target_update_interval,
            policy_delay=policy_delay,
            average_decay=average_decay,
            matmul_precision=matmul_precision,  # type: ignore[arg-type]  # checked there
            auxiliary=auxiliary,
            update_threads=update_threads,
            replay_on_device=replay_on_device,
            # Classes of others have keywords of their own.
            replay_buffer_kwargs=replay_buffer_kwargs if own_buffer else None,
            policy_kwargs=policy_kwargs if own_policy else None,
            verbose=verbose,
            tensorboard_log=tensorboard_log,
        )
        super().__init__(
            policy,
            env,
            learning_rate=settings.learning_rate,
            buffer_size=settings.buffer_size,
            learning_starts=settings.learning_starts,
            batch_size=settings.batch_size,
            tau=settings.tau,
            gamma=settings.gamma,  # type: ignore[arg-type]  # resolved in _setup_model
            train_freq=settings.train_freq,
            gradient_steps=settings.gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class or FollowObjectReplayBuffer,
            replay_buffer_kwargs=(
                settings.replay_buffer_kwargs if own_buffer else replay_buffer_kwargs
            ),
            tensorboard_log=settings.tensorboard_log,
            # DDPG writes into it
            policy_kwargs=dict((settings.policy_kwargs if own_policy else policy_kwargs) or {}),
            verbose=settings.verbose,
            seed=None if seed is None else checked_whole("seed", seed, 0),
            device=device,
            _init_setup_model=False,
        )
        self.noise_std = settings.noise_std
        self.random_action_prob = settings.random_action_prob
        self.action_l2 = settings.action_l2
        self.target_clip = settings.target_clip
        self.hindsight_bound = settings.hindsight_bound
        self.target_update_interval = settings.target_update_interval
        self.policy_delay = settings.policy_delay
        self.average_decay = settings.average_decay
        self.matmul_precision: str = settings.matmul_precision
        self.update_threads = settings.update_threads
        self.auxiliary = settings.auxiliary
        self.auxiliary_critic = None
        self.replay_on_device = settings.replay_on_device
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_goals(self.observation_space)
        if self.gamma is None:
            self.gamma = 1.0 - 1.0 / horizon_of(self.env)
        self._check_env(self.env)
        if self.auxiliary is not None:
            self.auxiliary = resolve_auxiliary(self.auxiliary, self.env)
        if self.policy_kwargs.get("mirrors") is not None:
            mirrors = resolved_mirrors(self.policy_kwargs["mirrors"], self.env)
            self.policy_kwargs["mirrors"] = [mirror.plain() for mirror in mirrors]
            warn_of_other_planes(mirrors, self.env)
        super()._setup_model()
        if not isinstance(self.policy, HerPolicy):
            raise ValueError(
                f"HerDDPG wants a HerPolicy, not {type(self.policy).__name__}; GoalPolicy is for "
                "DDPG and TD3"
            )
        self.policy.averages = True
        without_steps = self.replay_buffer is not None and samples_otherwise(self.replay_buffer)
        if self.hindsight_bound and without_steps:
            raise ValueError(
                "hindsight_bound needs a FollowObjectReplayBuffer, whose sample_with_steps knows "
                f"how soon an episode reached each goal; {type(self.replay_buffer).__name__} has "
                "another sample"
            )
        self.rng = np.random.default_rng(np.random.randint(2**31))
        if not hasattr(self, "moments"):  # SB3's load() brings them before it comes here
            self.moments = InputMoments(self.actor.features_dim)
        elif self.replay_buffer is not None:
            self.moments.begin_anew(self.replay_buffer)
        if self.auxiliary is not None:
            # Last, so that what is drawn above does not depend on it.
            rate = self.lr_schedule(1.0)
            with usual_defaults():
                self.auxiliary_critic = make_auxiliary(
                    self.auxiliary, self.policy, rate, self.gamma
                )
        self._rewards_are_checked = False
        self._updates = Updates(self)
        self._device_replay = self._make_device_replay()
        self._follow_horizon()

    def _follow_horizon(self) -> None:
        """Turn episodes of several environments, which SB3 does not count, into steps of each."""
        if self.env is None:
            return
        assert isinstance(self.train_freq, TrainFreq)
        if self.train_freq == self._steps_of_episodes:
            self.train_freq = self._episodes
        if self.train_freq.unit == TrainFrequencyUnit.EPISODE and self.n_envs > 1:
            self._episodes = self.train_freq
            steps = self.train_freq.frequency * horizon_of(self.env)
            self.train_freq = self._steps_of_episodes = TrainFreq(steps, TrainFrequencyUnit.STEP)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if isinstance(self.replay_buffer, FollowObjectReplayBuffer):
            self.replay_buffer.check_first()  # before the first step rather than after it
        return super()._setup_learn(*args, **kwargs)

    def _make_device_replay(self) -> DeviceReplay | None:
        if self.replay_buffer is None:  # loaded to act
            return None
        return device_replay_of(self.replay_buffer, self.device, self.replay_on_device)

    def _check_env(self, env: Any) -> None:
        if env is None:
            return
        check_wrappers(env)
        if self.auxiliary is not None:
            resolve_auxiliary(self.auxiliary, env)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:  # noqa: D102
        makes_replay = self.replay_buffer is None
        super().set_env(env, force_reset)
        self._rewards_are_checked = False
        self._follow_horizon()
        warn_of_other_planes(self.policy.mirrors, self.env)
        if makes_replay:
            self._device_replay = self._make_device_replay()

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,
        n_envs: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self._last_obs is not None
        assert isinstance(self.action_space, spaces.Box)
        self._step_is_open = True
        if self.num_timesteps < learning_starts:
            scaled = self.rng.uniform(-1.0, 1.0, size=(n_envs, *self.action_space.shape))
        else:
            action, _ = self.actor.predict(self._last_obs, deterministic=True)
            scaled = self.policy.scale_action(action)
            noise = self.noise_std if action_noise is None else action_noise
            scaled = explored(scaled, noise, self.random_action_prob, self.rng)
        with np.errstate(under="ignore"):
            scaled = scaled.astype(np.float32)
        return self.policy.unscale_action(scaled), scaled

    def _update_moments(self) -> None:
        """Standardise inputs from now on by all that has been stored."""
        assert self.replay_buffer is not None
        if self.moments.take(self.replay_buffer, self.policy.mirrors):
            self.policy.set_moments(
                th.as_tensor(self.moments.mean, dtype=th.float32),
                th.as_tensor(self.moments.std, dtype=th.float32),
            )

    def _target_bounds(self) -> tuple[float, float]:
        if self.target_clip == "auto":
            return -1.0 / (1.0 - self.gamma), 0.0
        if self.target_clip is None:
            return -np.inf, np.inf
        assert not isinstance(self.target_clip, str)  # no other word gets past __init__
        low, high = self.target_clip
        return float(low), float(high)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Take gradient steps; several batches are drawn from the buffer in one call.

        None before the first episode has ended, as after loading a model without its replay.
        """
        self._follow()
        buffer = self.replay_buffer
        if isinstance(buffer, FollowObjectReplayBuffer) and not buffer.is_ready():
            return
        with usual_defaults(), matmul_at(self.matmul_precision), threads_at(self.update_threads):
            self._train(gradient_steps, batch_size)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        auxiliary, extractor = self.auxiliary_critic, self.actor.features_extractor
        assert isinstance(extractor, NormalizedGoalExtractor)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        self._update_learning_rate(optimizers + ([auxiliary.optimizer] if auxiliary else []))
        self._update_moments()
        self._refresh_device_replay()
        told: list[th.Tensor] = []
        for n in self._chunks(gradient_steps, batch_size):
            data, steps_to_goal = self._sample(n * batch_size, n)
            if not self._rewards_are_checked:
                check_rewards(data.rewards, self.target_clip == "auto", self.hindsight_bound)
                self._rewards_are_checked = True
            bounds = (th.pow(self.gamma, steps_to_goal) - 1.0) / (1.0 - self.gamma)
            # All networks share their input moments, so features are computed once.
            chunk = Transitions(
                data.observations,
                data.actions,
                data.next_observations,
                extractor(data.observations),
                extractor(data.next_observations),
            )
            actions = extractor.fold_actions(data.actions, data.observations)
            told.append(
                self._updates.run(chunk, actions, data.rewards, data.dones, bounds, batch_size)
            )

        # A plain mean until there are enough updates for the share to be left.
        decay = min(self.average_decay**gradient_steps, 1.0 - gradient_steps / self._n_updates)
        self.policy.update_average(decay if self.average_decay > 0.0 else 0.0)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        means = th.cat(told).nanmean(dim=0).tolist()
        for name, value in zip(COLUMNS, means, strict=True):
            if self.policy_delay == 1 or value == value:  # else the actor's turn did not come
                self.logger.record(f"train/{name}", value)
        for name, mean in (auxiliary.take_log() if auxiliary else {}).items():
            self.logger.record(name, mean)
        if isinstance(self.replay_buffer, FollowObjectReplayBuffer):
            self.logger.record("train/moved_share", self.replay_buffer.moved_share())
            for name, value in self.replay_buffer.selection_log().items():
                self.logger.record(name, value)

    def _refresh_device_replay(self) -> None:
        """Upload what is new; where that turns out to be impossible, go on on the host."""
        if self._device_replay is None:
            return
        try:
            self._device_replay.refresh(self.replay_buffer)
        except ValueError as error:
            if self.replay_on_device:
                raise
            warnings.warn(f"Replay goes on on the host: {error}.", stacklevel=2)
            self._device_replay = None

    def _chunks(self, gradient_steps: int, batch_size: int) -> list[int]:
        """Gradient steps whose batches are drawn in one call, in turn."""
        most = _SAMPLE_CHUNK // batch_size
        if self._device_replay is not None:
            # Whole intervals, where they fit: chunks that move the targets alike share a graph.
            most = _DEVICE_CHUNK // batch_size
            most = most - most % self.target_update_interval or most
        most = max(1, most)
        return [min(most, gradient_steps - first) for first in range(0, gradient_steps, most)]

    def _sample(self, n: int, n_batches: int = 1) -> tuple[DictReplayBufferSamples, th.Tensor]:
        """Draw n transitions for so many batches, and (n, 1) steps until each goal was reached."""
        buffer = self.replay_buffer
        assert buffer is not None
        if isinstance(buffer, FollowObjectReplayBuffer) and not samples_otherwise(buffer):
            if self._device_replay is not None:
                return self._device_replay.sample_with_steps(n)
            return buffer.sample_with_steps(n, n_batches=n_batches)
        data = buffer.sample(n)
        return data, th.full((n, 1), th.inf, dtype=th.float32, device=self.device)

    def _trained_parameters(self) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """Parameters of the live and of the target networks, in the same order."""
        live, target = self.policy.live_and_targets()
        if self.auxiliary_critic is not None:
            live += self.auxiliary_critic.q_networks.parameters()
            target += self.auxiliary_critic.target_networks.parameters()
        return live, target
