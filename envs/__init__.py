"""The tasks of the paper as environments: the robot's and the object's alone, single and batched.

Importing this registers ids and loads little: the classes, and with them mujoco and
Stable-Baselines3, are loaded when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .registration import register_envs, register_task
from .task_table import IDS, TASKS, object_id
from .tasks import Box, Height, Region, Task

if TYPE_CHECKING:
    from .fetch import FetchEnv as FetchEnv
    from .fetch import FetchVecEnv as FetchVecEnv
    from .fetch import object_state as object_state
    from .make import make_vec as make_vec
    from .make import physics_id as physics_id
    from .object_locomotion import ObjectEnv as ObjectEnv
    from .object_locomotion import ObjectVecEnv as ObjectVecEnv
    from .robot_face import RobotTask as RobotTask

_HOME = {
    "FetchEnv": "fetch",
    "FetchVecEnv": "fetch",
    "ObjectEnv": "object_locomotion",
    "ObjectVecEnv": "object_locomotion",
    "RobotTask": "robot_face",
    "make_vec": "make",
    "object_state": "fetch",
    "physics_id": "make",
}

__all__ = [
    "IDS",
    "TASKS",
    "Box",
    "Height",
    "Region",
    "Task",
    "object_id",
    "register_envs",
    "register_task",
    *_HOME,
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)
