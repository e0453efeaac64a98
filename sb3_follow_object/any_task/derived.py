"""A task that nobody here wrote, looked at: its object, goals, physics, and the scene of both."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..common.cache import SET_THE_VARIABLE, cache_folder
from ..common.files import lock
from ..common.numbers import checked_whole
from ..common.reports import Report
from ..envs.goal_envs import SAY_GOALS, SAY_LENGTH, missing_goal_keys
from ..envs.goal_space import followed_space
from ..envs.physics_engine import mujoco
from ..envs.registration import import_task, registration_key
from ..envs.robot_copies import robot_maker
from ..envs.robot_face import RobotTask, pays_one
from ..envs.robot_parts import body_name, robot_roots
from ..envs.robotics import check_robotics
from .at_goal import check_episodes, success_distance
from .context import context_of
from .finding import (
    Candidate,
    Effector,
    Observed,
    candidates,
    find_effector,
    find_object,
    observe,
)
from .passive import check_passive, check_standing
from .physics_access import NoSimulation, is_simulated
from .resets import Resets, record_resets, varying_bodies
from .scene import DerivedScene, DerivedTask, object_scene_of, physics_digest_of

N_RESETS = 2000  # episodes that are recorded; of a hundred F_phi does not learn the places between
_FEW = 20  # of them say what varies
_LONG, _LONG_T = 100, 50  # episodes of more steps than this have an object whose T is that
_FILE = "resets.safetensors"
_COMPARED = 100  # resets that say whether what no seed says again is drawn as it was
_ODDS = 1e-6  # of taking two sets for differently drawn that are not
_SAME = 1e-3  # metres, and parts of a unit quaternion


@dataclass(frozen=True, eq=False)
class Derived:
    """What was found out of a task.

    Attributes:
        env_id: of the robot's task.
        object: the body that goals are about.
        second: how far off the next body is that is not the robot's, metres; None, there is none.
        robot: names of the bodies that the robot hangs on the scene with.
        effector: where the observation holds what touches the object; None, nowhere.
        horizon: T of the robot's episodes.
        success_distance: metres within which a goal is reached in every direction.
        varying: names of what stands elsewhere in each episode.
        context: numbers of places, of these or of what can move, that nu and F_phi see.
        shifted: whether rewards of 1 and 0 are shown as 0 and -1.
        physics: hash of what decides how the object moves and where goals lie.
        kept_as: name of the folder in the cache; another for each distribution of what no seed
            says again.
        resets: recorded.
        scene: of the object alone.
    """

    env_id: str
    object: Candidate
    second: float | None
    robot: tuple[str, ...]
    effector: Effector | None
    horizon: int
    success_distance: float
    varying: tuple[str, ...]
    context: tuple[str, ...]
    shifted: bool
    physics: str
    kept_as: str
    resets: Resets
    scene: DerivedScene

    @property
    def on_surface(self) -> bool:
        """Whether goals lie as high as the object starts, so that it shall stay on its surface."""
        return self.resets.on_surface()


def derived(env_id: str, report: Report = lambda sentence: None) -> Derived:
    """Return what a registered task is; looked at once a process.

    Args:
        env_id: gymnasium id, with "module:" before it where importing that registers it.
        report: told where resets are being recorded, which may take minutes.

    Raises:
        ValueError: the object's own scene cannot be made of it, with what would help.
    """
    name = import_task(env_id)
    if name not in gym.registry:
        raise ValueError(f"there is no environment {env_id!r}")
    key = registration_key(gym.registry[name])
    looked_at = _LOOKED_AT.get(name)
    if looked_at is None or looked_at[0] != key:
        looked_at = _LOOKED_AT[name] = key, _look(name, report)
    return looked_at[1]


_LOOKED_AT: dict[str, tuple[Any, Derived]] = {}  # by id, each as it was registered


def object_horizon(horizon: int) -> int:
    """T of the object's episodes where the robot's have this one.

    An object that moves by itself needs no more steps than those of the paper's tasks.
    """
    return horizon if horizon <= _LONG else _LONG_T


def _look(env_id: str, report: Report) -> Derived:
    check_robotics(env_id)
    try:
        env = robot_maker(env_id)()
    except ValueError:
        raise
    except Exception as error:  # an environment of somebody's may raise anything
        raise ValueError(f"{env_id!r} cannot be made: {error or type(error).__name__}") from error
    try:
        return _look_at(env_id, env, report)
    except NoSimulation as error:
        raise ValueError(
            f"{env_id!r}: {error}; the object's own scene can only be made from one; train it with "
            "--method her"
        ) from error
    except ValueError as error:
        said = str(error)
        if said.startswith(f"{env_id} "):
            raise ValueError(said.replace(env_id, repr(env_id), 1)) from error
        raise ValueError(f"{env_id!r}: {error}") from error
    except Exception as error:  # an environment of somebody's may raise anything
        raise raised_by(env_id, error) from error
    finally:
        env.close()


def raised_by(env_id: str, error: Exception) -> ValueError:
    """The sentence about what an environment has raised while it was watched."""
    return ValueError(
        f"{env_id!r} raised {type(error).__name__}: {error} while it was reset and stepped and its "
        "objects were moved"
    )


def _look_at(env_id: str, env: gym.Env, report: Report) -> Derived:
    missing = missing_goal_keys(env.observation_space)
    if missing:
        if not is_simulated(env):
            raise ValueError("it has neither goals nor a MuJoCo simulation: there is no object")
        raise ValueError(
            f"there are no goals: its observations lack {', '.join(missing)}; {SAY_GOALS}"
        )
    if not isinstance(env.action_space, spaces.Box):
        raise ValueError(
            f"its actions are {env.action_space}; the robot is trained with actions in a Box"
        )
    horizon = _horizon(env)
    followed_space(env.observation_space["desired_goal"].shape)  # type: ignore[index]
    few, model, data = record_resets(env, _FEW)
    pays_one(env, few.goals[0], "it")
    seen = observe(env)
    check_standing(seen)
    check_passive(env)
    found = find_object(seen, _named_object(env))
    check_episodes(env, found, horizon)
    within = success_distance(env, few.goals[:5])
    again, model_again, _ = record_resets(env, 2)
    repeated, unrepeated = _repeated(few, again, sorted(varying_bodies(model, few)))
    drawn = f"{env_id} {horizon} {within} {mujoco.__version__.split('.')[0]} {repeated or ''}"
    physics = physics_digest_of(model, found.body, found.offset, few, drawn, model_again)
    kept_as, resets = _kept_resets(env_id, env, physics, unrepeated, report)
    task = DerivedTask(env_id, object_horizon(horizon), physics)
    context = context_of(model, resets, found.body)
    return Derived(
        env_id,
        found,
        _second(seen, found),
        tuple(body_name(model, body) for body in robot_roots(model)),
        find_effector(seen, told_effector(env)),
        horizon,
        within,
        tuple(body_name(model, body) for body in sorted(varying_bodies(model, resets))),
        context,
        bool(isinstance(env, RobotTask) and env.shifted),
        physics,
        kept_as,
        resets,
        object_scene_of(model, data, found.body, found.offset, resets, task, within, context),
    )


def _horizon(env: gym.Env) -> int:
    steps = None if env.spec is None else env.spec.max_episode_steps
    if steps is None:
        raise ValueError(f"it does not say how long its episodes are; {SAY_LENGTH}")
    return checked_whole("max_episode_steps", steps, 1)


def _named_object(env: gym.Env) -> str | None:
    """The object's name where whoever made the environment has given it."""
    if not env.has_wrapper_attr("followed_object"):
        return None
    name: str | None = env.get_wrapper_attr("followed_object")
    return name


