"""Whether Gymnasium-Robotics' own environments run with the mujoco that is installed."""

from __future__ import annotations

from importlib.metadata import version

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

_PACKAGE = "gymnasium-robotics"
# From this mujoco on enums no longer equal NumPy integers standing on the right, and up to this
# release the package compares joint types that way: none of its environments resets.
_FIRST_MUJOCO = (3, 12)
_LAST_ROBOTICS = (1, 4, 2)


def check_robotics(env_id: str) -> None:
    """Raise a ValueError for an environment of Gymnasium-Robotics' that cannot run here.

    This package's tasks need its files alone, and run with every mujoco that is asked for.

    Args:
        env_id: a registered id; others are let through.
    """
    spec = gym.registry.get(env_id)
    if spec is None or not is_of_robotics(spec):
        return
    mujoco, robotics = version("mujoco"), version(_PACKAGE)
    if _numbers(mujoco) >= _FIRST_MUJOCO and _numbers(robotics) <= _LAST_ROBOTICS:
        raise ValueError(
            f"{env_id!r} is {_PACKAGE}'s own, and its {robotics} does not run with mujoco "
            f"{mujoco}: pip install 'mujoco<3.12', or take a task of this package"
        )


def is_of_robotics(spec: EnvSpec) -> bool:
    """Whether an environment is Gymnasium-Robotics' own."""
    return str(spec.entry_point).startswith("gymnasium_robotics.")


def _numbers(release: str) -> tuple[int, ...]:
    return tuple(int(part) for part in release.split(".")[:3] if part.isdigit())
