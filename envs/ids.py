"""Gymnasium ids, one pair a task: `FollowObject/<Task>-v0` and `FollowObject/<Task>Object-v0`."""

from __future__ import annotations

import inspect
from contextlib import redirect_stderr
from importlib import import_module
from io import StringIO
from typing import Any

import gymnasium as gym

from .tasks import TASKS, Task, did_you_mean

_PACKAGE = __package__
_KINDS = {"": "FetchEnv", "Object": "ObjectEnv"}
IDS: dict[str, tuple[Task, bool]] = {
    f"FollowObject/{name}{suffix}-v0": (task, bool(suffix))
    for name, task in TASKS.items()
    for suffix in _KINDS
}
BUILT_IN = frozenset(IDS)  # what `register_task` adds is not among them


def register_envs() -> None:
    """Register all ids with gymnasium; calling it again changes nothing."""
    for env_id, (task, alone) in IDS.items():
        if env_id not in gym.registry:
            face = _KINDS["Object" if alone else ""]
            gym.register(
                env_id,
                entry_point=f"{_PACKAGE}:{face}",
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
    ids = {f"FollowObject/{task.name}{suffix}-v0": (task, bool(suffix)) for suffix in _KINDS}
    for env_id, row in ids.items():
        if IDS.get(env_id, row) != row:
            raise ValueError(f"{env_id!r} is another task's already; find a new name.")
    TASKS[task.name] = task
    IDS.update(ids)
    register_envs()
    return next(iter(ids))


def lookup(env_id: str) -> tuple[Task, bool]:
    """The task of one of our ids, and whether it is the one of the object alone.

    Raises:
        ValueError: it is not one of ours.
    """
    if env_id not in IDS:
        raise ValueError(f"Unknown environment id {env_id!r}{did_you_mean(env_id, IDS)}.")
    return IDS[env_id]


def task_of(env_id: str | Task, *, alone: bool) -> Task:
    """The task of an id of the robot's or, with `alone`, of the object's; a row is handed through.

    Raises:
        ValueError: the id is unknown or of the other kind.
    """
    if isinstance(env_id, Task):
        return env_id
    task, is_alone = lookup(env_id)
    if is_alone != alone:
        wanted = next(other for other, row in IDS.items() if row == (task, alone))
        raise ValueError(f"{env_id!r} does not fit here; {wanted!r} does.")
    return task


def object_id(env_id: str) -> str:
    """The id of the object alone in a task of ours, given the robot's or its own.

    Raises:
        ValueError: it is not one of ours.
    """
    task, _ = lookup(env_id)
    return f"FollowObject/{task.name}Object-v0"


def import_task(env_id: str) -> str:
    """Import the module that may register an id and return the id without the module's name.

    Args:
        env_id: gymnasium id, with "module:" before it where importing that module registers it.

    Raises:
        ValueError: the module cannot be imported.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        try:
            import_module(module)
        except (ImportError, TypeError, ValueError) as error:  # a relative name, an empty part
            raise ValueError(
                f"{env_id!r} names a module that cannot be imported ({error}); "
                "is it installed, or its folder on PYTHONPATH?"
            ) from error
    elif name not in gym.registry:
        with redirect_stderr(StringIO()):  # it speaks of other environments' versions
            import_module("gymnasium_robotics")
    return name


def make_vec(env_id: str, n_envs: int, n_threads: int | None = None, **options: Any) -> Any:
    """A VecEnv of n copies: batched and threaded for our ids, SB3's DummyVecEnv for others.

    Args:
        env_id: any gymnasium id.
        n_envs: number of copies, at least 1.
        n_threads: for our ids, threads that step them; None takes one a processor.
        options: keywords of `FetchVecEnv`, `ObjectVecEnv` or `gymnasium.make`; `seed` for all.

    Raises:
        ValueError: the id is unknown, an option is wrong or `n_envs` is below 1.
    """
    name = import_task(env_id)
    if name in IDS:
        # Late, because the classes need the ids above.
        from .fetch import FetchVecEnv
        from .object_locomotion import ObjectVecEnv

        face = ObjectVecEnv if IDS[name][1] else FetchVecEnv
        try:
            inspect.signature(face).bind(name, n_envs, n_threads, **options)
        except TypeError as error:
            raise ValueError(f"{env_id!r} cannot be made: {error}") from error
        return face(name, n_envs, n_threads, **options)

    from stable_baselines3.common.vec_env import DummyVecEnv

    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, not {n_envs}.")
    seed = options.pop("seed", None)
    try:
        venv = DummyVecEnv([lambda: gym.make(env_id, **options) for _ in range(n_envs)])
    except gym.error.UnregisteredEnv as error:
        known = [*IDS, *gym.registry]
        raise ValueError(
            f"Unknown environment id {env_id!r}{did_you_mean(env_id, known)}."
        ) from error
    except TypeError as error:
        raise ValueError(f"{env_id!r} cannot be made: {error}") from error
    if seed is not None:
        venv.seed(seed)
    return venv


def physics_id(env_id: str) -> str:
    """A short hash of what decides how the object moves and where goals lie in this task.

    An id and that of its object alone share it: what was learned from one holds for the other.

    Raises:
        ValueError: it is not one of ours.
    """
    from .scene import physics_digest

    return physics_digest(lookup(env_id)[0])