def told_effector(env: gym.Env) -> tuple[int, int, int] | None:
    """Entries of the observation that `RobotTask` has added for the effector."""
    if not env.has_wrapper_attr("told_effector"):
        return None
    told: tuple[int, int, int] | None = env.get_wrapper_attr("told_effector")
    return told


def _second(seen: Observed, found: Candidate) -> float | None:
    others = (e.error for e in candidates(seen) if e.body != found.body and not e.of_robot)
    return next(others, None)


Read = Callable[[Resets], np.ndarray]  # numbers (n, c) of n resets


def _repeated(few: Resets, again: Resets, others: list[int]) -> tuple[list[Any], list[Read]]:
    """What seeds say again of how episodes are drawn, and what reads the rest out of resets."""
    reads: list[Read] = [lambda resets: resets.goals, lambda resets: resets.starts]
    reads += [partial(_places, body=body) for body in others]
    repeated: list[Any] = []
    rest: list[Read] = []
    for read in reads:
        if np.array_equal(read(few)[:2], read(again)):
            repeated += read(few).round(5).tolist()
        else:
            rest.append(read)
    return repeated, rest


def _places(resets: Resets, body: int) -> np.ndarray:
    return resets.places[:, body]


def _kept_resets(
    env_id: str, env: gym.Env, physics: str, unrepeated: list[Read], report: Report
) -> tuple[str, Resets]:
    """Return the recorded resets of a task, and the name of the folder that they are kept in.

    They are recorded now unless they are kept from before. Those that begin otherwise than
    episodes do now stay, and the task has another folder.
    """
    now: Resets | None = None
    name, number = physics, 0
    while (kept := _whole_resets(cache_folder() / env_id / name / _FILE)) is not None:
        if unrepeated and now is None:
            now = record_resets(env, _COMPARED)[0]
        if now is None or all(_alike(read(now), read(kept)) for read in unrepeated):
            return name, kept
        report(f"episodes of {env_id} begin elsewhere now than those that are kept in {name}")
        number += 1
        name = f"{physics}.{number}"
    return name, _recorded(env_id, env, cache_folder() / env_id / name, report)


