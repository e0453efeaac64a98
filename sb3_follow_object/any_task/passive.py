"""Whether what is not the robot's moves by its physics alone, as it will in the object's scene."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import (
    body_name,
    passive_roots,
    pulled,
    robot_bodies,
    standing,
    touchable,
    touching_geoms,
)
from .finding import Observed
from .physics_access import physics_of, placed

_STILL = 1e-5  # metres, and parts of an axis, that what stands may seem to move in a step
_TRIED = 3  # steps that are done again
_DRIVEN = 1e-3  # metres that what nobody touches may go otherwise in a step


def check_standing(seen: Observed) -> None:
    """Raise a ValueError where the goal, or what stands and can be touched, moves in an episode."""
    model = seen.model
    steps = np.flatnonzero(seen.episodes[1:] == seen.episodes[:-1])
    for now, later in zip(seen.desired[steps], seen.desired[steps + 1], strict=True):
        if not np.array_equal(now, later):
            raise ValueError(
                f"the goal moves within an episode, from {now.tolist()} to {later.tolist()}; an "
                "imagined goal is made for that of the first step"
            )
    moved = np.abs(seen.later[steps + 1] - seen.later[steps]).max(axis=(0, 2), initial=0.0)
    stands = standing(model) & ~robot_bodies(model)
    touching = np.unique(model.geom_bodyid[touching_geoms(model)])
    for body in map(int, touching):
        if stands[body] and moved[body] > _STILL:
            raise ValueError(
                f"body {body_name(model, body)} moves within an episode without a joint, which the "
                "object's scene cannot follow; give it a joint, or let it touch nothing"
            )


def check_passive(env: gym.Env) -> None:
    """Raise a ValueError where something else than physics moves what is not the robot's.

    A step is done again without the environment: what the robot does not touch moves alike.

    Args:
        env: is reset and stepped.
    """
    for seed in range(_TRIED):
        env.reset(seed=seed)
        model, data = physics_of(env)
        _check_welds(model, data)
        alone = copy.copy(data)
        *_, ended, truncated, _ = env.step(env.action_space.sample())
        again, data = physics_of(env)
        if ended or truncated or again is not model:
            continue
        may_touch = touchable(model)
        pushed = np.abs(data.xfrc_applied).max(axis=1, initial=0.0)
        np.maximum.at(pushed, model.dof_bodyid, np.abs(data.qfrc_applied))
        off = _off_physics(model, alone, data)
        for body in (body for body in passive_roots(model) if may_touch[body]):
            if pushed[body]:
                raise ValueError(
                    f"a force is applied to body {body_name(model, body)}, which the object's "
                    "scene cannot have"
                )
            if off[body] > _DRIVEN:
                raise ValueError(
                    f"body {body_name(model, body)} is moved by the environment, not by its "
                    f"physics alone ({off[body] * 1e3:.0f} mm off after a step), which the "
                    "object's scene cannot follow; move a body without joints, at resets"
                )


def _off_physics(model: mujoco.MjModel, before: mujoco.MjData, after: mujoco.MjData) -> np.ndarray:
    """How far bodies are from where physics alone brings them, (nbody,) metres.

    Nothing is said, all zeros, of a step in which the robot touches something, or may have.

    Args:
        model: of both states.
        before: a step; it is stepped.
        after: the environment's step.
    """
    robot, nothing = robot_bodies(model), np.zeros(model.nbody)
    if _touched(model, before, robot) or _touched(model, after, robot):
        return nothing
    before.ctrl[:] = after.ctrl
    before.mocap_pos[:], before.mocap_quat[:] = after.mocap_pos, after.mocap_quat
    for _ in range(round((after.time - before.time) / model.opt.timestep)):
        mujoco.mj_step(model, before)
        if _touched(model, before, robot):
            return nothing
    places, theirs = (placed(model, each).xpos for each in (before, after))
    off: np.ndarray = np.linalg.norm(places - theirs, axis=1)
    # A robot that went otherwise had other controls within the step.
    return off if off[robot].max(initial=0.0) <= _DRIVEN else nothing


def _touched(model: mujoco.MjModel, data: mujoco.MjData, robot: np.ndarray) -> bool:
    """Whether the robot touches anything else."""
    of_robot = robot[model.geom_bodyid[data.contact.geom]]
    return bool((of_robot[:, 0] != of_robot[:, 1]).any())


def _check_welds(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raise a ValueError where resets switch what says whether a body is the robot's."""
    switched = copy.copy(model)
    for mocap, body, row in pulled(model):
        now = bool(data.eq_active[row])
        if now == bool(model.eq_active0[row]):
            continue
        switched.eq_active0[row] = now
        if (robot_bodies(switched) != robot_bodies(model)).any():
            raise ValueError(
                f"resets switch the equality that lets {body_name(model, mocap)} pull "
                f"{body_name(model, body)} {'on' if now else 'off'}, so that nobody knows whose "
                f'that is: give it active="{str(now).lower()}" in the model'
            )
