"""What `sb3-follow-object inspect` says of a task before anything trains, and what it draws."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ..any_task.derived import Derived, derived
from ..any_task.scene_picture import GOAL_RGBA, START_RGBA, draw_points
from ..any_task.simulation import DerivedObjectVecEnv
from ..common.reports import Report
from ..envs import IDS
from ..envs.goal_space import goal_space
from ..envs.registration import import_task
from ..envs.robot_copies import robot_maker
from ..envs.task_table import BUILT_IN
from ..imagination.goal_predictor import GoalPredictor
from ..replay.steps import check_actions
from ..runs.predictor_cache import kept_predictor
from ..settings.stages import ReachFirstSettings
from .pictures import imagined_panels, write_png

_SECONDS = 1.0  # that a speed is measured for
_COPIES = 16
_RESETS = 10  # that the effector's way to the object is measured after
_STEPS = 10  # of one action, in the second half of which its speed is measured
_BUSY = 0.8  # of an episode's steps on the straight way leave too few for what lies in it
_SHOWN = 60  # starts and goals in the picture
_EPISODES = 3  # whose imagined goals are drawn beside them
_TELL_IT = "effector=fingertips of RobotTask or FollowObject tells where they are"


def inspect(env_id: str, report: Report) -> dict[str, str]:
    """Return what is found out of a task, in words.

    Args:
        env_id: gymnasium id, with "module:" before it where importing that registers it.
        report: told what takes long.

    Raises:
        ValueError: its object cannot be followed, or its actions have no bounds.
    """
    name = import_task(env_id)
    if name in IDS:
        source = "this package" if name in BUILT_IN else "register_task"
        raise ValueError(f"{name!r} is a task of {source}; inspect is for those of others")
    found = derived(name, report)
    _check_actions(name)
    return {
        "object": _object(found),
        "goal": _goal(found),
        "reached": f"within {found.success_distance * 1e3:.0f} mm" + _shifted(found),
        "varies": _varies(found),
        "moves": _moves(found),
        "robot": _robot(found),
        "effector": _effector(found),
        "speed": _speed(found),
        "episodes": f"{found.horizon} steps; the object's {found.scene.task.horizon}",
        "steps a second": f"object {_object_speed(found):,.0f}, robot {_robot_speed(name):,.0f}",
        "physics": found.physics,
    }


def _moves(found: Derived) -> str:
    if not found.on_surface:
        return "freely"
    (x, y), (to_x, to_y) = found.scene.surface
    edge = f" (x {x:.2f} to {to_x:.2f}, y {y:.2f} to {to_y:.2f} m)" if np.isfinite(x) else ""
    return f"on its surface{edge}, unless it does not learn so"


def _check_actions(env_id: str) -> None:
    env: gym.Env = robot_maker(env_id)()
    try:
        check_actions(env.action_space)
    except ValueError as error:
        raise ValueError(f"{env_id!r}: {error}") from error
    finally:
        env.close()


def draw_found(env_id: str, out: Path, predictor: str | os.PathLike[str] | None = None) -> None:
    """Write a picture of a task with some of its starts (blue) and goals (red).

    Beside it episodes with their imagined goals, where an F_phi is given or kept for the task.

    Args:
        env_id: gymnasium id, with "module:" before it where importing that registers it.
        out: PNG file to create or replace.
        predictor: folder of an F_phi; None takes the one that `get_predictor` has kept, if any.

    Raises:
        ValueError: the folder holds no F_phi of this task.
        MissingExtra: imageio is not installed.
        RuntimeError: there is nothing to draw with.
    """
    found = derived(import_task(env_id))
    if predictor is None:
        imagines = kept_predictor(found.env_id)
    else:
        imagines = GoalPredictor.load(predictor, env_id=found.env_id, physics=found.physics)
    env = robot_maker(found.env_id)()
    try:
        env.reset(seed=0)
        starts, goals = (
            goal_space(each.shape[1:]).point(each[:_SHOWN])
            for each in (found.resets.starts, found.resets.goals)
        )
        colours = np.repeat([START_RGBA, GOAL_RGBA], [len(starts), len(goals)], axis=0)
        panels = [draw_points(env, np.concatenate([starts, goals]), colours)]
    finally:
        env.close()
    if imagines is not None:
        panels += imagined_panels(found.env_id, imagines, _EPISODES)
    write_png(out, np.concatenate(panels, axis=1))


def _object(found: Derived) -> str:
    offset = np.linalg.norm(found.object.offset)
    point = f", a point {offset * 1e3:.0f} mm off its frame" if offset > 5e-4 else ""
    error = f"off by {found.object.error * 1e3:.2f} mm at most"
    if found.second is None:
        return f"{found.object.name}{point} ({error}; nothing else can move)"
    return f"{found.object.name}{point} ({error}; the next body by {found.second * 1e3:.0f} mm)"


def _goal(found: Derived) -> str:
    goals, starts = found.resets.goals, found.resets.starts
    space = goal_space(goals.shape[1:])
    away = space.distance(goals, starts)
    up = np.round(space.height(goals) - space.height(starts), 2) + 0.0  # no minus before a zero
    return (
        f"{away.min():.2f} to {away.max():.2f} m from the start, "
        f"{up.min():.2f} to {up.max():.2f} m above it"
    )


def _varies(found: Derived) -> str:
    """What stands elsewhere in each episode, and whether nu and F_phi need to see where."""
    seen: dict[str, list[str]] = {}
    for name in found.context:
        body, number = name.rsplit(" ", 1)
        seen.setdefault(body, []).append(number)
    told = ", ".join(f"{body} ({', '.join(numbers)})" for body, numbers in seen.items())
    others = ", ".join(name for name in found.varying if name not in seen)
    parts = (told and f"{told}: seen by nu and F_phi", others and f"{others}: need not be seen")
    return "; ".join(part for part in parts if part) or "nothing but object and goal"


def _shifted(found: Derived) -> str:
    return "; rewards of 1 and 0 are shown as 0 and -1" if found.shifted else ""


def _robot(found: Derived) -> str:
    """What actuators or mocap bodies move, which the object's own scene is without."""
    return ", ".join(found.robot) or "nothing that an actuator moves"


