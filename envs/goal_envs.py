"""Which environment an id means, and whether a robot can pursue goals there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from ..common.suggestions import did_you_mean
from .registration import import_task
from .robotics import check_robotics
from .task_table import IDS

SUCCESS_METHODS = ("is_success", "_is_success")  # ours, and gymnasium-robotics'
SAY_GOALS = (
    "say with goal= and is_success= what is achieved, what is desired and when that is reached"
)
SAY_LENGTH = "register it with max_episode_steps, or wrap it in gymnasium.wrappers.TimeLimit"
_GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


def check_task(env_id: str) -> str:
    """Return an id without a module's name, if a robot can pursue goals there.

    Raises:
        ValueError: gymnasium does not know the id, or the environment has no goals or no horizon
            or does not tell whether a goal is reached.
    """
    name = import_task(env_id)
    if name not in gym.registry:
        near = did_you_mean(name, [*IDS, *gym.registry])
        raise ValueError(f"there is no environment {env_id!r}{near}")
    if name in IDS:
        return name
    check_robotics(name)
    try:
        env = gym.make(name)
    except Exception as error:  # an environment of somebody's may raise anything
        raise ValueError(f"{env_id!r} cannot be made: {error or type(error).__name__}") from error
    try:
        check_goal_keys(env.observation_space, repr(env_id))
        if env.spec is None or env.spec.max_episode_steps is None:
            raise ValueError(f"{env_id!r} does not say how long its episodes are; {SAY_LENGTH}")
        if _hides_success(env) and not _judges(env):
            raise ValueError(f"{env_id!r} does not tell in its info whether the goal is reached")
    finally:
        env.close()
    return name


def success_method(get: Callable[[str], Any]) -> str | None:
    """Return the name of the method that says whether any goal is reached; None, there is none.

    What has the name and is no method does not count.

    Args:
        get: returns an attribute by its name, as an environment's `get_wrapper_attr` does; raises
            an AttributeError where there is none.
    """
    return next((name for name in SUCCESS_METHODS if has_method(get, name)), None)


def has_method(get: Callable[[str], Any], name: str) -> bool:
    """Whether there is a method of a name, `get` being as in `success_method`."""
    try:
        return callable(get(name))
    except AttributeError:
        return False


def _judges(env: gym.Env) -> bool:
    """Whether an environment can be asked whether a goal is reached."""
    get = env.get_wrapper_attr
    return success_method(get) is not None or has_method(get, "compute_reward")


def _hides_success(env: gym.Env) -> bool:
    """Whether a whole episode's info never says `is_success`."""
    try:
        env.reset(seed=0)
        over = False
        while not over:
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            if "is_success" in info:
                return False
            over = terminated or truncated
        return True
    except Exception:  # an environment of somebody's may raise anything; training will tell it
        return False


def check_goal_keys(space: spaces.Space, who: str) -> None:
    """Raise a ValueError about `who`, with what would help, where observations hold no goals."""
    missing = ", ".join(missing_goal_keys(space))
    if missing:
        raise ValueError(f"{who} has no goals: its observations lack {missing}; {SAY_GOALS}")


def missing_goal_keys(space: spaces.Space) -> list[str]:
    """Return what observations lack of a goal environment's, in the alphabet's order."""
    return sorted(set(_GOAL_KEYS) - set(space.spaces if isinstance(space, spaces.Dict) else ()))


def episode_steps(env: Any) -> int | None:
    """Return T, steps of an episode, of a VecEnv that tells it in its spec."""
    if not env.has_attr("spec"):
        return None
    spec = env.get_attr("spec", indices=[0])[0]
    return None if spec is None or spec.max_episode_steps is None else int(spec.max_episode_steps)


def known_id(env_id: str) -> str:
    """Return an id as the package's tables have it: without a module, if it is one of ours.

    Raises:
        ValueError: the module that it names cannot be imported.
    """
    name = import_task(env_id)
    return name if name in IDS else env_id
