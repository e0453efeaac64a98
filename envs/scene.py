"""Scenes composed with MjSpec: robot, table, obstacles and object, and the object alone.

The robot, table and object are the Fetch assets that gymnasium-robotics installs. Only their place
on disk is looked up: that package is never imported, and so its limits on mujoco are not ours.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .physics_engine import mujoco
from .surface import no_edge, surface_bounds
from .tasks import SUCCESS_DISTANCE, Box, Landmarks, Task
from .transcription import transcribe

N_SUBSTEPS = 20  # of 0.002 s each: one env step is 0.04 s
OBJECT = "object0"  # body, site and geom
TABLE = "table0"
TUBE = "tube"
OBSTACLE = "obstacle"
PULLER = f"{OBJECT}:mocap"  # pulls the object where it is alone
GRIP_SITE = "robot0:grip"
# Right, then left, as in the observation.
FINGER_JOINTS = ("robot0:r_gripper_finger_joint", "robot0:l_gripper_finger_joint")

# Where the robot and the object stand before the arm is moved into place.
_SLIDES = {"robot0:slide0": 0.405, "robot0:slide1": 0.48, "robot0:slide2": 0.0}
_OBJECT_QPOS = (1.25, 0.53, 0.4, 1.0, 0.0, 0.0, 0.0)
_GRIPPER_EXTRA_HEIGHT = 0.2
_MOCAP_OFFSET = np.array([-0.498, 0.005, -0.431 + _GRIPPER_EXTRA_HEIGHT])
_MOCAP_QUAT = (1.0, 0.0, 1.0, 0.0)
_SETUP_STEPS = 10
# Inside the floor, where it is neither seen nor touched, until a reset puts it at the goal.
_TUBE_STORE = (1.3, 0.75, -0.5)

_EQ_DATA = 11  # numbers of an equality; mujoco 4 has one more, which a weld does not use

COLLISIONS = ("reachable", "full")
# collision="reachable": two geoms are tested when one's bit is in the other's mask. Kept is every
# pair of a robot part with floor, table, obstacles, tube or object, and of the arm with the trunk
# (the shoulder rubs against the torso when the gripper is far out, and leaving that out changes
# where the gripper goes). Left out are links of the arm against each other, except for the hand
# against the upper arm, and the three parts named last.
_FLOOR, _STANDING, _OBJECT_BIT, _TRUNK, _UPPER_ARM = 1, 2, 4, 8, 16
_WORLD = _FLOOR | _STANDING | _OBJECT_BIT
_ROBOT_BITS = {
    "base_link": (_TRUNK, _WORLD),
    "torso_lift_link": (_TRUNK, _WORLD),
    "head_pan_link": (_TRUNK, _WORLD),
    "head_tilt_link": (_TRUNK, _WORLD),
    "shoulder_pan_link": (0, _WORLD),
    "shoulder_lift_link": (_UPPER_ARM, _WORLD | _TRUNK),
    "upperarm_roll_link": (_UPPER_ARM, _WORLD | _TRUNK),
    "elbow_flex_link": (0, _WORLD | _TRUNK),
    "forearm_roll_link": (0, _WORLD | _TRUNK),
    "wrist_flex_link": (0, _WORLD | _TRUNK),
    "wrist_roll_link": (0, _WORLD | _TRUNK),
    "gripper_link": (0, _WORLD | _TRUNK | _UPPER_ARM),
    "r_gripper_finger_link": (0, _WORLD | _TRUNK | _UPPER_ARM),
    "l_gripper_finger_link": (0, _WORLD | _TRUNK | _UPPER_ARM),
}
_NEVER_TOUCHED = ("estop_link", "laser_link", "torso_fixed_link")


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene and what a simulation of it starts from; shared by all its copies.

    Args:
        task: the row it was built from.
        alone: whether the object is alone (no robot).
        model: the physics, not to be written to.
        qpos: state every episode starts from but for the object's place, (nq,).
        qvel: likewise, (nv,).
        time: simulated time at the start of an episode, in seconds.
        landmarks: points that the task's samplers refer to.
        substeps: of the physics in an env step of 0.04 s.
        success_distance: metres within which a goal is reached.
        surface: lowest and highest x and y of an object that stays on the table, (2, 2) metres;
            of the object's own scene.
    """

    task: Task
    alone: bool
    model: mujoco.MjModel
    qpos: np.ndarray
    qvel: np.ndarray
    time: float
    landmarks: Landmarks
    substeps: int = N_SUBSTEPS
    success_distance: float = SUCCESS_DISTANCE
    surface: np.ndarray = field(default_factory=no_edge)

    def __deepcopy__(self, memo: dict[int, Any]) -> Scene:
        return self


