"""A policy for stock DDPG and TD3 with what keeps them learning from sparse rewards of -1 and 0."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import Actor, MultiInputPolicy

from ..common.torch_helpers import WholeModule, usual_defaults
from ..settings.learning import GoalPolicySettings
from .policies import LayerNormCritic, with_fused_adam


class GoalPolicy(WholeModule, MultiInputPolicy):
    """TD3's MultiInputPolicy whose critic has bounds and whose actor pays for large actions.

    Stock algorithms have no setting for the three things that `HerDDPG` does about values that run
    away and actions that stick to their limits, so they are in the networks: LayerNorm in the
    critics, targets within the returns that rewards can sum up to, and a price on large actions.
    Inputs are left to VecNormalize.

    Args:
        action_l2: weight, >= 0, of the mean squared action in the actor's loss; it comes in with
            the gradient, so that the algorithm's own loss stays as it is.
        target_clip: (low, high), bounds of what the target critic says; for rewards of -1 and 0
            they are -1/(1 - gamma) and 0. None, none.

    The other arguments are MultiInputPolicy's; net_arch is three layers of 256 by default.

    Raises:
        ValueError: an argument outside its range.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        action_l2: float = GoalPolicySettings.action_l2,
        target_clip: tuple[float, float] | None = GoalPolicySettings.target_clip,
        **kwargs: Any,
    ):
        if "use_sde" in kwargs:  # which SAC and TQC give every policy
            raise ValueError(
                "GoalPolicy is for DDPG and TD3, which know no use_sde: with SAC and TQC take "
                '"MultiInputPolicy" and policy_kwargs={"activation_fn": LayerNormReLU}'
            )
        if "mirrors" in kwargs:
            raise ValueError("GoalPolicy is without mirrors: leave mirrors out")
        settings = GoalPolicySettings(action_l2=action_l2, target_clip=target_clip)
        self.action_l2 = settings.action_l2
        self.target_clip = settings.target_clip
        kwargs = with_fused_adam(kwargs)
        if kwargs.get("net_arch") is None:
            kwargs = {**kwargs, "net_arch": [256, 256, 256]}
        with usual_defaults():
            super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"action_l2": self.action_l2, "target_clip": self.target_clip}
        return {**super()._get_constructor_parameters(), **own}

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        assert isinstance(self.critic_target, _BoundedCritic)
        self.critic_target.bounds = self.target_clip

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Build the actor (or its target)."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        actor = _PricedActor(**kwargs).to(self.device)
        actor.action_l2 = self.action_l2
        return actor

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        """Build the critics (or their targets)."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return _BoundedCritic(**kwargs).to(self.device)


class _PricedActor(Actor):
    """The gradient of what follows has that of `action_l2` times the mean squared action added."""

    action_l2 = 0.0

    def forward(self, obs: Any) -> th.Tensor:
        actions = super().forward(obs)
        # A hook is another each time, which tracing refuses; what is exported needs none.
        if actions.requires_grad and self.action_l2 and not th.jit.is_tracing():
            price = 2.0 * self.action_l2 / actions.numel() * actions.detach()
            actions.register_hook(lambda gradient: gradient + price)
        return actions


class _BoundedCritic(LayerNormCritic):
    """What the critics say is kept within bounds, where there are any."""

    bounds: tuple[float, float] | None = None

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        values = super().forward(obs, actions)
        return values if self.bounds is None else tuple(q.clamp(*self.bounds) for q in values)
