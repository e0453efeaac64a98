"""The object, found by observation: the body that the achieved goal is a fixed point of."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import body_name, carrier, passive_roots, robot_bodies
from .effectors import Fingertips
from .physics_access import physics_of, placed

N_RESETS, N_STEPS = 20, 30  # that are watched: the steps, at random, are of the last episode
TOLERANCE = 1e-3  # metres that a body's fixed point may lie off the achieved goal
_SAME_PLACE = 1e-5  # metres between an effector and what the observation says of it
_NUDGE = np.array([0.02, -0.03, 0.05])  # metres
_TURN = np.array([0.3, -0.4, 0.5])  # radians about the axes of what is free or on a ball joint
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
    for root in passive_roots(physics_of(env)[0]):
        env.reset(seed=0)
        _nudge(*physics_of(env), root)
        episode += 1
        keep(env.step(np.zeros_like(env.action_space.sample()))[0], episode)
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    achieved, desired, observations, positions, rotations, later, sites = columns
    when, model = np.array(episodes), physics_of(env)[0]
    told = achieved, desired, observations
    return Observed(*told, positions, rotations, later, sites, when, model)


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