@lru_cache(maxsize=32)
def fetch_scene(task: Task, collision: str = "reachable") -> Scene:
    """The robot's scene of a task, set up: arm moved into place, object at rest.

    Args:
        task: the row to build.
        collision: "full" tests every pair of geoms, "reachable" those that can matter.

    Raises:
        ValueError: `collision` is neither of the two.
    """
    if collision not in COLLISIONS:
        raise ValueError(f"collision must be 'reachable' or 'full', not {collision!r}.")
    spec = fetch_spec(task)
    if collision == "reachable":
        _leave_out_unreachable(spec)
    model = strip_visuals(spec).compile()
    return _set_up(task, model)


@lru_cache(maxsize=32)
def object_scene(task: Task) -> Scene:
    """The same task with the object alone; episodes start as those of the robot do."""
    robot = fetch_scene(task)
    model = _object_alone(fetch_spec(task).compile())
    start = robot.model.joint(f"{OBJECT}:joint").qposadr[0]
    qpos = robot.qpos[start : start + 7].copy()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    surface = surface_bounds(model, data, int(model.body(OBJECT).id))
    still = np.zeros(model.nv)
    return Scene(task, True, model, qpos, still, 0.0, robot.landmarks, surface=surface)


def _object_alone(whole: mujoco.MjModel) -> mujoco.MjModel:
    """The passive part of a scene, its object pulled by a mocap body (section 4.1)."""
    data = mujoco.MjData(whole)
    mujoco.mj_kinematics(whole, data)
    copied = transcribe(whole, data)
    thing = copied.added[int(whole.body(OBJECT).id)]
    thing.add_site(name=OBJECT, pos=whole.site(OBJECT).pos)
    copied.spec.worldbody.add_body(name=PULLER, mocap=True, pos=thing.pos, quat=thing.quat)
    weld_to(copied.spec, PULLER, OBJECT)
    return copied.spec.compile()


def fetch_spec(task: Task) -> mujoco.MjSpec:
    """The robot's scene of a task with everything in it, for physics and for pictures."""
    # With blocked fingers the original has no actuators; both files are the same otherwise.
    file = "push.xml" if task.blocked_gripper else "pick_and_place.xml"
    spec = mujoco.MjSpec.from_file(str(_assets() / "fetch" / file))
    table = _child(spec.worldbody.bodies, TABLE)
    table.geoms[0].name = TABLE
    _add_boxes(table, OBSTACLE, task.obstacles)
    if task.tube:
        tube = spec.worldbody.add_body(name=TUBE, mocap=True, pos=_TUBE_STORE)
        _add_boxes(tube, TUBE, task.tube)
    return spec


def weld_to(spec: mujoco.MjSpec, mocap: str, body: str) -> None:
    """Let a mocap body of a spec pull another of its bodies along."""
    weld = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=mocap,
        name2=body,
        solref=[0.02, 1.0],
        solimp=[0.9, 0.95, 0.001, 0.5, 2.0],
    )
    weld.data[:11] = [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1]  # same pose, torque scale 1


