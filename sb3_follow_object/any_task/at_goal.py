"""How near its goal an object must come, and what an environment does once it is there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from ..common.answers import one_each, one_number
from ..envs.goal_envs import success_method
from ..envs.physics_engine import mujoco
from ..envs.transcription import JOINT_SIZE
from .finding import Candidate
from .physics_access import physics_of

_FARTHEST = 0.5  # metres at which no goal is reached any more
_HALVINGS = 16
_ROUNDS = 3  # over an object's joints, each of which is moved as near to the goal as it can be
_TRIED = 201  # positions of a drawer or a door, to find the one at the goal


def success_distance(env: gym.Env, goals: np.ndarray) -> float:
    """Return how far off a goal, in whichever direction, the environment says it is reached.

    Args:
        env: with `is_success` of `RobotTask` or gymnasium-robotics.
        goals: to try, (n, 3) metres.

    Raises:
        ValueError: it is not reached on the spot, or far away too; or nobody says it.
    """
    name = success_method(env.get_wrapper_attr)
    if name is None:
        raise ValueError("it has no is_success(achieved, desired)")
    judge: Callable[..., Any] = env.get_wrapper_attr(name)
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    goal, way = np.repeat(goals, len(ways), axis=0), np.tile(ways, (len(goals), 1))
    low, high = np.zeros(len(goal)), np.full(len(goal), _FARTHEST)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        reached = one_each(judge(goal + middle[:, None] * way, goal), len(goal), name) > 0.5
        low, high = np.where(reached, middle, low), np.where(reached, high, middle)
    nearest = round(float(high.min()), 4)
    if not 0.0 < nearest < 0.99 * _FARTHEST:
        raise ValueError(
            f"is_success calls goals reached within {nearest} m; it must be more than 0 and less "
            f"than {_FARTHEST}"
        )
    return nearest


def check_episodes(env: gym.Env, found: Candidate, horizon: int) -> None:
    """Watch two whole episodes, one at random and one with the object at its goal.

    Args:
        env: is reset and stepped.
        found: the object.
        horizon: T, after which every episode ends.

    Raises:
        ValueError: one ends early, or a step pays what `compute_reward` does not.
    """
    for held, how in ((True, "with the object on its goal"), (False, "of random actions")):
        obs, _ = env.reset(seed=0)
        goal = np.array(obs["desired_goal"], np.float64)
        held_at: np.ndarray | None = None
        for step in range(1, horizon):
            action = env.action_space.sample()
            if held:
                action = np.zeros_like(action)
                held_at = _hold(*physics_of(env), found, goal, held_at)
            obs, reward, terminated, truncated, info = env.step(action)
            _check_paid(env, obs, reward, info)
            if terminated or truncated:
                raise ValueError(
                    f"an episode {how} ended after {step} of {horizon} steps; imagined goals need "
                    "episodes that go on to their time limit: turn that off in the environment"
                )


def _check_paid(
    env: gym.Env, obs: dict[str, np.ndarray], reward: Any, info: dict[str, Any]
) -> None:
    """Raise a ValueError where hindsight would pay a step otherwise than the environment has."""
    judge = env.get_wrapper_attr("compute_reward")
    judged = judge(obs["achieved_goal"], obs["desired_goal"], info)
    paid, told = one_number(reward, "step"), one_number(judged, "compute_reward")
    if paid != told:
        raise ValueError(
            f"a step pays {paid:g} where compute_reward says {told:g} of the same goals, and "
            "hindsight mixes both: pay compute_reward alone, or say with is_success= when a goal "
            "is reached"
        )


def _hold(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: Candidate,
    goal: np.ndarray,
    held_at: np.ndarray | None,
) -> np.ndarray:
    """Put the object on a goal (3,), as near as it can be, at rest.

    Args:
        model: of the environment.
        data: its state, which is written to.
        found: the object.
        goal: (3,) metres.
        held_at: what this returned before; None looks for it.

    Returns:
        The positions of all joints, of which only the object's are of use.
    """
    joints = _joints_of(model, found.body)
    if held_at is None:
        for joint in joints * _ROUNDS:
            _bring(model, data, joint, found, goal)
        held_at = data.qpos.copy()
    for joint in joints:
        place, speed = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        n_positions, n_speeds = JOINT_SIZE[int(model.jnt_type[joint])]
        data.qpos[place : place + n_positions] = held_at[place : place + n_positions]
        data.qvel[speed : speed + n_speeds] = 0.0
    mujoco.mj_forward(model, data)
    return held_at


def _joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    """The joints that move a body, its own first, then those of what it hangs on."""
    joints: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        joints += range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    return joints


def _bring(
    model: mujoco.MjModel, data: mujoco.MjData, joint: int, found: Candidate, goal: np.ndarray
) -> None:
    """Move one of an object's joints to where the object is nearest to a goal (3,)."""
    place, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
    kinds = mujoco.mjtJoint
    mujoco.mj_kinematics(model, data)
    point = _point(data, found)
    if kind == int(kinds.mjJNT_FREE):
        data.qpos[place : place + 3] += goal - point
        return
    if kind == int(kinds.mjJNT_BALL):
        here, there = point - data.xanchor[joint], goal - data.xanchor[joint]
        axis = np.cross(here, there)
        sine, cosine = float(np.linalg.norm(axis)), float(here @ there)
        if sine > 0.0:
            spin = axis / sine * np.arctan2(sine, cosine)
            frame = data.xmat[int(model.jnt_bodyid[joint])].reshape(3, 3)
            mujoco.mju_quatIntegrate(data.qpos[place : place + 4], frame.T @ spin, 1.0)
        return
    far = np.pi if kind == int(kinds.mjJNT_HINGE) else float(np.linalg.norm(goal - point))
    low, high = data.qpos[place] + np.array([-far, far])
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint]

    def off(position: float) -> float:
        data.qpos[place] = position
        mujoco.mj_kinematics(model, data)
        return float(np.linalg.norm(_point(data, found) - goal))

    nearest = min(np.linspace(low, high, _TRIED), key=off)
    step = (high - low) / (_TRIED - 1)
    between = np.clip(np.linspace(nearest - step, nearest + step, _TRIED), low, high)
    data.qpos[place] = min(between, key=off)


def _point(data: mujoco.MjData, found: Candidate) -> np.ndarray:
    """Where an object's point is in a state whose kinematics were run, (3,) metres."""
    frame = data.xmat[found.body].reshape(3, 3)
    point: np.ndarray = data.xpos[found.body] + frame @ found.offset
    return point
