"""The reach policy: it brings the effector to a place, and learns that by hindsight.

Its achieved goal is the effector's position, which the observation holds, and its goals are places
where the effector came later in the same episode, or where the object stood. So every episode of
the robot teaches it, whatever the episode was for, and it costs no step of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from torch import nn

from ..common.copies import WholeCopies
from ..common.torch_helpers import load_optimizer, usual_defaults
from ..ddpg.auxiliary import AuxiliaryCritic, Transitions
from ..ddpg.input_moments import MIN_STD
from ..ddpg.policies import HerPolicy, NormalizedGoalExtractor
from ..ddpg.updates import Updates
from ..replay.her_replay_buffer import FollowObjectReplayBuffer
from ..settings.stages import ReachFirstSettings
from .actor import ReachActor
from .approach import check_effector

_HIDDEN = [128, 128]
_TO_OBJECT = 0.2  # share of the goals at which the object stood
_IDLE = 0.1  # standard deviation of an action's entry below which reaching does not need it


def _learning_rate(progress: float) -> float:
    return 1e-3


class ReachPolicy(WholeCopies):
    """DDPG + HER with two critics on the effector's position, from the robot's own replay buffer.

    Args:
        observation_space: of the environment, Dict with "observation".
        action_space: of the environment.
        settings: where the effector is and when it has arrived.
        seed: of the networks and of what is drawn from the replay buffer.

    Raises:
        ValueError: "observation" does not hold the effector where the settings say.
    """

    # What `Updates` reads.
    gamma = 0.95  # a place is some ten steps away
    tau = 0.02
    action_l2 = 1.0
    hindsight_bound = True
    target_update_interval = 1
    policy_delay = 1
    auxiliary_critic: AuxiliaryCritic | None = None
    device = th.device("cpu")  # the networks are small

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        settings: ReachFirstSettings,
        seed: int = 0,
    ) -> None:
        self.effector = list(settings.effector)
        self.tolerance = settings.tolerance
        self.rng = np.random.default_rng(seed)
        observation = observation_space["observation"]
        check_effector(self.effector, observation)
        place = spaces.Box(-np.inf, np.inf, (len(self.effector),), np.float32)
        inputs = spaces.Dict(
            {"observation": observation, "achieved_goal": place, "desired_goal": place}
        )
        with usual_defaults(), th.random.fork_rng(devices=[]):
            th.manual_seed(seed)
            self.policy = HerPolicy(
                inputs, action_space, _learning_rate, net_arch=_HIDDEN, n_critics=2
            )
        self.moments = RunningMeanStd(shape=(self.policy.actor.features_dim,))
        self.idle = np.zeros(action_space.shape, dtype=bool)
        self._n_updates = 0
        self._updates = Updates(self)

    @property
    def has_learned(self) -> bool:
        """Whether it has taken a gradient step."""
        return self._n_updates > 0

    def learn(self, buffer: FollowObjectReplayBuffer, n_updates: int, batch_size: int) -> None:
        """Take gradient steps on what the robot did.

        Args:
            buffer: of the robot; must hold a finished episode.
            n_updates: gradient steps, >= 1.
            batch_size: transitions of each, >= 1.
        """
        with usual_defaults(), np.errstate(under="ignore"):
            self._learn(buffer, n_updates, batch_size)

    def _learn(self, buffer: FollowObjectReplayBuffer, n_updates: int, batch_size: int) -> None:
        obs, goal, actions, next_obs, steps, reached = self._sample(buffer, n_updates * batch_size)
        self.moments.update(np.concatenate([obs, goal], axis=1).astype(np.float64))
        mean, std = (th.as_tensor(m, dtype=th.float32) for m in (self.moments.mean, self._std()))
        self.policy.set_moments(mean, std)

        def tensor(array: np.ndarray) -> th.Tensor:
            return th.as_tensor(array, dtype=th.float32, device=self.device)

        here = {"observation": tensor(obs), "desired_goal": tensor(goal)}
        there = {"observation": tensor(next_obs), "desired_goal": tensor(goal)}
        extractor = self.policy.actor.features_extractor
        chunk = Transitions(here, tensor(actions), there, extractor(here), extractor(there))
        rewards = tensor(reached - 1.0)[:, None]
        bounds = (th.pow(self.gamma, tensor(steps)[:, None]) - 1.0) / (1.0 - self.gamma)
        self._updates.run(chunk, chunk.actions, rewards, th.zeros_like(rewards), bounds, batch_size)
        with th.no_grad():
            played = self.policy.actor.mu(chunk.features[:batch_size])
        self.idle = (played.std(dim=0) < _IDLE).cpu().numpy()

    def actor(self) -> ReachActor:
        """Return what it does now, to be carried into environments."""
        linear = [layer for layer in self.policy.actor.mu if isinstance(layer, nn.Linear)]
        layers = [
            (layer.weight.detach().cpu().numpy().T.copy(), layer.bias.detach().cpu().numpy().copy())
            for layer in linear
        ]
        extractor = self.policy.actor.features_extractor
        assert isinstance(extractor, NormalizedGoalExtractor)
        return ReachActor(
            layers,
            self.moments.mean.astype(np.float32),
            self._std().astype(np.float32),
            extractor.clip,
            self.idle.copy(),
        )

    def _std(self) -> np.ndarray:
        return np.sqrt(self.moments.var).clip(min=MIN_STD)

    def _sample(self, buffer: FollowObjectReplayBuffer, n: int) -> tuple[np.ndarray, ...]:
        """Draw transitions and places: observations, places, actions, next, steps, reached."""
        batch, then, later = buffer.sample_pairs(n, self.rng)
        goal = then.next_observations["observation"][:, self.effector].copy()
        steps = later.astype(np.float32)
        to_object = self.rng.random(n) < _TO_OBJECT
        achieved = batch.observations["achieved_goal"][to_object]
        goal[to_object] = buffer.goal_space.point(achieved)
        steps[to_object] = np.inf
        next_obs = batch.next_observations["observation"]
        distance = np.linalg.norm(next_obs[:, self.effector] - goal, axis=1)
        reached = (distance <= self.tolerance).astype(np.float32)
        return batch.observations["observation"], goal, batch.actions, next_obs, steps, reached

    def _target_bounds(self) -> tuple[float, float]:
        return -1.0 / (1.0 - self.gamma), 0.0

    def _trained_parameters(self) -> tuple[list[th.Tensor], list[th.Tensor]]:
        return self.policy.live_and_targets()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next updates depend on, as tensors that they change."""
        return {
            "policy": self.policy.state_dict(),
            "actor_optimizer": self.policy.actor.optimizer.state_dict(),
            "critic_optimizer": self.policy.critic.optimizer.state_dict(),
            "mean": self.moments.mean,
            "var": self.moments.var,
            "count": float(self.moments.count),
            "idle": self.idle,
            "rng": self.rng.bit_generator.state,
            "n_updates": self._n_updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        load_optimizer(self.policy.actor.optimizer, state["actor_optimizer"])
        load_optimizer(self.policy.critic.optimizer, state["critic_optimizer"])
        self.moments.mean, self.moments.var = state["mean"].copy(), state["var"].copy()
        self.moments.count = state["count"]
        self.idle = state["idle"].astype(bool)
        self.rng.bit_generator.state = state["rng"]
        self._n_updates = int(state["n_updates"])