def _effector(found: Derived) -> str:
    if found.effector is None:
        return f"not told in the observation; {_TELL_IT}"
    first, _, last = found.effector.entries
    off = found.effector.off
    told = f"observation[{first}:{last + 1}], {off * 1e3:.0f} mm off the fingertips' middle"
    return told + f"; {_TELL_IT}" * (off > ReachFirstSettings.tolerance)


def _speed(found: Derived) -> str:
    """How quick the effector is at most, and whether an episode gives it the time."""
    if found.effector is None:
        return "not known"
    entries = list(found.effector.entries)
    env: gym.Env = robot_maker(found.env_id)()
    try:
        seen = [_begun(env, seed) for seed in range(_RESETS)]
        effectors = np.array([observation[entries] for observation, _ in seen])
        objects = np.array([achieved for _, achieved in seen])
        fastest = max(_moved(env, action, entries) for action in _extremes(env.action_space))
    finally:
        env.close()
    space = goal_space(objects.shape[1:])
    to_object = np.linalg.norm(space.point(objects) - effectors, axis=1).max()
    to_goal = space.distance(found.resets.goals, found.resets.starts).max()
    if fastest <= 0.0:
        return "it does not move"
    steps = [int(np.ceil(metres / fastest)) for metres in (to_object, to_goal)]
    told = (
        f"{fastest * 1e3:.0f} mm a step at most: {steps[0]} steps to the object and {steps[1]} to "
        f"its goal where they are farthest, of {found.horizon}"
    )
    slow = "; too slow: make episodes longer, or do each action more than once"
    return told + slow * (sum(steps) > _BUSY * found.horizon)


def _begun(env: gym.Env, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Copies of the observation and the achieved goal that an episode begins with."""
    obs, _ = env.reset(seed=seed)
    return np.array(obs["observation"]), np.array(obs["achieved_goal"])


def _extremes(actions: gym.Space) -> np.ndarray:
    """Actions (n, d) at the ends of their range: each number at its two with the others at rest."""
    assert isinstance(actions, gym.spaces.Box)
    rest = (actions.low + actions.high) / 2
    return np.stack(
        [
            np.where(np.arange(len(rest)) == number, end, rest)
            for number in range(len(rest))
            for end in (actions.low, actions.high)
        ]
    ).astype(actions.dtype)


def _moved(env: gym.Env, action: np.ndarray, entries: list[int]) -> float:
    """How far the effector comes in a step of an action, metres, once it is under way."""
    env.reset(seed=0)
    places = np.array([env.step(action)[0]["observation"][entries] for _ in range(_STEPS)])
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return float(np.median(ways[_STEPS // 2 - 1 :]))


def _object_speed(found: Derived) -> float:
    env = DerivedObjectVecEnv(found.scene, _COPIES, seed=0, on_table=found.on_surface)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (_COPIES, 7))
    speed = _COPIES * _rate(lambda: env.step(actions))
    env.close()
    return speed


def _robot_speed(env_id: str) -> float:
    env: gym.Env = robot_maker(env_id)()
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()

    speed = _rate(step)
    env.close()
    return speed


def _rate(call: Any) -> float:
    """How often something can be done in a second."""
    call()
    started, n = time.monotonic(), 0
    while time.monotonic() - started < _SECONDS:
        call()
        n += 1
    return n / (time.monotonic() - started)
