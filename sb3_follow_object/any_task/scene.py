"""The object's own scene of a task that nobody here wrote, ready to be simulated in batches."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import rigid_group
from ..envs.scene import weld_to
from ..envs.surface import no_edge, surface_bounds
from ..envs.transcription import JOINT_SIZE, Transcription, transcribe
from .resets import Resets, varying_bodies

STEP = 0.04  # seconds of an env step, as in the package's own tasks
POINT, PULLER = "followed:point", "followed:mocap"
_LEAST_MASS = 1e-9  # kg
_OFF = 2e-3  # metres that an episode here may begin off the task's; its point is known to 1 mm
# Fields of a model that decide no object's motion; every other one is taken to.
_NO_PHYSICS = re.compile(
    r"""
    (cam | light | mat | site | skin | tex)_  # looks; sites mark goals
    | mesh_(face)?(normal | texcoord)
    | \w+_(rgba | group | matid | width | pathadr)$
    | (names? | key | numeric | text | tuple | sensor)_  # what is told or measured
    | \w+_user$
    | actuator_ | \w+_actuatorid$  # the robot's
    # What MuJoCo makes of the rest.
    | (B | D | M | bvh | efm0 | oct | ten | tree)_ | map | mesh_(graph | poly | pos | quat | scale)
    | \w+_(bvhadr | bvhnum | octadr | octnum | sameframe | simple | simplenum | treeid)$
    | \w+_(M0 | Madr | aabb | invweight0 | length | length0 | rbound | subtreemass)$
    """,
    re.VERBOSE,
)
_OF_DOFS = (
    "dof_armature",
    "dof_damping",
    "dof_dampingpoly",
    "dof_frictionloss",
    "dof_solref",
    "dof_solimp",
)
_POSES = ("body_pos", "body_quat")


@dataclass(frozen=True)
class DerivedTask:
    """What a simulation asks a task.

    Args:
        name: gymnasium id of the robot's task.
        horizon: T of the object's episodes.
        physics: hash of what decides how the object moves.
    """

    name: str
    horizon: int
    physics: str
    tube: tuple[()] = ()  # of no use, but checkpoints hold the task's repr


@dataclass(frozen=True, eq=False)
class DerivedScene:
    """A compiled scene of an object alone and the episodes that it plays; shared by all copies.

    Args:
        task: whose it is.
        model: the physics, not to be written to.
        welded: body that the mocap body pulls, an id of `model`.
        qpos, qvel: of the joints, (n, nq) and (n, nv), a row an episode.
        mocap: of the bodies that stand elsewhere in each episode, (n, m, 7).
        goals: (n, 3) metres.
        substeps: of the physics in an env step of 0.04 s.
        success_distance: metres within which a goal is reached.
        context: what episodes differ in beside start and goal, by the names of `context_of`.
        surface: lowest and highest x and y of the welded body while it stays on its surface, (2, 2)
            metres; infinite where no edge is known, or goals lie beyond it.
    """

    task: DerivedTask
    model: mujoco.MjModel
    welded: int
    qpos: np.ndarray
    qvel: np.ndarray
    mocap: np.ndarray
    goals: np.ndarray
    substeps: int
    success_distance: float
    context: tuple[str, ...] = ()
    surface: np.ndarray = field(default_factory=no_edge)

    def __deepcopy__(self, memo: dict[int, Any]) -> DerivedScene:
        return self


def object_scene_of(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: int,
    offset: np.ndarray,
    resets: Resets,
    task: DerivedTask,
    success_distance: float,
    context: tuple[str, ...] = (),
) -> DerivedScene:
    """Make the scene in which a body moves by itself, pulled by a mocap body (section 4.1).

    Args:
        model: of the robot's environment.
        data: its state at a reset's end.
        body: of the object, with its joints.
        offset: of the point that goals are about, in the body's frame, (3,) metres.
        resets: episodes to play.
        task: whose scene it is.
        success_distance: metres.
        context: as in `DerivedScene`.

    Raises:
        ValueError: the object has no mass, the scene holds what cannot be copied, or the object is
            elsewhere in it than in the task.
    """
    copied = transcribe(model, data, varying_bodies(model, resets))
    heavy = _heaviest(model, body)
    spec = copied.spec
    copied.added[body].add_site(name=POINT, pos=offset)
    spec.worldbody.add_body(name=PULLER, mocap=True)
    weld_to(spec, PULLER, copied.bodies[heavy])
    alone = spec.compile()
    substeps = max(1, round(STEP / alone.opt.timestep))
    positions, velocities = _places_in(model, alone, copied)
    for name in _OF_DOFS:  # a joint of several has one number for all of them in a spec
        if hasattr(model, name):
            getattr(alone, name)[:] = getattr(model, name)[velocities]
    scene = DerivedScene(
        task,
        alone,
        int(alone.body(copied.bodies[heavy]).id),
        resets.qpos[:, positions],
        resets.qvel[:, velocities],
        _standing(alone, copied, resets),
        resets.goals,
        substeps,
        success_distance,
        context,
    )
    _check_starts(scene, resets)
    return replace(scene, surface=_surface(scene, resets.goals))


def physics_digest_of(
    model: mujoco.MjModel,
    body: int,
    offset: np.ndarray,
    resets: Resets,
    drawn: str,
    again: mujoco.MjModel | None = None,
) -> str:
    """A short hash of what decides how the object moves and where goals lie.

    Where bodies stand in one episode or another is left out, since it may not repeat itself, and
    so is what is only seen.

    Args:
        model: of the robot's environment.
        body: of the object.
        offset: of its point, (3,).
        resets: a few.
        drawn: what decides how episodes are drawn, as far as that is known.
        again: the model after another reset with the same seed; numbers of which no seed says what
            they are differ in it, and are left out.
    """
    varying = sorted(varying_bodies(model, resets))
    point = " ".join(f"{value:.6f}" for value in offset.round(6) + 0.0)
    digest = hashlib.sha256(f"{body}\n{drawn}\n{point}".encode())
    fields = _physics_fields(model)
    repeated = fields if again is None else _physics_fields(again)
    for name, values in fields.items():
        same = repeated.get(name)
        if same is None or same.shape != values.shape:
            continue
        values = np.where(values == same, values, 0)
        if name in _POSES:
            values[varying] = 0.0
            values = values.round(6)
        kind = "<f4" if values.dtype.kind == "f" else "<i8"
        digest.update(f"\n{name} {values.shape} ".encode() + (values + 0).astype(kind).tobytes())
    return digest.hexdigest()[:12]


def _physics_fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """What of a model decides how things move in it, by the names of its fields.

    Options that are MuJoCo's own and fields that say nothing are left out, or each MuJoCo that has
    one more would have other physics.
    """
    usual, fields = mujoco.MjOption(), {}
    for name in dir(model.opt):
        if not name.startswith("_"):
            values = np.atleast_1d(getattr(model.opt, name))
            if not np.array_equal(values, np.atleast_1d(getattr(usual, name))):
                fields[f"opt_{name}"] = values
    for name in dir(model):
        if name.startswith("_") or _NO_PHYSICS.match(name):
            continue
        values = getattr(model, name)
        if isinstance(values, np.ndarray) and not any((values == none).all() for none in (0, -1)):
            fields[name] = values
    return fields


def _heaviest(model: mujoco.MjModel, body: int) -> int:
    """The body of an object's rigid parts that has the mass: a weld pulls no other with force."""
    group = rigid_group(model, body)
    if model.body_mass[body] > 0.5 * model.body_mass[group].sum():
        return body
    heavy = int(group[np.argmax(model.body_mass[group])])
    if model.body_mass[heavy] <= _LEAST_MASS:
        raise ValueError(
            f"the object {model.body(body).name!r} has no mass, so nothing can pull it; give its "
            "body a mass, or its geoms"
        )
    return heavy