def strip_visuals(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Drop what physics never reads: cameras, lights and bodies that hold nothing.

    Geoms that touch nothing stay: mujoco lays the axes of its coarse collision test through all
    geoms, and from those follows whether a contact at the edge of its margin is seen.
    """
    delete(spec, spec.cameras)
    delete(spec, spec.lights)
    for body in list(spec.worldbody.bodies):
        _delete_empty(spec, body)
    return spec


def physics_digest(task: Task) -> str:
    """A short hash of what decides the object's motion: its scene, its samplers, the substeps.

    Numbers of the compiled scene are hashed and not its XML, whose wording changes between
    releases of mujoco.
    """
    model = object_scene(task).model
    fields = (
        "body_pos body_mass body_inertia geom_type geom_pos geom_size geom_friction geom_condim "
        "geom_margin geom_solref geom_solimp dof_damping eq_data eq_solref eq_solimp"
    )
    parts = [repr(task), str(N_SUBSTEPS), f"{model.opt.timestep:.9g}", str(model.opt.gravity)]
    for name in fields.split():
        values = np.asarray(getattr(model, name), dtype=np.float64)
        if name == "eq_data":
            values = values[:, :_EQ_DATA]
        parts.append(name + " ".join(f"{value:.9g}" for value in values.ravel()))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def weld_targets(model: mujoco.MjModel) -> tuple[int, int]:
    """The mocap id and the body id of a scene's one weld."""
    first, second = int(model.eq_obj1id[0]), int(model.eq_obj2id[0])
    if model.body_mocapid[first] < 0:
        first, second = second, first
    return int(model.body_mocapid[first]), second


def _set_up(task: Task, model: mujoco.MjModel) -> Scene:
    data = mujoco.MjData(model)
    for name, value in _SLIDES.items():
        data.joint(name).qpos = value
    data.joint(f"{OBJECT}:joint").qpos = _OBJECT_QPOS
    # As the original: the weld holds the gripper where the mocap is, turned as compiled.
    model.eq_data[0, :7] = [0, 0, 0, 0, 0, 0, 1]
    mujoco.mj_forward(model, data)
    mocap, _ = weld_targets(model)
    data.mocap_pos[mocap] = data.site(GRIP_SITE).xpos + _MOCAP_OFFSET
    data.mocap_quat[mocap] = _MOCAP_QUAT
    mujoco.mj_step(model, data, nstep=_SETUP_STEPS * N_SUBSTEPS)
    gripper, table = data.site(GRIP_SITE).xpos, data.body(TABLE).xpos
    landmarks = Landmarks(
        gripper=(float(gripper[0]), float(gripper[1]), float(gripper[2])),
        table=(float(table[0]), float(table[1]), float(table[2])),
        rest_height=float(data.site(OBJECT).xpos[2]),
    )
    return Scene(task, False, model, data.qpos.copy(), data.qvel.copy(), data.time, landmarks)


def _leave_out_unreachable(spec: mujoco.MjSpec) -> None:
    for geom in spec.geoms:
        part = geom.name.removeprefix("robot0:").rstrip("0123456789")
        if part in _ROBOT_BITS:
            geom.contype, geom.conaffinity = _ROBOT_BITS[part]
        elif part in _NEVER_TOUCHED:
            geom.contype, geom.conaffinity = 0, 0
        elif part == "object":
            geom.contype, geom.conaffinity = _OBJECT_BIT, _FLOOR | _STANDING
        elif part == "floor":
            geom.contype, geom.conaffinity = _FLOOR, 0
        elif part in ("table", "obstacle", "tube"):
            geom.contype, geom.conaffinity = _STANDING, 0


@lru_cache(maxsize=1)
def _assets() -> Path:
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise ModuleNotFoundError("The Fetch assets are missing: pip install gymnasium-robotics.")
    return Path(found.origin).parent / "envs" / "assets"


def _add_boxes(body: Any, name: str, boxes: Iterable[Box]) -> None:
    for number, box in enumerate(boxes):
        body.add_geom(
            name=f"{name}{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.centre,
            size=box.half_size,
            friction=box.friction,
            condim=box.condim,
            rgba=(0.45, 0.55, 0.70, 1.0),
        )


def _child(bodies: Iterable[Any], name: str) -> Any:
    return next(body for body in bodies if body.name == name)


def _delete_empty(spec: mujoco.MjSpec, body: Any) -> bool:
    """Delete the bodies from here down that hold nothing; whether this one was one of them."""
    kept = [child for child in list(body.bodies) if not _delete_empty(spec, child)]
    holds = body.joints or body.geoms or body.sites or body.mocap or body.mass > 0
    if kept or holds:
        return False
    delete(spec, [body])
    return True


def delete(spec: mujoco.MjSpec, elements: Iterable[Any]) -> None:
    """Delete elements of a spec."""
    for element in list(elements):
        if hasattr(spec, "delete"):
            spec.delete(element)
        elif isinstance(element, mujoco.MjsBody):  # mujoco before 3.3.3, as below
            spec.detach_body(element)
        else:
            element.delete()
