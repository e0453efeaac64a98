"""Goal-conditioned actor and critic: normalised inputs, optional LayerNorm in the critic."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from ..common.mirrors import Mirror, as_mirrors
from ..common.torch_helpers import WholeModule, one_thread_after_forks, usual_defaults
from ..settings.learning import PolicySettings
from .folding import AUTO, Folding, folding_of
from .layer_norm import LayerNorm

one_thread_after_forks()

# What TD3Policy takes and HerPolicy brings its own of.
_BROUGHT = ("features_extractor_class", "features_extractor_kwargs")
_KERNELS = {"fused", "foreach", "differentiable"}  # of Adam's, one of them at a time


class NormalizedGoalExtractor(BaseFeaturesExtractor):
    """Observation and desired goal, standardised and clipped, as one vector.

    The achieved goal is part of the observation already and is left out. The moments are buffers,
    so they are saved with the policy and `predict` takes raw observations.

    Args:
        observation_space: Dict with "observation" and "desired_goal".
        clip: bound on each standardised entry, in standard deviations.
        folding: brings both to one side of planes of symmetry before.
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        clip: float = PolicySettings.features_clip,
        folding: Folding | None = None,
    ):
        self.keys = ("observation", "desired_goal")
        dim = sum(get_flattened_obs_dim(observation_space[key]) for key in self.keys)
        super().__init__(observation_space, dim)
        self.clip = clip
        self.folding = folding
        self.register_buffer("mean", th.zeros(dim))
        self.register_buffer("std", th.ones(dim))

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if "folding" not in self._modules:  # pickled before there was any
            vars(self).setdefault("folding", None)

    def fold_actions(self, actions: th.Tensor, observations: PyTorchObs) -> th.Tensor:
        """Mirror actions (n, a) where `forward` mirrors the states, or back."""
        if self.folding is None:
            return actions
        assert isinstance(observations, dict)
        return self.folding.actions(actions, observations["desired_goal"].float().flatten(1))

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Map a batch of observations to features (n, features_dim)."""
        parts = tuple(observations[key].float().flatten(1) for key in self.keys)
        if self.folding is not None:
            parts = self.folding.states(*parts)
        inputs = th.cat(parts, dim=-1)
        return ((inputs - self.mean) / self.std).clamp_(-self.clip, self.clip)


class FoldedActor(Actor):
    """SB3's actor, whose actions in states that were mirrored are mirrored back."""

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """Map a batch of observations to actions (n, action_dim)."""
        actions = super().forward(obs)  # type: ignore[arg-type]
        return _extractor_of(self).fold_actions(actions, obs)


class LayerNormCritic(ContinuousCritic):
    """SB3's critic with LayerNorm after each hidden layer."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        for idx in range(self.n_critics):
            layers: list[nn.Module] = []
            for layer in self.q_networks[idx]:  # type: ignore[attr-defined]
                layers.append(layer)
                if isinstance(layer, nn.Linear) and layer.out_features > 1:
                    layers.append(LayerNorm(layer.out_features))
            q_net = nn.Sequential(*layers)
            self.add_module(f"qf{idx}", q_net)
            self.q_networks[idx] = q_net


class FoldedCritic(ContinuousCritic):
    """SB3's critic, which sees actions mirrored where states are."""

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Map a batch of observations and actions to the value of each critic (n, 1)."""
        return super().forward(obs, _extractor_of(self).fold_actions(actions, obs))  # type: ignore[arg-type]

    def q1_forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Map them to the value of the first critic (n, 1)."""
        return super().q1_forward(obs, _extractor_of(self).fold_actions(actions, obs))  # type: ignore[arg-type]


class FoldedLayerNormCritic(FoldedCritic, LayerNormCritic):
    """Both."""


def _extractor_of(network: Actor | ContinuousCritic) -> NormalizedGoalExtractor:
    extractor = network.features_extractor
    assert isinstance(extractor, NormalizedGoalExtractor)
    return extractor