def _places_in(
    model: mujoco.MjModel, alone: mujoco.MjModel, copied: Transcription
) -> tuple[np.ndarray, np.ndarray]:
    """Which of a model's positions and velocities are those of the object's scene, in order."""
    positions, velocities = np.zeros(alone.nq, dtype=int), np.zeros(alone.nv, dtype=int)
    for joint, name in copied.joints.items():
        new = alone.joint(name).id
        n_pos, n_vel = JOINT_SIZE[int(model.jnt_type[joint])]
        pos, vel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        new_pos, new_vel = int(alone.jnt_qposadr[new]), int(alone.jnt_dofadr[new])
        positions[new_pos : new_pos + n_pos] = np.arange(pos, pos + n_pos)
        velocities[new_vel : new_vel + n_vel] = np.arange(vel, vel + n_vel)
    return positions, velocities


def _standing(alone: mujoco.MjModel, copied: Transcription, resets: Resets) -> np.ndarray:
    """Places (n, nmocap, 7) of the scene's mocap bodies; the puller's are not read."""
    places = np.zeros((len(resets), alone.nmocap, 7))
    places[:, :, 3] = 1.0
    for body in copied.standing:
        mocap = int(alone.body_mocapid[alone.body(copied.bodies[body]).id])
        places[:, mocap] = resets.places[:, body]
    return places


def _surface(scene: DerivedScene, goals: np.ndarray) -> np.ndarray:
    """Bounds of what the object lies on, unless episodes begin or have goals (n, 3) beyond them."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos[0]
    mujoco.mj_kinematics(model, data)
    bounds = surface_bounds(model, data, scene.welded)
    if np.isinf(bounds).all():
        return bounds
    joint = int(model.jnt_qposadr[model.body_jntadr[scene.welded]])  # a free one, as it has bounds
    starts = scene.qpos[:, joint : joint + 2]
    point = data.site_xpos[int(model.site(POINT).id)] - data.xpos[scene.welded]
    near = scene.success_distance + np.linalg.norm(point[:2])  # it may turn about the vertical
    within, reached = (_beyond(bounds, starts) == 0.0), (_beyond(bounds, goals[:, :2]) <= near)
    return bounds if within.all() and reached.all() else no_edge()


def _beyond(bounds: np.ndarray, places: np.ndarray) -> np.ndarray:
    """How far outside of bounds (2, 2) places (n, 2) lie, (n,) metres."""
    return np.linalg.norm(places - np.clip(places, bounds[0], bounds[1]), axis=1)


def _check_starts(scene: DerivedScene, resets: Resets) -> None:
    """Raise a ValueError where the object is elsewhere than in the episodes that were recorded.

    Who reads a place right after a step has it a substep late, which counts as the same.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    site, late = int(model.site(POINT).id), -model.opt.timestep
    for episode, start in enumerate(resets.starts):
        data.qpos[:] = scene.qpos[episode]
        data.mocap_pos[:] = scene.mocap[episode, :, :3]
        data.mocap_quat[:] = scene.mocap[episode, :, 3:]
        mujoco.mj_kinematics(model, data)
        off = np.linalg.norm(data.site_xpos[site] - start)
        if off > _OFF:
            mujoco.mj_integratePos(model, data.qpos, scene.qvel[episode], late)
            mujoco.mj_kinematics(model, data)
            off = min(off, np.linalg.norm(data.site_xpos[site] - start))
        if off > _OFF:
            raise ValueError(
                f"an episode of the object's own scene begins {off * 1e3:.0f} mm off the task's "
                f"(seed {episode}): joints and places of bodies must say where the achieved goal is"
            )
