"""A task that nobody here wrote, looked at: its object, goals, physics, and the scene of both."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
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
from ..envs.robot_face import RobotTask, rewards_on_and_off
from ..envs.robot_parts import body_name
from ..envs.robotics import check_robotics
from .context import context_of
from .finding import Candidate, Effector, Observed, candidates, find_effector, find_object, observe
from .physics_access import NoSimulation, is_simulated, physics_of
from .resets import Resets, record_resets, varying_bodies
from .scene import DerivedScene, DerivedTask, object_scene_of, physics_digest_of

N_RESETS = 2000  # episodes that are recorded; of a hundred F_phi does not learn the places between
_FEW = 20  # of them say what varies
_LONG, _LONG_T = 100, 50  # episodes of more steps than this have an object whose T is that
_FILE = "resets.safetensors"
_FARTHEST = 0.5  # metres at which no goal is reached any more
_HALVINGS = 16
_ROUNDS = 3  # over an object's joints, each of which is moved as near to the goal as it can be
_TRIED = 201  # positions of a drawer or a door, to find the one at the goal


@dataclass(frozen=True, eq=False)
class Derived:
    """What was found out of a task.

    Attributes:
        env_id: of the robot's task.
        object: the body that goals are about.
        second: how far off the next body is that is not the robot's, metres; None, there is none.
        effector: where the observation holds what touches the object; None, nowhere.
        horizon: T of the robot's episodes.
        success_distance: metres within which a goal is reached in every direction.
        varying: names of what stands elsewhere in each episode.
        context: numbers of places, of these or of what can move, that nu and F_phi see.
        shifted: whether rewards of 1 and 0 are shown as 0 and -1.
        physics: hash of what decides how the object moves and where goals lie.
        resets: recorded.
        scene: of the object alone.
    """

    env_id: str
    object: Candidate
    second: float | None
    effector: Effector | None
    horizon: int
    success_distance: float
    varying: tuple[str, ...]
    context: tuple[str, ...]
    shifted: bool
    physics: str
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
        raise ValueError(f"{env_id!r}: {error}") from error
    finally:
        env.close()


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
    on, off = rewards_on_and_off(env, few.goals[0])
    if (on, off) != (0.0, -1.0):
        raise ValueError(
            f"it pays {on:g} on the goal and {off:g} far from it; the rewards must be 0 and -1, or "
            "1 and 0"
        )
    seen = observe(env)
    wanted = _named_object(env)
    found = find_object(seen, wanted)
    if ends_at_goal(env, found):
        raise ValueError(
            "it ends its episodes at the goal; imagined goals need episodes that go on to their "
            "time limit: turn that off in the environment"
        )
    within = success_distance(env, few.goals[:5])
    others = [b for b in varying_bodies(model, few) if b != found.body]
    again, model_again, _ = record_resets(env, 2)
    drawn = _drawn(env_id, few, again, others, horizon, within)
    physics = physics_digest_of(model, found.body, found.offset, few, drawn, model_again)
    resets = _kept_resets(env_id, env, physics, report)
    task = DerivedTask(env_id, object_horizon(horizon), physics)
    context = context_of(model, resets, found.body)
    return Derived(
        env_id,
        found,
        _second(seen, found),
        find_effector(seen, told_effector(env)),
        horizon,
        within,
        tuple(body_name(model, body) for body in sorted(varying_bodies(model, resets))),
        context,
        bool(isinstance(env, RobotTask) and env.shifted),
        physics,
        resets,
        object_scene_of(model, data, found.body, found.offset, resets, task, within, context),
    )


def success_distance(env: gym.Env, goals: np.ndarray) -> float:
    """Return how far off a goal, in whichever direction, the environment says it is reached.

    Args:
        env: with `is_success` of `RobotTask` or gymnasium-robotics.
        goals: to try, (n, 3) metres.

    Raises:
        ValueError: it is not reached on the spot, or far away too.
    """
    name = "is_success" if env.has_wrapper_attr("is_success") else "_is_success"
    judge: Callable[..., Any] = env.get_wrapper_attr(name)
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    goal, way = np.repeat(goals, len(ways), axis=0), np.tile(ways, (len(goals), 1))
    low, high = np.zeros(len(goal)), np.full(len(goal), _FARTHEST)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        reached = np.asarray(judge(goal + middle[:, None] * way, goal)).astype(bool)
        low, high = np.where(reached, middle, low), np.where(reached, high, middle)
    nearest = round(float(high.min()), 4)
    if not 0.0 < nearest < 0.99 * _FARTHEST:
        raise ValueError(
            f"is_success calls goals reached within {nearest} m; it must be more than 0 and less "
            f"than {_FARTHEST}"
        )
    return nearest


def ends_at_goal(env: gym.Env, found: Candidate) -> bool:
    """Whether an episode is terminated once the object is put on its goal, as near as it can be."""
    obs, _ = env.reset(seed=0)
    model, data = physics_of(env)
    goal = np.array(obs["desired_goal"], np.float64)
    first = int(model.body_jntadr[found.body])
    joints = range(first, first + int(model.body_jntnum[found.body]))
    if int(model.jnt_type[first]) == int(mujoco.mjtJoint.mjJNT_FREE):
        place = int(model.jnt_qposadr[first])
        data.qpos[place : place + 3] += goal - obs["achieved_goal"]
    else:
        for joint in [*joints] * _ROUNDS:
            if int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_BALL):
                _bring(model, data, joint, found, goal)
    mujoco.mj_forward(model, data)
    return bool(env.step(np.zeros_like(env.action_space.sample()))[2])


def _bring(
    model: mujoco.MjModel, data: mujoco.MjData, joint: int, found: Candidate, goal: np.ndarray
) -> None:
    """Move one of an object's joints to where the object is nearest to a goal (3,)."""
    place = int(model.jnt_qposadr[joint])
    low, high = data.qpos[place] + np.array([-_FARTHEST, _FARTHEST])
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint]

    def off(position: float) -> float:
        data.qpos[place] = position
        mujoco.mj_kinematics(model, data)
        frame = data.xmat[found.body].reshape(3, 3)
        return float(np.linalg.norm(data.xpos[found.body] + frame @ found.offset - goal))

    data.qpos[place] = min(np.linspace(low, high, _TRIED), key=off)


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


def _drawn(
    env_id: str, few: Resets, again: Resets, others: list[int], horizon: int, within: float
) -> str:
    """What decides how episodes are drawn: of the first ones what seeds say again."""
    arrays = [(few.goals, again.goals), (few.starts, again.starts)]
    arrays += [(few.places[:, body], again.places[:, body]) for body in sorted(others)]
    episodes: list[Any] = []
    for drawn, redrawn in arrays:
        if np.array_equal(drawn[:2], redrawn):
            episodes += drawn.round(5).tolist()
    return f"{env_id} {horizon} {within} {mujoco.__version__.split('.')[0]} {episodes or ''}"


def _kept_resets(env_id: str, env: gym.Env, physics: str, report: Report) -> Resets:
    """Return the recorded resets of a task, recorded now unless they are kept from before."""
    folder = cache_folder() / env_id / physics
    path = folder / _FILE
    kept = _whole_resets(path)
    if kept is not None:
        return kept
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
