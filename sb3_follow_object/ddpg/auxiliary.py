"""A second reward with a critic of its own: what RND and SLDR have in common."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from ..common.answers import check_shape
from ..common.providers import provider
from ..common.torch_helpers import WholeModule, load_optimizer, lowest, matmul_at
from ..settings.fields import check_names
from ..settings.learning import AUXILIARY as KIND
from ..settings.learning import AuxiliarySettings, check_auxiliary
from .policies import HerPolicy

_COMMON = ("name", "weight")
_GIVEN = ("n_features",)  # what the algorithm, not the user, tells a reward


class Transitions(NamedTuple):
    """One batch as an auxiliary reward sees it; n transitions, goals as relabelled.

    Attributes:
        observations: "observation", "achieved_goal" and "desired_goal", (n, d) each.
        actions: (n, action_dim), in [-1, 1].
        next_observations: as `observations`, one step later.
        features: normalised observation and desired goal, (n, n_features), mirrored
            where the policy has mirrors.
        next_features: the same one step later.
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    next_observations: dict[str, th.Tensor]
    features: th.Tensor
    next_features: th.Tensor

    def split(self, size: int) -> list[Transitions]:
        """Return batches of `size` transitions, the last one with what is left."""
        rows = [slice(first, first + size) for first in range(0, len(self.actions), size)]
        return [
            Transitions(
                {key: value[part] for key, value in self.observations.items()},
                self.actions[part],
                {key: value[part] for key, value in self.next_observations.items()},
                self.features[part],
                self.next_features[part],
            )
            for part in rows
        ]


class AuxiliaryReward(nn.Module):
    """A reward that `HerDDPG` learns beside the environment's.

    A subclass computes it in `forward` and may learn from each batch in `update`. What changes
    belongs into parameters, buffers and `optimizer`, which are saved with the algorithm. It is made
    with what the settings say and with ``n_features``, the length of `Transitions.features`.

    Attributes:
        name: of the method; logged values begin with it.
        reward_range: the lowest and the highest reward.
        optimizer: of what `update` learns, if anything.
    """

    name: ClassVar[str]
    reward_range: tuple[float, float]
    optimizer: th.optim.Optimizer | None = None

    @classmethod
    def resolve(cls, options: dict[str, Any], env: VecEnv | None) -> dict[str, Any]:
        """Return keyword arguments with what names something in the place that it names.

        They are saved with the algorithm, so it can be loaded where that place is not.

        Args:
            options: keyword arguments of the class.
            env: that is trained in; None where a saved algorithm is loaded without one.
        """
        return options

    def forward(self, batch: Transitions) -> th.Tensor:
        """Return the rewards (n, 1) of a batch, within `reward_range`."""
        raise NotImplementedError

    def update(self, batch: Transitions) -> None:
        """Learn from a batch whose rewards have been taken."""


