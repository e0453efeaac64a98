"""States and actions brought to one side of the planes over which an environment is symmetric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from ..common.mirrors import Mirror, as_mirror

GOAL_SIZE = 3


class Folding(nn.Module):
    """Mirrors states whose goal lies on the lower side of a plane, and the actions in them.

    What a network learns on one side it then can do on the other. The side is the goal's, which
    stays where it is for an episode.

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
        for number, mirror in enumerate(self.mirrors):
            needs = mirror.needs
            if needs[0] > observation_size or needs[1] > action_size:
                raise ValueError(
                    f"mirrors: the one across axis {mirror.axis} wants observations of {needs[0]} "
                    f"entries and actions of {needs[1]}; these have {observation_size} and "
                    f"{action_size}"
                )
            for name, value in _tables(mirror, observation_size, action_size).items():
                self.register_buffer(f"{name}_{number}", value, persistent=False)

    @property
    def device(self) -> th.device:
        """Where its tables are."""
        return self.get_buffer("order_0").device

    def states(self, observations: th.Tensor, goals: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return observations (n, d) and goals (n, 3), mirrored where the goals say so."""
        for number, mirror in enumerate(self.mirrors):
            order, sign, shift, goal_sign, goal_shift, _ = self._of(number)
            low = self._low(goals, mirror)
            observations = th.where(low, observations[:, order] * sign + shift, observations)
            goals = th.where(low, goals * goal_sign + goal_shift, goals)
        return observations, goals

    def actions(self, actions: th.Tensor, goals: th.Tensor) -> th.Tensor:
        """Return actions (n, a) mirrored where the goals (n, 3), as they came, say so.

        Twice is once more the action that it was: the same brings a network's answer back.
        """
        for number, mirror in enumerate(self.mirrors):
            *_, action_sign = self._of(number)
            actions = th.where(self._low(goals, mirror), actions * action_sign, actions)
        return actions

    def _of(self, number: int) -> list[th.Tensor]:
        return [self.get_buffer(f"{name}_{number}") for name in _TABLES]

    @staticmethod
    def _low(goals: th.Tensor, mirror: Mirror) -> th.Tensor:
        return (goals[:, mirror.axis] < mirror.at)[:, None]


_TABLES = ("order", "sign", "shift", "goal_sign", "goal_shift", "action_sign")


def _tables(mirror: Mirror, observation_size: int, action_size: int) -> dict[str, th.Tensor]:
    order, sign = th.arange(observation_size), th.ones(observation_size)
    shift, action_sign = th.zeros(observation_size), th.ones(action_size)
    sign[[*mirror.positions, *mirror.signs]] = -1.0
    shift[[*mirror.positions]] = 2.0 * mirror.at
    for first, second in mirror.swaps:
        order[[first, second]] = th.tensor([second, first])
    goal_sign, goal_shift = th.ones(GOAL_SIZE), th.zeros(GOAL_SIZE)
    goal_sign[mirror.axis], goal_shift[mirror.axis] = -1.0, 2.0 * mirror.at
    action_sign[[*mirror.actions]] = -1.0
    tables = order, sign, shift, goal_sign, goal_shift, action_sign
    return dict(zip(_TABLES, tables, strict=True))


def folding_of(
    mirrors: Sequence[Mirror | Mapping[str, Any]],
    observation_space: spaces.Space,
    action_space: spaces.Box,
) -> Folding | None:
    """Return what folds over mirrors, or None where there are none.

    Raises:
        ValueError: they do not fit the spaces.
    """
    if not mirrors:
        return None
    assert isinstance(observation_space, spaces.Dict)
    size = get_flattened_obs_dim(observation_space["observation"])
    if get_flattened_obs_dim(observation_space["desired_goal"]) != GOAL_SIZE:
        raise ValueError("mirrors are for goals that are positions (3,)")
    return Folding([as_mirror(each) for each in mirrors], size, *action_space.shape)


def resolved_mirrors(given: Any, env: VecEnv | None) -> list[dict[str, Any]]:
    """Return mirrors as plain values, those of the environment for "auto".

    Args:
        given: "auto", None, or mirrors or their fields.
        env: that is trained in; one without an attribute `mirrors` has none.

    Raises:
        ValueError: mirrors that are none.
    """
    if given == "auto":
        has = env is not None and env.has_attr("mirrors")
        given = env.get_attr("mirrors", indices=[0])[0] if has and env is not None else ()
    return [as_mirror(mirror).plain() for mirror in given or ()]
