"""Environments that come as a function, or with functions that say their goals, get ids."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym

from ..envs.registration import import_task
from ..envs.robot_face import EffectorOf, GoalOf, Judge, RobotTask

MakeEnv = Callable[[], gym.Env]
NAMESPACE = "Followed"


def registered(
    env_id: str | None = None,
    *,
    make_env: MakeEnv | None = None,
    object: str | None = None,
    goal: GoalOf | None = None,
    is_success: Judge | None = None,
    effector: EffectorOf | None = None,
) -> str:
    """Return the id of an environment, registered with gymnasium where it has none of this kind.

    Args:
        env_id: gymnasium id; or
        make_env: makes the environment, whose time limit says how long its episodes are.
        object: name of the body that goals are about; None finds it.
        goal: of (env, observation) -> achieved and desired goal; None where observations hold them.
        is_success: of (achieved, desired) -> whether a goal is reached; None asks the environment.
        effector: of (env) -> position of what touches the object; None where observations hold it.

    Returns:
        `env_id` where nothing else is given.

    Raises:
        ValueError: neither or both of id and function are given, or the environment does not say
            how long its episodes are.
    """
    if (env_id is None) == (make_env is None):
        raise ValueError("give an environment's id, or make_env, a function that makes it")
    extras = (object, goal, is_success, effector)
    if make_env is None and all(extra is None for extra in extras):
        assert env_id is not None
        return env_id
    if make_env is None:
        assert env_id is not None
        name = import_task(env_id)
        if name not in gym.registry:
            raise ValueError(f"there is no environment {env_id!r}")
        make_env = partial(gym.make, name)
        title, _, version = name.rpartition("/")[2].rpartition("-v")
    else:
        title = getattr(make_env, "__name__", type(make_env).__name__)
        title, version = re.sub(r"\W+", "", title) or "environment", "0"
    ours = f"{NAMESPACE}/{title}-v{version}"
    horizon = _horizon(make_env, ours)
    gym.registry.pop(ours, None)  # functions of the same name may have been written anew
    entry = partial(_make, make_env, *extras)
    gym.register(ours, entry, max_episode_steps=horizon, disable_env_checker=True)
    return ours


def _horizon(make_env: MakeEnv, name: str) -> int:
    env = make_env()
    try:
        steps = None if env.spec is None else env.spec.max_episode_steps
        if steps is None and env.has_wrapper_attr("_max_episode_steps"):  # a TimeLimit by hand
            steps = env.get_wrapper_attr("_max_episode_steps")
        if steps is None:
            raise ValueError(
                f"{name} does not say how long its episodes are; wrap it in "
                "gymnasium.wrappers.TimeLimit"
            )
        return int(steps)
    finally:
        env.close()


def _make(
    make_env: MakeEnv,
    object: str | None,
    goal: GoalOf | None,
    is_success: Judge | None,
    effector: EffectorOf | None,
    render_mode: str | None = None,
    **options: Any,
) -> gym.Env:
    if render_mode is not None and isinstance(make_env, partial):  # gymnasium's own make
        options = {**options, "render_mode": render_mode}
    env = make_env(**options)
    if goal is None and is_success is None and effector is None:
        env.followed_object = object  # type: ignore[attr-defined]
        return env
    return RobotTask(env, goal, is_success, object, effector)
