"""The tasks of the paper as environments: the robot's and the object's alone, single and batched.

Importing this registers ids and loads little: the classes, and with them mujoco and
Stable-Baselines3, are loaded when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .ids import IDS, make_vec, object_id, physics_id, register_envs, register_task
from .tasks import TASKS, Box, Height, Region, Task

if TYPE_CHECKING:
    from .fetch import FetchEnv as FetchEnv
    from .fetch import FetchVecEnv as FetchVecEnv
    from .fetch import object_state as object_state
    from .object_locomotion import ObjectEnv as ObjectEnv
    from .object_locomotion import ObjectVecEnv as ObjectVecEnv
    from .scene import object_only as object_only

_HOME = {
    "FetchEnv": "fetch",
    "FetchVecEnv": "fetch",
    "ObjectEnv": "object_locomotion",
    "ObjectVecEnv": "object_locomotion",
    "object_only": "scene",
    "object_state": "fetch",
}

__all__ = [
    "IDS",
    "TASKS",
    "Box",
    "Height",
    "Region",
    "Task",
    "make_vec",
    "object_id",
    "physics_id",
    "register_envs",
    "register_task",
    *_HOME,
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)