def _alike(few: np.ndarray, many: np.ndarray) -> bool:
    """Whether two sets of numbers, (n, c) and (m, c), may have been drawn alike.

    By Kolmogorov and Smirnov's test of each column, which errs once in a million times; numbers
    that lie less than `_SAME` apart are the same to it.
    """
    largest = np.sqrt(np.log(2.0 / _ODDS) / 2.0 * (1.0 / len(few) + 1.0 / len(many)))
    first, second = np.sort(few, axis=0).T, np.sort(many, axis=0).T
    return all(
        (_share(one, one) - _share(other, one + _SAME)).max() <= largest
        for pair in zip(first, second, strict=True)
        for one, other in (pair, pair[::-1])
    )


def _share(numbers: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Which share of sorted numbers is no more than each of some others."""
    share: np.ndarray = np.searchsorted(numbers, at, side="right") / len(numbers)
    return share


def _recorded(env_id: str, env: gym.Env, folder: Path, report: Report) -> Resets:
    """Record a task's resets into a folder, unless another process has just done so."""
    path = folder / _FILE
    with ExitStack() as held:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            held.enter_context(lock(folder, wait=True))
        except OSError as error:
            raise ValueError(
                f"{folder} cannot be written ({error.strerror or error}); {SET_THE_VARIABLE}"
            ) from error
        if _whole_resets(path) is None:
            report(f"where {N_RESETS} episodes of {env_id} begin is recorded, once")
            record_resets(env, N_RESETS)[0].save(path)
    return Resets.load(path)


def _whole_resets(path: Path) -> Resets | None:
    """Return the resets that a file holds; None, there is none, or a damaged one."""
    if not path.exists():
        return None
    try:
        return Resets.load(path)
    except ValueError as error:
        if isinstance(error.__cause__, OSError):  # it may be whole, but cannot be read
            raise
        return None
