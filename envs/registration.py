"""The tasks in gymnasium's registry."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import redirect_stderr
from importlib import import_module
from io import StringIO
from types import MappingProxyType
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from .task_table import IDS, add_task
from .tasks import Task

_PACKAGE = __package__


def register_envs() -> None:
    """Register all ids with gymnasium; calling it again changes nothing."""
    for env_id, (task, alone) in IDS.items():
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point=f"{_PACKAGE}:{'ObjectEnv' if alone else 'FetchEnv'}",
                max_episode_steps=task.horizon,
                kwargs={"task": task.name},
            )


def register_task(task: Task) -> str:
    """Add a task of one's own, which then is known wherever the package's own tasks are.

    Args:
        task: its name gives the ids `FollowObject/<name>-v0` and `FollowObject/<name>Object-v0`.
            The same task may be registered again.

    Returns:
        The id of the robot's environment.

    Raises:
        ValueError: another task has the name or one of its ids.
    """
    env_id = add_task(task)
    register_envs()
    return env_id


def import_task(env_id: str) -> str:
    """Import the module that may register an id and return the id without the module's name.

    Args:
        env_id: gymnasium id, with "module:" before it where importing that module registers it.

    Raises:
        ValueError: it is no id, or the module cannot be imported.
    """
    if not isinstance(env_id, str):
        raise ValueError(f"{env_id!r} is no environment's id, which is text")
    module, _, name = env_id.rpartition(":")
    if module:
        try:
            import_module(module)
        except Exception as error:  # a module of somebody's may raise anything
            reason = str(error) or type(error).__name__
            raise ValueError(
                f"{env_id!r} names a module that cannot be imported ({reason}); "
                "is it installed, or its folder on PYTHONPATH?"
            ) from error
    elif name not in gym.registry:
        import_robotics()
    return name


def registration_key(spec: EnvSpec, options: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Return what tells an environment from another of its id that was registered since."""
    said = repr(sorted({**spec.kwargs, **options}.items(), key=str))
    return spec.id, spec.entry_point, spec.max_episode_steps, said


def import_robotics() -> None:
    """Have Gymnasium-Robotics register its tasks, unless it has."""
    with redirect_stderr(StringIO()):  # it speaks of other environments' versions
        import_module("gymnasium_robotics")
