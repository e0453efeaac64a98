"""Callback that teaches the reach policy and lets reaching first fade."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import unwrap_vec_wrapper

from ..reach.policy import ReachPolicy
from ..reach.vec_env import ReachFirstVecEnv
from ..replay.her_replay_buffer import FollowObjectReplayBuffer
from ..settings.stages import ReachSettings
from .copyable import CopyableCallback

_SMOOTHING = 0.1  # of a rollout's rate in the running ones
_LEAST_SHARE = 0.02  # below it nobody reaches first any more


class ReachCallback(CopyableCallback):
    """Teach the reach policy after each rollout and carry it into the environments.

    The share of episodes that begin with reaching falls as the learner's own episodes come to the
    place by themselves; once it is nothing the reach policy learns no more. Records reach/share,
    reach/success (of episodes that begin with reaching) and reach/own_success (of all others).

    Args:
        seed: of the reach policy; None draws one from NumPy's global stream, which SB3 seeds.
        settings: of `ReachSettings`, as the environment's wrapper has them.

    Raises:
        ValueError: training starts in an environment without ReachFirstVecEnv or
            ReachFirstWrapper, or with another replay buffer than FollowObjectReplayBuffer.
    """

    def __init__(self, seed: int | None = None, **settings: Any) -> None:
        super().__init__()
        self.settings = ReachSettings(**settings)
        self.seed = seed
        self.policy: ReachPolicy | None = None
        self.success = self.own_success = 0.0

    def _on_training_start(self) -> None:
        if not self._is_wrapped():
            raise ValueError(
                "ReachCallback needs an environment wrapped in ReachFirstVecEnv or "
                "ReachFirstWrapper; in this one nothing reaches first"
            )
        buffer = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, FollowObjectReplayBuffer):
            raise ValueError(
                "ReachCallback learns from a FollowObjectReplayBuffer; the model has a "
                f"{type(buffer).__name__}: give replay_buffer_class=FollowObjectReplayBuffer"
            )
        if self._made_policy()._n_updates:
            self._carry()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer: Any = self.model.replay_buffer  # type: ignore[attr-defined]
        self._count()
        if buffer.is_ready() and self.share >= _LEAST_SHARE:
            policy = self._made_policy()
            policy.learn(buffer, self.settings.n_updates, self.settings.batch_size)
        self._carry()
        self.logger.record("reach/share", self.share)
        self.logger.record("reach/success", self.success)
        self.logger.record("reach/own_success", self.own_success)

    @property
    def share(self) -> float:
        """Share of the episodes that begin with reaching now."""
        share = self.settings.share * (1.0 - self.own_success * self.settings.fade)
        return share if share >= _LEAST_SHARE else 0.0

    def _made_policy(self) -> ReachPolicy:
        if self.policy is None:
            seed = int(np.random.randint(2**31 - 1000)) if self.seed is None else self.seed
            space, actions = self.model.observation_space, self.model.action_space
            assert isinstance(space, spaces.Dict) and isinstance(actions, spaces.Box)
            self.policy = ReachPolicy(space, actions, self.settings, seed)
        return self.policy

    def _count(self) -> None:
        reached, came, own, came_by_itself = np.sum(self._ask("take_counts"), axis=0)
        if reached:
            self.success += _SMOOTHING * (came / reached - self.success)
        if own:
            self.own_success += _SMOOTHING * (came_by_itself / own - self.own_success)

    def _carry(self) -> None:
        self._ask("set_reach", self._made_policy().actor(), self.share)

    def _is_wrapped(self) -> bool:
        wrapped = unwrap_vec_wrapper(self.training_env, ReachFirstVecEnv)
        return wrapped is not None or self.training_env.has_attr("set_reach")

    def _ask(self, method: str, *arguments: Any) -> list[Any]:
        """Return what each wrapper's method returns."""
        wrapped = unwrap_vec_wrapper(self.training_env, ReachFirstVecEnv)
        if wrapped is not None:
            return [getattr(wrapped, method)(*arguments)]
        return self.training_env.env_method(method, *arguments)

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training needs."""
        return {
            "policy": None if self.policy is None else self.policy.state_dict(),
            "success": float(self.success),
            "own_success": float(self.own_success),
        }

    def load_state_dict(self, state: dict[str, Any], model: Any) -> None:
        """Continue from ``state_dict``; `model` is the one that will be trained."""
        self.success, self.own_success = float(state["success"]), float(state["own_success"])
        if state["policy"] is not None:
            self.model = model
            self._made_policy().load_state_dict(state["policy"])