class AuxiliaryCritic(WholeModule):
    """Critic, target critic and optimiser of an auxiliary reward.

    Args:
        reward: what the critic predicts the discounted sum of.
        policy: says what a critic looks like and how it is optimised.
        learning_rate: of the critic when it begins.
        gamma: discount factor; targets are clipped to the reward's range over 1 - gamma.
        weight: of this critic beside the main one in what the actor maximises, >= 0.

    Raises:
        ValueError: a negative weight.
    """

    def __init__(
        self,
        reward: AuxiliaryReward,
        policy: HerPolicy,
        learning_rate: float,
        gamma: float,
        weight: float = AuxiliarySettings.weight,
    ) -> None:
        super().__init__()
        weight = AuxiliarySettings(weight=weight).weight
        self.reward = reward
        self.gamma = gamma
        self.weight = weight
        self.bounds = tuple(limit / (1.0 - gamma) for limit in reward.reward_range)
        self.q_networks = nn.ModuleList(policy.make_critic().q_networks)
        self.target_networks = copy.deepcopy(self.q_networks)
        self.optimizer = policy.optimizer_class(
            self.q_networks.parameters(), **{**policy.optimizer_kwargs, "lr": learning_rate}
        )
        self._sums: dict[str, th.Tensor] = {}
        self._n_summed: dict[str, int] = {}
        self.to(policy.device)

    @property
    def optimizers(self) -> dict[str, th.optim.Optimizer]:
        """The optimisers by the attributes that they are reached through."""
        own: dict[str, th.optim.Optimizer] = {"optimizer": self.optimizer}
        if self.reward.optimizer is not None:
            own["reward.optimizer"] = self.reward.optimizer
        return own

    def update(
        self, batch: Transitions, critic_in: th.Tensor, next_in: th.Tensor, dones: th.Tensor
    ) -> None:
        """Take one gradient step of the critic and let the reward learn.

        Args:
            batch: of n transitions.
            critic_in: features and actions, (n, n_features + action_dim).
            next_in: next features and the target actor's actions, of the same shape.
            dones: (n, 1), 1 where the episode terminated.
        """
        low, high = self.bounds
        with th.no_grad():
            with matmul_at("highest"):  # rewards are small differences of large values
                reward = self._checked(self.reward(batch), len(batch.actions))
            next_q = lowest([net(next_in) for net in self.target_networks])
            target_q = (reward + (1.0 - dones) * self.gamma * next_q).clamp_(low, high)
        loss = th.stack(
            [nn.functional.mse_loss(net(critic_in), target_q) for net in self.q_networks]
        ).sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.reward.update(batch)
        self._log(reward=reward.mean(), critic_loss=loss.detach())

    def _checked(self, reward: Any, n: int) -> th.Tensor:
        """Refuse what would be broadcast."""
        check_shape(reward, (n, 1), f"the rewards of {type(self.reward).__name__}.forward")
        assert isinstance(reward, th.Tensor)
        return reward

    def value(self, critic_in: th.Tensor) -> th.Tensor:
        """Return the weighted mean value of actions, for the actor to maximise."""
        self.q_networks.requires_grad_(False)  # the gradient passes through to the actions
        q = self.q_networks[0](critic_in).mean()
        self.q_networks.requires_grad_(True)
        self._log(q_mean=q.detach())
        return self.weight * q

    def _log(self, **values: th.Tensor) -> None:
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
            self._n_summed[name] = self._n_summed.get(name, 0) + 1

    def take_log(self) -> dict[str, float]:
        """Return the means since the last call: reward, q_mean, critic_loss."""
        means = {
            f"{self.reward.name}/{key}": value.item() / self._n_summed[key]
            for key, value in self._sums.items()
        }
        self._sums, self._n_summed = {}, {}
        return means

    def training_state(self) -> dict[str, Any]:
        """Return everything that changes while it learns."""
        optimizers = {name: each.state_dict() for name, each in self.optimizers.items()}
        return {"networks": self.state_dict(), "optimizers": optimizers}

    def load_training_state(self, state: dict[str, Any]) -> None:
        """Continue from `training_state`."""
        self.load_state_dict(state["networks"])
        for name, optimizer in self.optimizers.items():
            load_optimizer(optimizer, state["optimizers"][name])


def reward_class(settings: Mapping[str, Any]) -> type[AuxiliaryReward]:
    """Return the class that settings name.

    Args:
        settings: "name", "weight" and the keyword arguments of the reward's class.

    Raises:
        ValueError: an unknown name or setting, with the nearest that exists.
    """
    check_auxiliary(settings)
    name = settings["name"]
    if not isinstance(name, type):
        chosen: type[AuxiliaryReward] = provider(KIND, name)
        return chosen
    if not issubclass(name, AuxiliaryReward):
        raise ValueError(f"auxiliary: {name.__name__} is no subclass of AuxiliaryReward")
    arguments = inspect.signature(name.__init__).parameters
    takes_any = any(each.kind is each.VAR_KEYWORD for each in arguments.values())
    takes_any &= name.__init__ is not nn.Module.__init__  # which refuses what it is given
    lacking = [] if takes_any else [given for given in _GIVEN if given not in arguments]
    if lacking:
        raise ValueError(f"auxiliary: {name.__name__} must take the argument {lacking[0]!r}")
    known = sorted({*arguments} - {"self", *_GIVEN})
    check_names(_options(settings), known, f"auxiliary ({name.name})")
    return name


def resolve_auxiliary(settings: Mapping[str, Any], env: VecEnv | None) -> dict[str, Any]:
    """Check settings and resolve what they refer to; see `AuxiliaryReward.resolve`."""
    chosen = reward_class(settings)
    return {**_common(settings), **chosen.resolve(_options(settings), env)}


def make_auxiliary(
    settings: Mapping[str, Any], policy: HerPolicy, learning_rate: float, gamma: float
) -> AuxiliaryCritic:
    """Build the reward that resolved settings name, with its critic."""
    chosen = reward_class(settings)
    reward = chosen(n_features=policy.actor.features_dim, **_options(settings))
    weight = settings.get("weight", AuxiliarySettings.weight)
    return AuxiliaryCritic(reward, policy, learning_rate, gamma, weight)


def _common(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that every auxiliary reward has."""
    return {key: settings[key] for key in _COMMON if key in settings}


def _options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of the reward's class."""
    return {key: value for key, value in settings.items() if key not in _COMMON}
