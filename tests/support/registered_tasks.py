"""Tasks that a test registers, and how the next test does without them."""

import sys

import gymnasium as gym

from sb3_follow_object.envs.task_table import BUILT_IN, IDS, TASKS


def forget_tasks() -> None:
    """Make this process know the package's own tasks alone; an import registers others anew."""
    for env_id in set(IDS) - BUILT_IN:
        TASKS.pop(IDS.pop(env_id)[0].name, None)
        gym.registry.pop(env_id)
    sys.modules.pop("own_tasks", None)
