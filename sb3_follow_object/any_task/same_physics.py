"""Whether what is not the robot's is the same in every episode but for where it is."""

from __future__ import annotations

import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import (
    body_name,
    equated_bodies,
    robot_bodies,
    standing,
    touchable,
    touching_geoms,
)

_SAME = 1e-6  # metres, and parts of a unit quaternion
_NUMBERS = ("nbody", "ngeom", "nq", "njnt")
_SHAPES = {
    "type": "geom_type",
    "place": "geom_pos",
    "turn": "geom_quat",
    "size": "geom_size",
    "mesh or height field": "geom_dataid",
    "contype": "geom_contype",
    "conaffinity": "geom_conaffinity",
}
_OF_JOINTS = {
    "type": "jnt_type",
    "place": "jnt_pos",
    "axis": "jnt_axis",
    "limit": "jnt_limited",
    "range": "jnt_range",
}


def check_same_physics(
    first: tuple[mujoco.MjModel, mujoco.MjData], now: tuple[mujoco.MjModel, mujoco.MjData]
) -> None:
    """Raise a ValueError where an episode has other shapes, joints or equalities than the first.

    The object's scene is made of the first. What stands elsewhere in it are bodies without joints;
    what has joints is elsewhere by their positions. The robot may change as it likes, and so may
    what touches nothing.

    Args:
        first: model and state of an episode's beginning.
        now: of another's.
    """
    _check_shapes(first[0], now[0])
    _check_equalities(first, now)


def _check_shapes(first: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Raise a ValueError where a model has other things, or hung or shaped otherwise."""
    if any(getattr(first, name) != getattr(model, name) for name in _NUMBERS):
        raise ValueError(
            "its model has other bodies, geoms or joints in other episodes; the object's scene "
            "needs the same in all: move what is not wanted out of the way"
        )
    _check_hung(first, model)
    _check_joints(first, model)
    for what, name in _SHAPES.items():
        differ = _differing(first, model, name)
        if differ.any():  # in few resets
            _refuse_geoms(first, model, differ, what)
    heights = first.nhfielddata, model.nhfielddata
    if heights[0] != heights[1] or _differing(first, model, "hfield_data").any():
        fields = first.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD)
        _refuse_geoms(first, model, fields, "height field")
    if not np.array_equal(first.mesh_vert, model.mesh_vert):
        _refuse_geoms(first, model, _other_meshes(first, model), "mesh")


def _check_equalities(
    first: tuple[mujoco.MjModel, mujoco.MjData], now: tuple[mujoco.MjModel, mujoco.MjData]
) -> None:
    """Raise a ValueError where equalities of what is not the robot's differ between episodes."""
    (model, data), (other, state) = first, now
    if model.neq == other.neq:
        differ = _differing(model, other, "eq_data") | (data.eq_active != state.eq_active)
        if not differ.any():  # as in most resets
            return
    ours, theirs = _passive_equalities(model, data), _passive_equalities(other, state)
    for named in {**ours, **theirs}:
        one, two = (each.get(named, np.zeros(0)) for each in (ours, theirs))
        if one.shape != two.shape or not np.allclose(one, two, rtol=0.0, atol=_SAME):
            raise ValueError(
                f"an equality of {named} is another in other episodes, or off in some, which the "
                "object's scene cannot follow"
            )


def _passive_equalities(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
    """By the names of bodies that are not the robot's: what their equalities are, on or off."""
    robot = robot_bodies(model)
    found: dict[str, list[np.ndarray]] = {}
    for row in range(model.neq):
        bodies = equated_bodies(model, row)
        if bodies and not robot[bodies].any():
            values = np.append(model.eq_data[row], [data.eq_active[row], model.eq_type[row]])
            names = " and ".join(body_name(model, body) for body in bodies)
            found.setdefault(names, []).append(values)
    return {names: np.concatenate(values) for names, values in found.items()}


def _differing(first: mujoco.MjModel, model: mujoco.MjModel, name: str) -> np.ndarray:
    """Which rows of a model's field are others than the first one's, bool (n,)."""
    one, other = getattr(first, name), getattr(model, name)
    off = np.abs(np.subtract(one, other, dtype=np.float64)) > _SAME
    differ: np.ndarray = off.any(axis=1) if off.ndim == 2 else off
    return differ


def _refuse_geoms(
    first: mujoco.MjModel, model: mujoco.MjModel, differ: np.ndarray, what: str
) -> None:
    """Raise a ValueError where geoms that differ can be touched and are not the robot's."""
    touching = touching_geoms(first) | touching_geoms(model)
    matter = touching & ~robot_bodies(first)[first.geom_bodyid]
    for geom in map(int, np.flatnonzero(matter & differ)):
        of = body_name(first, int(first.geom_bodyid[geom]))
        raise ValueError(
            f"geom {first.geom(geom).name or geom} of body {of} has another {what} in other "
            "episodes, which the object's scene cannot follow; give it a body of its own, and "
            "move that"
        )


def _check_hung(first: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Raise a ValueError where what joints move hangs elsewhere than in the first model."""
    differ = _differing(first, model, "body_pos") | _differing(first, model, "body_quat")
    differ &= ~standing(first)
    if not differ.any():  # as in most resets
        return
    of_free = first.jnt_bodyid[first.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]
    differ[of_free] = False  # their joint alone says where they are
    matter = np.zeros(first.nbody, dtype=bool)
    matter[first.geom_bodyid[touching_geoms(first)]] = True
    matter[first.jnt_bodyid] = True
    for body in map(int, np.flatnonzero(differ & matter & ~robot_bodies(first))):
        raise ValueError(
            f"body {body_name(first, body)}, which joints move, hangs elsewhere in other episodes, "
            "which the object's scene cannot follow; hang it on a body without joints, and move "
            "that"
        )


def _check_joints(first: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Raise a ValueError where what is not the robot's hangs on other joints than at first."""
    limited = (first.jnt_limited != 0) | (model.jnt_limited != 0)
    differ = {what: _differing(first, model, name) for what, name in _OF_JOINTS.items()}
    differ["range"] &= limited
    # Of joints of several numbers it is not what they are counted from.
    of_one = np.isin(first.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    differ["reference"] = _differing(first, model, "qpos0")[first.jnt_qposadr] & of_one
    if not any(rows.any() for rows in differ.values()):  # as in most resets
        return
    matter = (touchable(first) & ~robot_bodies(first))[first.jnt_bodyid]
    for what, rows in differ.items():
        for joint in map(int, np.flatnonzero(rows & matter)):
            raise ValueError(
                f"joint {first.joint(joint).name or joint} of body "
                f"{body_name(first, int(first.jnt_bodyid[joint]))} has another {what} in other "
                "episodes, which the object's scene cannot follow; hang it on a body without "
                "joints, and move that"
            )


def _other_meshes(first: mujoco.MjModel, model: mujoco.MjModel) -> np.ndarray:
    """Which geoms have a mesh with other vertices than the first model's, bool (ngeom,)."""
    differ = first.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH)
    for geom in map(int, np.flatnonzero(differ)):
        differ[geom] = not np.array_equal(_vertices(first, geom), _vertices(model, geom))
    return differ


def _vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Of a geom's mesh, (n, 3)."""
    mesh = int(model.geom_dataid[geom])
    first = int(model.mesh_vertadr[mesh])
    vertices: np.ndarray = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
    return vertices
