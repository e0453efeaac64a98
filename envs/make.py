"""Environments by their ids, many copies at once, and what marks the physics of one."""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv

from ..common.numbers import checked_whole
from ..common.suggestions import did_you_mean
from .fetch import FetchVecEnv
from .object_locomotion import ObjectVecEnv
from .registration import import_task
from .robotics import check_robotics
from .scene import physics_digest
from .task_table import IDS, lookup


def make_vec(env_id: str, n_envs: int, n_threads: int | None = None, **options: Any) -> Any:
    """A VecEnv of n copies: batched and threaded for our ids, SB3's DummyVecEnv for others.

    Args:
        env_id: any gymnasium id.
        n_envs: number of copies, at least 1.
        n_threads: for our ids, threads that step them; None takes one a processor.
        options: keywords of `FetchVecEnv`, `ObjectVecEnv` or `gymnasium.make`; `seed` and
            `max_episode_steps` for all.

    Raises:
        ValueError: the id is unknown, an option is wrong or a count is below 1.
    """
    name = import_task(env_id)
    if name in IDS:
        face = ObjectVecEnv if IDS[name][1] else FetchVecEnv
        try:
            inspect.signature(face).bind(name, n_envs, n_threads, **options)
        except TypeError as error:
            raise ValueError(f"{env_id!r} cannot be made: {error}") from error
        return face(name, n_envs, n_threads, **options)

    check_robotics(name)
    n_envs = checked_whole("n_envs", n_envs, 1)
    seed = options.pop("seed", None)
    if seed is not None:
        seed = checked_whole("seed", seed, 0)
    try:
        venv = DummyVecEnv([lambda: gym.make(env_id, **options) for _ in range(n_envs)])
    except gym.error.UnregisteredEnv as error:
        known = [*IDS, *gym.registry]
        raise ValueError(
            f"Unknown environment id {env_id!r}{did_you_mean(env_id, known)}."
        ) from error
    except (TypeError, gym.error.Error) as error:
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
    return physics_digest(lookup(env_id)[0])
