"""What the stages ask of a task, whether it is this package's own or anybody's."""

from __future__ import annotations

import hashlib
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from ..envs import IDS, make_vec, object_id, physics_id
from ..envs.goal_envs import missing_goal_keys
from ..envs.registration import import_task, registration_key
from ..envs.robot_copies import robot_maker
from ..envs.tasks import SUCCESS_DISTANCE
from .context import bodies_in
from .derived import derived, object_horizon, raised_by, told_effector
from .finding import Effector, find_effector, observe
from .physics_access import is_simulated
from .simulation import DerivedObjectVecEnv

SURFACE_STEPS = 120_000  # env steps after which an object left on its surface may leave it
_LEAST_TO_REACH = 25  # env steps


def what_is_followed(env_id: str) -> str:
    """A sentence about what was found out of a task of others; "" for this package's own.

    Raises:
        ValueError: its object cannot be followed.
    """
    if env_id in IDS:
        return ""
    found = derived(env_id)
    within = f"goals are reached within {found.success_distance * 1e3:.0f} mm"
    shifted = "; rewards of 1 and 0 are shown as 0 and -1" if found.shifted else ""
    others = ", ".join(bodies_in(found.context))
    seen = f"; nu and F_phi also see the place of {others}" if others else ""
    return f"the object of {env_id} is {found.object.name}, {within}{shifted}{seen}"


def success_distance_of(env_id: str) -> float:
    """Metres within which a task's goals are reached.

    Raises:
        ValueError: its object cannot be followed.
    """
    return SUCCESS_DISTANCE if env_id in IDS else derived(env_id).success_distance


def physics_of_task(env_id: str) -> str:
    """A short hash of what decides how the object moves and where goals lie in a task.

    Raises:
        ValueError: its object cannot be followed.
    """
    return physics_id(env_id) if env_id in IDS else derived(env_id).physics


def context_of_task(env_id: str) -> tuple[str, ...]:
    """What a task's episodes differ in beside start and goal, by the names of `read_context`.

    Raises:
        ValueError: its object cannot be followed.
    """
    return () if env_id in IDS else derived(env_id).context


def kept_as(env_id: str) -> str:
    """The folder's name of what is kept of a task: its physics, and what its F_phi sees.

    Raises:
        ValueError: its object cannot be followed.
    """
    on_surface = True in surface_choices(env_id)
    if env_id in IDS:
        return physics_id(env_id) + "-edge" * on_surface  # of tables, off whose edge it is kept
    task = derived(env_id)
    told = hashlib.sha256(" ".join(task.context).encode()).hexdigest()[:6]
    edge = "-edge" * (on_surface and bool(np.isfinite(task.scene.surface).any()))
    return task.kept_as + (f"-{told}" if task.context else "") + edge


def surface_choices(env_id: str, setting: bool | None = None) -> tuple[bool, ...]:
    """Whether the object may not leave its surface in the first stage; in the order of trial.

    Args:
        env_id: a task.
        setting: None decides by the task: in this package's own, yes where the gripper is blocked
            (Push tasks). In others, yes where goals lie as high as the object starts; if it does
            not learn that it may leave the surface after all.

    Raises:
        ValueError: the task's object cannot be followed.
    """
    if setting is not None:
        return (setting,)
    if env_id in IDS:
        return (IDS[env_id][0].blocked_gripper,)
    return (True, False) if derived(env_id).on_surface else (False,)


def object_vec_env(
    env_id: str, n_envs: int, n_threads: int | None = None, *, on_table: bool = False
) -> VecEnv:
    """Copies of a task's object alone (section 4.1).

    Args:
        env_id: a task of the robot's.
        n_envs: number of copies, at least 1.
        n_threads: threads that step them; None takes one a core.
        on_table: whether the object may not leave its surface.

    Raises:
        ValueError: the task's object cannot be followed, or a number is below 1.
    """
    if env_id in IDS:
        env: VecEnv = make_vec(object_id(env_id), n_envs, n_threads, on_table=on_table)
        return env
    return DerivedObjectVecEnv(derived(env_id).scene, n_envs, n_threads, on_table=on_table)


def steps_of_object(env_id: str, horizon: int) -> int:
    """T of the object's episodes, where the robot's have `horizon` steps."""
    return horizon if env_id in IDS else object_horizon(horizon)


def effector_of(env_id: str) -> tuple[int, int, int]:
    """Where a task's observation holds the effector's position.

    Raises:
        ValueError: the task's object cannot be followed, or no part of the robot is told.
    """
    return (0, 1, 2) if env_id in IDS else _told(env_id, derived(env_id).effector)


def effector_seen_in(env_id: str) -> tuple[int, int, int] | None:
    """As `effector_of`, of a task of others whose object need not be followed.

    Looked at once a process. None, nothing can be seen: there is no MuJoCo simulation, or no goals.

    Raises:
        ValueError: no part of the robot is told in the observation.
    """
    spec = gym.spec(import_task(env_id))
    key = registration_key(spec)
    if key not in _EFFECTORS:
        _EFFECTORS[key] = _find_effector(env_id)
    return _EFFECTORS[key]


_EFFECTORS: dict[Any, tuple[int, int, int] | None] = {}


def _find_effector(env_id: str) -> tuple[int, int, int] | None:
    env = robot_maker(env_id)()
    try:
        if missing_goal_keys(env.observation_space) or not is_simulated(env):
            return None
        return _told(env_id, find_effector(observe(env), told_effector(env)))
    except ValueError:
        raise
    except Exception as error:  # an environment of somebody's may raise anything
        raise raised_by(env_id, error) from error
    finally:
        env.close()


def _told(env_id: str, found: Effector | None) -> tuple[int, int, int]:
    if found is None:
        raise ValueError(
            f"{env_id!r}: no part of the robot has its position in metres in the observation; "
            "tell it there with effector=, a function of the environment such as "
            "sb3_follow_object.fingertips, or say reach=null"
        )
    return found.entries


def registered_horizon(env_id: str) -> int | None:
    """T of a registered task's episodes; None, it has no limit."""
    spec = gym.registry.get(import_task(env_id))
    return None if spec is None else spec.max_episode_steps


def steps_to_reach(env_id: str) -> int:
    """Env steps that an effector may take to the object in a task of others, half an episode's.

    The package's own have 25 of some 50: robots that need longer episodes are slower.
    """
    return max(_LEAST_TO_REACH, (registered_horizon(env_id) or 0) // 2)
