"""The object, found by observation: the body that the achieved goal is a fixed point of."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import (
    body_name,
    carrier,
    pulled,
    robot_bodies,
    standing,
    touchable,
    touching_geoms,
)
from .effectors import Fingertips
from .physics_access import physics_of, placed

N_RESETS, N_STEPS = 20, 30  # that are watched: the steps, at random, are of the last episode
TOLERANCE = 1e-3  # metres that a body's fixed point may lie off the achieved goal
_SAME_PLACE = 1e-5  # metres between an effector and what the observation says of it
_NUDGE = np.array([0.02, -0.03, 0.05])  # metres
_TURN = np.array([0.3, -0.4, 0.5])  # radians about the axes of what is free or on a ball joint
_STILL = 1e-5  # metres, and parts of an axis, that what stands may seem to move in a step
_TRIED = 3  # steps that are done again
_DRIVEN = 1e-3  # metres that what nobody touches may go otherwise in a step
_LEAST_MOVED = 1e-3  # metres that a thing must have moved to be told from others


@dataclass(frozen=True)
class Candidate:
    """A body whose fixed point the achieved goal may be.

    Attributes:
        body: id of the body that carries the joints.
        name: of the body, as errors and reports call it.
        offset: of the point in the body's frame, (3,) metres.
        error: largest distance between point and achieved goal that was seen, metres.
        of_robot: whether the body belongs to the robot.
    """

    body: int
    name: str
    offset: np.ndarray
    error: float
    of_robot: bool


@dataclass(frozen=True)
class Effector:
    """Where the observation holds the position of what touches the object.

    Attributes:
        entries: of the observation.
        off: mean distance from the middle of the robot's fingertips, metres.
    """

    entries: tuple[int, int, int]
    off: float


@dataclass(frozen=True)
class Observed:
    """What was seen of an environment in some episodes at random.

    Attributes:
        achieved, desired: goals, (n, 3) each, metres.
        observations: (n, size).
        positions: of bodies, (n, nbody, 3) metres.
        rotations: of bodies, (n, nbody, 3, 3).
        later: the same, (n, nbody, 12), once bodies are where the joints say: after a step MuJoCo
            has them where they were before its last one.
        sites: positions of sites, (n, nsite, 3) metres.
        episodes: in which each was seen, (n,).
        model: the last reset's.
    """

    achieved: np.ndarray
    desired: np.ndarray
    observations: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    later: np.ndarray
    sites: np.ndarray
    episodes: np.ndarray
    model: mujoco.MjModel


def observe(env: gym.Env) -> Observed:
    """Watch how some episodes begin, some random steps, and where things go that are nudged.

    At random a robot hardly touches anything: what never moved could not be told apart.

    Args:
        env: with Dict goal observations; resets and steps are done in it.

    Raises:
        ValueError: there is no MuJoCo simulation in it.
    """
    env.action_space.seed(0)
    kind = env.observation_space["desired_goal"].dtype  # type: ignore[index]
    rows: list[tuple[np.ndarray, ...]] = []
    episodes: list[int] = []

    def keep(obs: dict[str, np.ndarray], episode: int) -> None:
        model, data = physics_of(env)
        now = placed(model, data)
        goals = np.array(obs["achieved_goal"], np.float64), np.array(obs["desired_goal"], kind)
        seen = np.array(obs["observation"], np.float64).ravel()
        frames = data.xmat.reshape(-1, 3, 3).copy()
        later = np.concatenate([now.xpos, now.xmat], axis=1)
        rows.append((*goals, seen, data.xpos.copy(), frames, later, data.site_xpos.copy()))
        episodes.append(episode)

    for episode in range(N_RESETS):
        obs, _ = env.reset(seed=episode)
        keep(obs, episode)
    for _ in range(N_STEPS):
        obs, _, ended, truncated, _ = env.step(env.action_space.sample())
        keep(obs, episode)
        if ended or truncated:
            obs, _ = env.reset()
            episode += 1
    for root in _passive_roots(physics_of(env)[0]):
        env.reset(seed=0)
        _nudge(*physics_of(env), root)
        episode += 1
        keep(env.step(np.zeros_like(env.action_space.sample()))[0], episode)
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    achieved, desired, observations, positions, rotations, later, sites = columns
    when, model = np.array(episodes), physics_of(env)[0]
    told = achieved, desired, observations
    return Observed(*told, positions, rotations, later, sites, when, model)


def check_standing(seen: Observed) -> None:
    """Raise a ValueError where the goal, or what stands and can be touched, moves in an episode."""
    model = seen.model
    steps = np.flatnonzero(seen.episodes[1:] == seen.episodes[:-1])
    for now, later in zip(seen.desired[steps], seen.desired[steps + 1], strict=True):
        if not np.array_equal(now, later):
            raise ValueError(
                f"the goal moves within an episode, from {now.tolist()} to {later.tolist()}; an "
                "imagined goal belongs to a whole episode"
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
        robot = robot_bodies(model)
        _check_welds(model, data)
        alone = copy.copy(data)
        *_, ended, truncated, _ = env.step(env.action_space.sample())
        again, data = physics_of(env)
        substeps = round((data.time - alone.time) / model.opt.timestep)
        if ended or truncated or again is not model or substeps < 1:
            continue
        pushed = np.abs(data.xfrc_applied).max(axis=1, initial=0.0)
        np.maximum.at(pushed, model.dof_bodyid, np.abs(data.qfrc_applied))
        touched = _touched(model, alone, robot) or _touched(model, data, robot)
        alone.ctrl[:] = data.ctrl
        alone.mocap_pos[:], alone.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        for _ in range(substeps):
            mujoco.mj_step(model, alone)
            touched = touched or _touched(model, alone, robot)
        places, theirs = (placed(model, each).xpos for each in (alone, data))
        off = np.linalg.norm(places - theirs, axis=1)
        # A robot that went otherwise had other controls within the step, and may have touched.
        unknown = touched or off[robot].max(initial=0.0) > _DRIVEN
        for body in _passive_roots(model):
            if not touchable(model)[body]:
                continue
            if pushed[body]:
                raise ValueError(
                    f"a force is applied to body {body_name(model, body)}, which the object's "
                    "scene cannot have"
                )
            if off[body] > _DRIVEN and not unknown:
                raise ValueError(
                    f"body {body_name(model, body)} is moved by the environment, not by its "
                    f"physics alone ({off[body] * 1e3:.0f} mm off after a step), which the "
                    "object's scene cannot follow; move a body without joints, at resets"
                )


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


def candidates(seen: Observed) -> list[Candidate]:
    """Every body with joints of its own, the best match first."""
    model, robot = seen.model, robot_bodies(seen.model)
    found = [
        Candidate(body, body_name(model, body), *_fixed_point(seen, body), bool(robot[body]))
        for body in range(1, model.nbody)
        if carrier(model, body) == body
    ]
    return sorted(found, key=lambda each: each.error)


def find_object(seen: Observed, wanted: str | None = None) -> Candidate:
    """Return the body whose fixed point the achieved goal is.

    Args:
        seen: of the environment.
        wanted: name of the object's body, where several would fit; None takes the one that does.

    Raises:
        ValueError: no body fits, only the robot's do, several do, or the one wanted does not.
    """
    found = candidates(seen)
    if wanted is not None:
        return _named(seen, found, wanted)
    fitting = [each for each in found if each.error <= TOLERANCE]
    free = [each for each in fitting if not each.of_robot]
    if not fitting:
        near = "; ".join(f"{each.name} is off by {each.error * 1e3:.0f} mm" for each in found[:3])
        raise ValueError(
            f"no body moves with the achieved goal ({near or 'nothing in the scene has a joint'}); "
            "achieved goals must be a point that is fixed to the object"
        )
    if not free:
        raise ValueError(
            "the achieved goal is a point of the robot itself "
            f"({', '.join(each.name for each in fitting[:5])}): there is no object to follow; "
            "train it with --method her"
        )
    if len(free) > 1:
        raise ValueError(
            "several bodies move with the achieved goal: "
            f"{', '.join(each.name for each in free)}; name one of them with object="
        )
    return free[0]


def find_effector(seen: Observed, entries: tuple[int, int, int] | None = None) -> Effector | None:
    """Return where the observation holds the position of what touches the object; None, nowhere.

    Of several parts of the robot it is the one nearest to the fingertips' middle.

    Args:
        seen: of the environment.
        entries: where the observation is known to hold it; None looks for it.
    """
    robot = robot_bodies(seen.model)
    if not robot.any():
        return None
    tips = Fingertips(seen.model).middle(seen.positions, seen.rotations)
    if entries is not None:
        return _effector(seen, entries, tips)
    points = np.concatenate([seen.sites, seen.positions], axis=1)
    points = points[:, np.concatenate([robot[seen.model.site_bodyid], robot])]
    found: list[Effector] = []
    for first in range(seen.observations.shape[1] - 2):
        entries = first, first + 1, first + 2
        told = seen.observations[:, entries]
        if np.ptp(told, axis=0).max() < _LEAST_MOVED:
            continue
        if (np.abs(points - told[:, None]).max(axis=(0, 2), initial=0.0) <= _SAME_PLACE).any():
            found.append(_effector(seen, entries, tips))
    return min(found, key=lambda each: round(each.off, 3), default=None)


def _effector(seen: Observed, entries: tuple[int, int, int], tips: np.ndarray) -> Effector:
    told = seen.observations[:, entries]
    return Effector(entries, float(np.linalg.norm(told - tips, axis=1).mean()))


def _passive_roots(model: mujoco.MjModel) -> list[int]:
    """Bodies with joints of their own that are not the robot's."""
    robot = robot_bodies(model)
    return [b for b in range(1, model.nbody) if model.body_jntnum[b] and not robot[b]]


