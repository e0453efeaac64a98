"""Callback that teaches the reach policy and lets reaching first fade."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import unwrap_vec_normalize, unwrap_vec_wrapper

from ..reach.policy import ReachPolicy
from ..reach.vec_env import ReachFirstVecEnv
from ..replay.her_replay_buffer import FollowObjectReplayBuffer
from ..settings.stages import ReachTeachingSettings, part_of_reach
from .copyable import CopyableCallback
from .rollout import check_hears_rollouts

_SMOOTHING = 0.1  # weight of a rollout's rate in the running ones
_LEAST_SHARE = 0.02  # below it nobody reaches first any more


class ReachCallback(CopyableCallback):
    """Teach the reach policy after rollouts and carry it into the environments.

    Where the effector is and when it has arrived it takes from the environment's wrapper. It
    teaches when a rollout ends, if as many episodes have ended as there are copies. The reach
    policy learns the less the fewer of its episodes fail. The share of episodes that begin with
    reaching falls as the learner's own episodes come to the place by themselves; while it is
    nothing the reach policy learns no more. Records reach/share, reach/success (of episodes that
    begin with reaching) and reach/own_success (of all others). It keeps what it has learned when
    another training begins.

    Args:
        seed: of the reach policy; None draws one from NumPy's global stream, which SB3 seeds.
        verbose: as of any callback of SB3; it has nothing to print.
        settings: of `ReachTeachingSettings`.

    Attributes:
        policy: the reach policy, once training has started.
        success: running share in [0, 1] of the episodes begun with reaching that come to the place.
        own_success: the same of all others.

    Raises:
        ValueError: an invalid setting; or training starts in an environment without
            ReachFirstVecEnv or ReachFirstWrapper, with another replay buffer than
            FollowObjectReplayBuffer, or with a wrapper outside that changes the "observation".
    """

    def __init__(self, seed: int | None = None, verbose: int = 0, **settings: Any) -> None:
        super().__init__(verbose)
        given = part_of_reach(ReachTeachingSettings, settings, type(self).__name__)
        self.settings = ReachTeachingSettings(**given)
        self.seed = seed
        self.policy: ReachPolicy | None = None
        self.success = self.own_success = 0.0
        self._ended = 0  # episodes since it last taught
        self._has_looked = False  # at what the wrapper reaches by

    @property
    def share(self) -> float:
        """Share of the episodes that begin with reaching now."""
        learned = self.own_success if self.settings.fade else 0.0
        share = self.settings.share * (1.0 - learned)
        return share if share >= _LEAST_SHARE else 0.0

    @property
    def n_updates(self) -> int:
        """Gradient steps that the reach policy takes after a rollout now."""
        return max(1, round(self.settings.n_updates * (1.0 - self.success)))

    def _on_training_start(self) -> None:
        check_hears_rollouts(self)
        self._has_looked = False
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
        if self.policy is None:
            self.policy = self._make_policy()
        told = self._ask("reach_settings")[0]
        if (list(told.effector), told.tolerance) != (self.policy.effector, self.policy.tolerance):
            raise ValueError(
                f"this ReachCallback was taught with the effector {self.policy.effector} within "
                f"{self.policy.tolerance} m, and the environment has {list(told.effector)} within "
                f"{told.tolerance} m; give a new one"
            )
        shapes, known = _shapes(self.model), _shapes(self.policy.policy)
        if shapes != known:
            raise ValueError(
                f"this ReachCallback was taught with observations and actions of the shapes {known}"
                f", and the environment's are {shapes}; give a new one"
            )
        if self.policy.has_learned:
            self._carry(self.policy)

    def _on_training_end(self) -> None:
        # Whoever plays there now shall see what the learner can do. A training that was refused
        # has taught nothing; rl_zoo3 ends it all the same.
        if self.policy is not None and self.policy.has_learned:
            self._ask("set_reach", self.policy.actor(), 0.0)

    def _on_step(self) -> bool:
        self._ended += int(np.sum(self.locals["dones"]))
        if not self._has_looked:
            self._check_observation(self.locals["new_obs"]["observation"])
            self._has_looked = True
        return True

    def _check_observation(self, seen: np.ndarray) -> None:
        """Raise a ValueError where a wrapper outside changes what the reach policy is taught on.

        Args:
            seen: what the learner sees after a step, (n_envs, d).
        """
        normaliser = unwrap_vec_normalize(self.training_env)
        if normaliser is not None:
            seen = normaliser.get_original_obs()["observation"]
        played = np.concatenate(self._ask("reach_observation"))
        if seen.shape != played.shape or not np.allclose(seen, played, equal_nan=True):
            raise ValueError(
                "a wrapper outside of ReachFirstWrapper or ReachFirstVecEnv changes the "
                "observation, which the reach policy then knows otherwise than it is taught: put "
                "it inside"
            )

    def _on_rollout_end(self) -> None:
        if self._ended >= self.training_env.num_envs:
            self._ended = 0
            self._count()
            self._teach()
        self.logger.record("reach/share", self.share)
        self.logger.record("reach/success", self.success)
        self.logger.record("reach/own_success", self.own_success)

    def _count(self) -> None:
        """Bring the running rates up to the episodes that have ended."""
        counts = np.sum(self._ask("take_counts"), axis=0)
        (own_failed, own_came), (failed, came) = counts.tolist()
        if failed + came:
            self.success += _SMOOTHING * (came / (failed + came) - self.success)
        if own_failed + own_came:
            rate = own_came / (own_failed + own_came)
            self.own_success += _SMOOTHING * (rate - self.own_success)

    def _teach(self) -> None:
        assert self.policy is not None
        buffer: Any = self.model.replay_buffer  # type: ignore[attr-defined]
        if self.share and buffer.is_ready():
            self.policy.learn(buffer, self.n_updates, self.settings.batch_size)
        if self.policy.has_learned:
            self._carry(self.policy)

    def _carry(self, policy: ReachPolicy) -> None:
        self._ask("set_reach", policy.actor(), self.share)

    def _make_policy(self) -> ReachPolicy:
        seed = int(np.random.randint(2**31 - 1000)) if self.seed is None else self.seed
        space, actions = self.model.observation_space, self.model.action_space
        assert isinstance(space, spaces.Dict) and isinstance(actions, spaces.Box)
        return ReachPolicy(space, actions, self._ask("reach_settings")[0], seed)

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
        """Return what a resumed training needs, as tensors that training changes."""
        return {
            "policy": None if self.policy is None else self.policy.state_dict(),
            "success": float(self.success),
            "own_success": float(self.own_success),
            "ended": self._ended,
        }

    def load_state_dict(self, state: dict[str, Any], model: Any) -> None:
        """Continue from ``state_dict``; `model` is the one that will be trained."""
        self.success, self.own_success = float(state["success"]), float(state["own_success"])
        self._ended = int(state.get("ended", 0))  # saves of before had none
        if state["policy"] is not None:
            self.model = model
            self.policy = self._make_policy()
            self.policy.load_state_dict(state["policy"])


def _shapes(seen: Any) -> tuple[Any, Any]:
    """Of the observation and the action of a model or a policy."""
    return seen.observation_space["observation"].shape, seen.action_space.shape
