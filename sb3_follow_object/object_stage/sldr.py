"""SLDR: pay the robot for moving the object as the object would move (Kilinc et al., 2019)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.vec_env import VecEnv

from ..common.providers import provider
from ..ddpg.auxiliary import AuxiliaryReward, Transitions, reward_class
from ..envs import IDS, object_state, physics_id
from .networks import ObjectNetworks

AUTO = "auto"  # the networks that `get_object_networks` keeps for the environment's task


class SldrReward(AuxiliaryReward):
    """How much worse the object moved than its own policy would have moved it.

    clip(Q_obj(z, u) - Q_obj(z, nu(z)), -1, 0), where z is the object's state, nu its policy and u
    the object action that would have led from z to the next state, from an inverse model.

    Args:
        n_features: given to every reward; not used.
        object_networks: Q_obj, nu and the inverse model; or the file that they were saved in; or
            "auto", those that `get_object_networks` keeps for this task.
    """

    name: ClassVar[str] = "sldr"

    def __init__(
        self, n_features: int, object_networks: ObjectNetworks | str | os.PathLike[str] = AUTO
    ) -> None:
        super().__init__()
        if not isinstance(object_networks, ObjectNetworks):
            raise ValueError(
                f"auxiliary (sldr): object_networks {str(object_networks)!r} can only be found "
                "for an environment; give an ObjectNetworks"
            )
        self.reward_range = (-1.0, 0.0)
        self.networks = object_networks

    @classmethod
    def resolve(cls, options: dict[str, Any], env: VecEnv | None) -> dict[str, Any]:
        """Return the arguments with the networks themselves.

        Raises:
            ValueError: the environment is no robot task of this package, or the networks are
                missing or were made for another one.
        """
        networks = options.get("object_networks", AUTO)
        if env is None:
            return options  # a saved algorithm brings them
        env_id = task_of_package(env)
        if isinstance(networks, ObjectNetworks):
            networks.check(env_id, physics_id(env_id), "the object_networks given")
        elif networks == AUTO:
            networks = provider("object networks", AUTO)(env_id)
        else:
            networks = ObjectNetworks.load(networks, env_id=env_id, physics=physics_id(env_id))
        return {**options, "object_networks": networks}

    def forward(self, batch: Transitions) -> th.Tensor:
        """Return the rewards (n, 1) of a batch of the robot's transitions."""
        state = object_state(batch.observations["observation"])
        next_state = object_state(batch.next_observations["observation"])
        goal = batch.observations["desired_goal"]
        networks = self.networks
        caused = networks.value(state, goal, networks.infer(state, next_state, goal))
        best = networks.value(state, goal, networks.act(state, goal))
        return (caused - best).clamp(-1.0, 0.0)


def reads_object_networks(algorithm: Mapping[str, Any]) -> bool:
    """Whether an algorithm's settings ask for this reward, whose networks a run makes itself.

    Raises:
        ValueError: the auxiliary reward's settings are wrong, or name networks of their own.
    """
    settings = algorithm.get("auxiliary")
    if settings is None or reward_class(settings) is not SldrReward:
        return False
    if settings.get("object_networks", AUTO) != AUTO:
        raise ValueError(
            "algorithm: auxiliary.object_networks cannot be set where the object stage makes them; "
            "give FollowObject object_networks instead"
        )
    return True


def task_of_package(env: VecEnv) -> str:
    """Return the id of the robot task that an environment is.

    Raises:
        ValueError: it is none of this package, whose observations alone hold the object's state.
    """
    spec = env.get_attr("spec", indices=[0])[0]
    env_id = "" if spec is None else str(spec.id)
    if env_id not in IDS or IDS[env_id][1]:
        raise ValueError(
            f"auxiliary (sldr) needs a robot task of this package, not {env_id or 'this one'!r}: "
            "its reward comes from the object alone, which other environments do not have"
        )
    return env_id
