"""States and actions brought to one side of the planes over which an environment is symmetric."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim, get_flattened_obs_dim
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from ..common.mirrors import Mirror, as_mirrors
from ..settings.planes import known_mirrors

AUTO = "auto"  # the planes of the environment
_GOAL = 3


class Folding(nn.Module):
    """Mirrors states whose goal lies on the lower side of a plane, and the actions in them.

    What a network learns on one side it then can do on the other. The side is the goal's, which
    stays where it is but for an episode that goes on from an imagined goal to the original one.

    Args:
        mirrors: one for each plane, on different axes.
        observation_size: entries of an observation.
        action_size: entries of an action.

    Raises:
        ValueError: mirrors that do not fit these, or two on the same axis.
    """

    def __init__(self, mirrors: Sequence[Mirror], observation_size: int, action_size: int) -> None:
        super().__init__()
        self.mirrors = tuple(mirrors)
        axes = [mirror.axis for mirror in self.mirrors]
        if len(set(axes)) < len(axes):
            raise ValueError(f"mirrors: two stand across the same axis, of {axes}")
        for mirror in self.mirrors:
            sizes = {"observation": observation_size, "action": action_size}
            for (what, size), needed in zip(sizes.items(), mirror.needs, strict=True):
                if needed > size:
                    raise ValueError(
                        f"mirrors: the one across axis {mirror.axis} tells of entry {needed - 1} "
                        f"of an {what}, which has {size}"
                    )
        self.planes = [_Plane(mirror, observation_size, action_size) for mirror in self.mirrors]
        self._tables = nn.ModuleList(self.planes)  # moves with the networks

    def states(self, observations: th.Tensor, goals: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return observations (n, d) and goals (n, 3), mirrored where the goals say so."""
        for plane in self.planes:
            observations, goals = plane.states(observations, goals)
        return observations, goals

    def actions(self, actions: th.Tensor, goals: th.Tensor) -> th.Tensor:
        """Return actions (n, a) mirrored where the goals (n, 3), as they came, say so.

        Twice is once more the action that it was: the same brings a network's answer back.
        """
        for plane in self.planes:
            actions = plane.actions(actions, goals)
        return actions


class _Plane(nn.Module):
    """One mirror's tables; a policy has its mirrors besides, so that they need not be saved."""

    order: th.Tensor
    sign: th.Tensor
    shift: th.Tensor
    goal_sign: th.Tensor
    goal_shift: th.Tensor
    action_sign: th.Tensor

    def __init__(self, mirror: Mirror, observation_size: int, action_size: int) -> None:
        super().__init__()
        self.axis, self.at = mirror.axis, mirror.at
        order, sign, shift = mirror.table(observation_size)
        origin = mirror.goal(np.zeros(_GOAL))
        tables = {
            "sign": sign,
            "shift": shift,
            "goal_sign": mirror.goal(np.ones(_GOAL)) - origin,
            "goal_shift": origin,
            "action_sign": mirror.action_sign(action_size),
        }
        self.register_buffer("order", th.from_numpy(order), persistent=False)
        for name, values in tables.items():
            self.register_buffer(name, th.from_numpy(values).float(), persistent=False)

    def states(self, observations: th.Tensor, goals: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        low = self._low(goals)
        mirrored = observations[:, self.order] * self.sign + self.shift
        return (
            th.where(low, mirrored, observations),
            th.where(low, goals * self.goal_sign + self.goal_shift, goals),
        )

    def actions(self, actions: th.Tensor, goals: th.Tensor) -> th.Tensor:
        return th.where(self._low(goals), actions * self.action_sign, actions)

    def _low(self, goals: th.Tensor) -> th.Tensor:
        return (goals[:, self.axis] < self.at)[:, None]


def folding_of(
    mirrors: Sequence[Mirror], observation_space: spaces.Space, action_space: spaces.Box
) -> Folding | None:
    """Return what folds over mirrors, or None where there are none.

    Raises:
        ValueError: they do not fit the spaces.
    """
    if not mirrors:
        return None
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError("mirrors are for observations that say the goal")
    if get_flattened_obs_dim(observation_space["desired_goal"]) != _GOAL:
        raise ValueError("mirrors are for goals that are positions (3,)")
    size = get_flattened_obs_dim(observation_space["observation"])
    folding = Folding(mirrors, size, get_action_dim(action_space))
    low, high = action_space.low.ravel(), action_space.high.ravel()
    for mirror in mirrors:
        for entry in mirror.actions:
            if low[entry] != -high[entry]:
                raise ValueError(
                    f"mirrors: entry {entry} of an action changes its sign, but its bounds are "
                    f"{low[entry]} and {high[entry]}"
                )
    return folding


def resolved_mirrors(given: Any, env: VecEnv | None) -> list[Mirror]:
    """Return mirrors, those of the environment for "auto".

    An environment's own are what its attribute `mirrors` holds; of one without it those that come
    with the package, if they do.

    Args:
        given: "auto", None, or a list of mirrors or their fields.
        env: that is trained in.

    Raises:
        ValueError: mirrors that are none.
    """
    if given == AUTO:
        return _named(env) if env is not None else []
    return as_mirrors([] if given is None else given)


def warn_of_other_planes(mirrors: Sequence[Mirror], env: VecEnv | None) -> None:
    """Warn where an environment names its planes and a policy folds over others."""
    if not mirrors or env is None or not env.has_attr("mirrors"):
        return
    named = _named(env)
    others = [mirror.axis for mirror in mirrors if mirror not in named]
    if others:
        warnings.warn(
            f"The policy folds over planes that the environment does not name, across axis {others}"
            ": states that differ there look alike to it.",
            stacklevel=3,
        )


def _named(env: VecEnv) -> list[Mirror]:
    if not env.has_attr("mirrors"):
        spec = env.get_attr("spec", indices=[0])[0] if env.has_attr("spec") else None
        return (
            [] if spec is None else known_mirrors(spec.id, env.observation_space, env.action_space)
        )
    held = env.get_attr("mirrors", indices=[0])[0]
    try:
        return as_mirrors(held)
    except ValueError as error:
        raise ValueError(
            f"the environment's attribute mirrors: {error}; or say policy_kwargs.mirrors=null"
        ) from error