def _nudge(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> None:
    """Move a body along its joints: a free one up, aside and round, others into their range."""
    kinds, first = mujoco.mjtJoint, int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        adr, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        low, high = model.jnt_range[joint]
        if kind == int(kinds.mjJNT_FREE):
            data.qpos[adr : adr + 3] += _NUDGE
            mujoco.mju_quatIntegrate(data.qpos[adr + 3 : adr + 7], _TURN, 1.0)
        elif kind == int(kinds.mjJNT_BALL):
            mujoco.mju_quatIntegrate(data.qpos[adr : adr + 4], _TURN, 1.0)
        elif model.jnt_limited[joint]:  # a quarter off the end that is farther
            nearer_low = data.qpos[adr] - low < high - data.qpos[adr]
            data.qpos[adr] = high - (high - low) / 4 if nearer_low else low + (high - low) / 4
        else:
            data.qpos[adr] += _NUDGE[2]
    mujoco.mj_forward(model, data)


def _fixed_point(seen: Observed, body: int) -> tuple[np.ndarray, float]:
    """The point of a body's frame that is nearest to the achieved goals, and its largest error."""
    position, turn = np.split(seen.later[:, body], [3], axis=1)

    def fixed(position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, float]:
        local = np.einsum("nji,nj->ni", rotation, seen.achieved - position)
        offset = local.mean(axis=0)
        return offset, float(np.linalg.norm(local - offset, axis=1).max())

    return min(
        fixed(seen.positions[:, body], seen.rotations[:, body]),
        fixed(position, turn.reshape(-1, 3, 3)),
        key=lambda found: found[1],
    )


def _named(seen: Observed, found: list[Candidate], wanted: str) -> Candidate:
    model = seen.model
    known = {str(model.site(s).name): int(model.site_bodyid[s]) for s in range(model.nsite)}
    known |= {str(model.geom(g).name): int(model.geom_bodyid[g]) for g in range(model.ngeom)}
    known |= {str(model.body(body).name): body for body in range(1, model.nbody)}
    names = ", ".join(each.name for each in found if not each.of_robot)
    if wanted not in known:
        raise ValueError(f"the scene has no body {wanted!r}; those that can move are {names}")
    root = carrier(model, known[wanted])
    each = next((each for each in found if each.body == root), None)
    if each is None:
        raise ValueError(f"{wanted!r} has no joint, so it cannot move; those that can are {names}")
    if each.of_robot:
        raise ValueError(f"{wanted!r} is a part of the robot; other bodies that can move: {names}")
    if each.error > TOLERANCE:
        raise ValueError(
            f"the achieved goal does not move with {wanted!r}: it is off by up to "
            f"{each.error * 1e3:.0f} mm; the nearest body is {found[0].name}"
        )
    return Candidate(each.body, wanted, each.offset, each.error, False)
