"""Environments that come as a function, or with functions that say their goals, get ids."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from functools import partial
from types import CodeType, FunctionType
from typing import Any

import gymnasium as gym

from ..envs.goal_envs import SAY_LENGTH
from ..envs.registration import import_task
from ..envs.robot_copies import make_registered
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
    named: str | None = None,
) -> str:
    """Return the id of an environment, registered with gymnasium where it has none of this kind.

    The same functions have the same id, also where a notebook has written them anew; others of the
    same name have ids of their own.

    Args:
        env_id: gymnasium id; or
        make_env: makes the environment, whose time limit says how long its episodes are.
        object: name of the body that goals are about; None finds it.
        goal: of (env, observation) -> achieved and desired goal; None where observations hold them.
        is_success: of (achieved, desired) -> whether a goal is reached; None asks the environment.
        effector: of (env) -> position of what touches the object; None where observations hold it.
        named: an id that it had in another process and shall have here.

    Returns:
        `env_id` where nothing else is given.

    Raises:
        ValueError: neither or both of id and function are given, the environment does not say how
            long its episodes are, or another one is called `named` here.
    """
    if (env_id is None) == (make_env is None):
        raise ValueError("give an environment's id, or make_env, a function that makes it")
    functions = {"goal": goal, "is_success": is_success, "effector": effector}
    for word, function in {"make_env": make_env, **functions}.items():
        if function is not None and not callable(function):
            raise ValueError(f"{word} must be a function, not {function!r}")
    extras = (object, goal, is_success, effector)
    given: tuple[Any, ...]
    if make_env is None and all(extra is None for extra in extras):
        assert env_id is not None
        return env_id
    if make_env is None:
        assert env_id is not None
        name = import_task(env_id)
        if name not in gym.registry:
            raise ValueError(f"there is no environment {env_id!r}")
        spec = gym.spec(name)
        make_env = partial(make_registered, spec)
        title, version, given = spec.name, spec.version or 0, (spec, *extras)
    else:
        title = getattr(make_env, "__name__", type(make_env).__name__)
        title, version = re.sub(r"\W+", "", title) or "environment", 0
        given = (make_env, *extras)
    ours = _free_id(title, version, given) if named is None else named
    if not _alike(_GIVEN.get(ours, given), given):
        raise ValueError(f"{ours!r} is another environment here; load it in a process of its own")
    horizon = _horizon(make_env, ours)
    before, now = _REGISTERED.get(ours), (horizon, *given, *_around(given))
    _GIVEN[ours], _REGISTERED[ours] = given, now
    if ours in gym.registry and _unchanged(before, now):  # what was found out of it stays known
        return ours
    gym.registry.pop(ours, None)
    entry = partial(_make, make_env, *extras)
    gym.register(ours, entry, max_episode_steps=horizon, disable_env_checker=True)
    return ours


# What of compiled code is in its words, and not in the lines that they stand on.
_WORDS = tuple(f"co_{name}" for name in ("code", "consts", "names", "varnames", "freevars"))
_GIVEN: dict[str, tuple[Any, ...]] = {}  # what each id was registered with
_REGISTERED: dict[str, tuple[Any, ...]] = {}  # and what that found around it


def made_by_function(env_id: str) -> bool:
    """Whether an id is one that `registered` gives, and means nothing in another process."""
    return env_id.startswith(f"{NAMESPACE}/")


def _free_id(title: str, version: int, given: tuple[Any, ...]) -> str:
    """Return the first id of this name that is free, or that these functions have already."""
    titles = itertools.chain([title], (f"{title}-{n}" for n in itertools.count(2)))
    names = (f"{NAMESPACE}/{each}-v{version}" for each in titles)
    return next(name for name in names if _alike(_GIVEN.get(name, given), given))


def _around(given: tuple[Any, ...]) -> tuple[Any, ...]:
    """What functions call by its name, which a notebook may write anew without them."""
    functions = (each for each in given if isinstance(each, FunctionType))
    return tuple(f.__globals__.get(name) for f in functions for name in f.__code__.co_names)


def _unchanged(one: Any, other: Any) -> bool:
    """Whether two things are one, written once."""
    try:
        return bool(one == other)
    except Exception:  # what cannot be compared is another thing
        return False


def _alike(one: Any, other: Any) -> bool:
    """Whether two things are one, or functions that were written twice in the same words."""
    try:
        return _same(one, other)
    except Exception:  # what cannot be compared, or holds itself, is another thing
        return False


def _same(one: Any, other: Any) -> bool:
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, partial):
        return _same(
            (one.func, one.args, tuple(one.keywords.items())),
            (other.func, other.args, tuple(other.keywords.items())),
        )
    if isinstance(one, FunctionType):
        return one.__globals__ is other.__globals__ and _same(_written(one), _written(other))
    if isinstance(one, CodeType):
        return all(_same(getattr(one, name), getattr(other, name)) for name in _WORDS)
    return bool(one == other)


def _written(function: FunctionType) -> tuple[Any, ...]:
    """What a function does and what it has around it."""
    cells = tuple(cell.cell_contents for cell in function.__closure__ or ())
    named = tuple((function.__kwdefaults__ or {}).items())
    return function.__code__, function.__defaults__, named, cells


def _horizon(make_env: MakeEnv, name: str) -> int:
    env = make_env()
    try:
        steps = None if env.spec is None else env.spec.max_episode_steps
        if steps is None and env.has_wrapper_attr("_max_episode_steps"):  # a TimeLimit by hand
            steps = env.get_wrapper_attr("_max_episode_steps")
        if steps is None:
            raise ValueError(f"{name} does not say how long its episodes are; {SAY_LENGTH}")
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
    by_id = isinstance(make_env, partial) and make_env.func is make_registered
    if render_mode is not None and by_id:
        options = {**options, "render_mode": render_mode}
    env = make_env(**options)
    if goal is None and is_success is None and effector is None:
        env.followed_object = object  # type: ignore[attr-defined]
        return env
    return RobotTask(env, goal, is_success, object, effector)