def with_fused_adam(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Return a policy's arguments with one kernel for all parameters, where its optimiser has it.

    An update is memory-bound otherwise. A kernel that was chosen stays.
    """
    if kwargs.get("optimizer_class", th.optim.Adam) not in (th.optim.Adam, th.optim.AdamW):
        return kwargs
    given = kwargs.get("optimizer_kwargs") or {}
    if not _KERNELS.isdisjoint(given):
        return kwargs
    return {**kwargs, "optimizer_kwargs": {"fused": True, **given}}


class HerPolicy(WholeModule, TD3Policy):
    """Actor and critics of three layers of 256 on normalised observations and goals.

    `predict` asks `actor_average`, a running average of the actor's weights, or the actor itself
    unless `HerDDPG` is told to average; `actor` is the one that learns and explores.

    Args:
        critic_layer_norm: LayerNorm after each hidden layer of the critics. Beyond the paper.
        features_clip: see `NormalizedGoalExtractor`.
        mirrors: planes over which the environment is symmetric, as `Mirror` or its fields: the
            networks see every state on one side of them. Beyond the paper.

    The other arguments are TD3Policy's, but for the features extractor's class and arguments, which
    are HerPolicy's own; `HerDDPG` refuses share_features_extractor in its policy_kwargs, too.

    Raises:
        ValueError: an invalid argument; or, by `predict`, another algorithm than `HerDDPG` has
            trained it, which does not move the averaged actor.
    """

    averages = False  # whether its algorithm moves the averaged actor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        critic_layer_norm: bool = PolicySettings.critic_layer_norm,
        features_clip: float = PolicySettings.features_clip,
        mirrors: Sequence[Mirror | Mapping[str, Any]] | None = None,
        **kwargs: Any,
    ):
        for brought in _BROUGHT:
            if brought in kwargs:
                raise ValueError(
                    f"HerPolicy brings its own features extractor; leave {brought} out"
                )
        self.critic_layer_norm = critic_layer_norm
        self.features_clip = features_clip
        with usual_defaults():
            folding = folding_of(_given(mirrors), observation_space, action_space)
            super().__init__(
                observation_space,
                action_space,
                lr_schedule,
                net_arch=[256, 256, 256] if net_arch is None else net_arch,
                features_extractor_class=NormalizedGoalExtractor,
                features_extractor_kwargs={"clip": features_clip, "folding": folding},
                **with_fused_adam(kwargs),
            )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        """What `save` writes beside the weights, for `load` to build the policy from."""
        arguments = super()._get_constructor_parameters()
        for brought in _BROUGHT:
            del arguments[brought]
        own = {
            "critic_layer_norm": self.critic_layer_norm,
            "features_clip": self.features_clip,
            "mirrors": [mirror.plain() for mirror in self.mirrors],
        }
        return {**arguments, **own}

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_average = copy.deepcopy(self.actor)
        del self.actor_average.optimizer
        self.actor_average.requires_grad_(False)
        self.actor_average.set_training_mode(False)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if self.actor.optimizer.state and not self.averages:
            raise ValueError(
                "HerPolicy is HerDDPG's alone, which moves the averaged actor that it plays; for "
                "DDPG and TD3 take GoalPolicy"
            )
        return self.actor_average(observation)

    @th.no_grad()
    def update_average(self, decay: float) -> None:
        """Move the averaged actor towards the actor, keeping the share `decay` in [0, 1] of it."""
        average: list[th.Tensor] = [*self.actor_average.parameters()]
        live: list[th.Tensor] = [*self.actor.parameters()]
        if decay == 0.0:  # exactly, to the last bit
            th._foreach_copy_(average, live)
        else:
            th._foreach_lerp_(average, live, 1.0 - decay)

    @property
    def mirrors(self) -> tuple[Mirror, ...]:
        """The planes over which the networks' inputs are folded."""
        folding = _extractor_of(self.actor).folding
        return () if folding is None else folding.mirrors

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Build the actor (or its target)."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return FoldedActor(**kwargs).to(self.device)

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        """Build one critic (or its target)."""
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        critic_class = FoldedLayerNormCritic if self.critic_layer_norm else FoldedCritic
        return critic_class(**critic_kwargs).to(self.device)

    def live_and_targets(self) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """Return the parameters of the live and of the target networks, in the same order."""
        live: list[th.Tensor] = [*self.actor.parameters(), *self.critic.parameters()]
        target: list[th.Tensor] = [
            *self.actor_target.parameters(),
            *self.critic_target.parameters(),
        ]
        return live, target

    def set_moments(self, mean: th.Tensor, std: th.Tensor) -> None:
        """Give every network the same moments, (features_dim,) each."""
        actors = (self.actor, self.actor_target, self.actor_average)
        for net in (*actors, self.critic, self.critic_target):
            extractor = _extractor_of(net)
            extractor.mean.copy_(mean)
            extractor.std.copy_(std)


def _given(mirrors: Any) -> list[Mirror]:
    if mirrors == AUTO:
        raise ValueError('mirrors "auto" are those of an environment, which HerDDPG asks for them')
    return as_mirrors([] if mirrors is None else mirrors)
