"""How far an object may go that stays on the surface it lies on (section 4.1)."""

from __future__ import annotations

import numpy as np

from .physics_engine import mujoco
from .robot_parts import touching_geoms

_NEAR = 0.01  # metres between an object and the surface that it lies on
_SQUARE = 1e-3  # how far off the world's axes a box may be turned
_GEOM = mujoco.mjtGeom


def no_edge() -> np.ndarray:
    """The bounds, (2, 2), of what may go anywhere."""
    return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])


def surface_bounds(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Where a body's origin may be without any of the body beyond the edge of its surface.

    Found are boxes along the world's axes that stand still right below a body with a free joint;
    planes have no edge, and of every other surface none is known.

    Args:
        model: that holds body and surface.
        data: its state with the body at rest, the kinematics run.
        body: with the free joint.

    Returns:
        lowest and highest x and y, (2, 2) metres; infinite where no edge is known.
    """
    unknown = no_edge()
    joint = int(model.body_jntadr[body])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        return unknown
    touching = np.flatnonzero(touching_geoms(model))
    of_body = model.body_rootid[model.geom_bodyid[touching]] == body
    if not of_body.any():
        return unknown
    extents = [_extent(model, data, geom) for geom in touching[of_body]]
    low = np.min([extent[0] for extent in extents], axis=0)
    high = np.max([extent[1] for extent in extents], axis=0)
    origin, highest, bounds = data.xpos[body], -np.inf, unknown
    for geom in touching[~of_body]:
        face = _face(model, data, geom)
        if face is None:
            continue
        edges, height = face
        below = ((edges[0] <= origin[:2]) & (origin[:2] <= edges[1])).all()
        if below and abs(low[2] - height) < _NEAR and height > highest:
            highest = height
            bounds = np.stack([edges[0] + (origin - low)[:2], edges[1] - (high - origin)[:2]])
    return bounds if (bounds[0] <= bounds[1]).all() else unknown


def _extent(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) of the box along the world's axes around a geom."""
    turned = data.geom_xmat[geom].reshape(3, 3)
    centre = data.geom_xpos[geom] + turned @ model.geom_aabb[geom, :3]
    half = np.abs(turned) @ model.geom_aabb[geom, 3:]
    return centre - half, centre + half


def _face(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, float] | None:
    """Edges (2, 2) and height of a level face on which things can lie; None, there is none."""
    body = int(model.geom_bodyid[geom])
    if model.body_weldid[body] != 0 or model.body_mocapid[model.body_rootid[body]] >= 0:
        return None  # it may move
    turned = np.abs(data.geom_xmat[geom].reshape(3, 3))
    if np.abs(turned.max(axis=0) - 1.0).max() > _SQUARE:
        return None
    centre, half = data.geom_xpos[geom], model.geom_size[geom]
    if model.geom_type[geom] == _GEOM.mjGEOM_PLANE and turned[2, 2] > 0.5:
        half = np.array([np.inf, np.inf, 0.0])  # its size is for pictures alone
    elif model.geom_type[geom] != _GEOM.mjGEOM_BOX:
        return None
    half = half[turned.argmax(axis=1)]  # along the world's axes
    edges = np.stack([centre[:2] - half[:2], centre[:2] + half[:2]])
    return edges, float(centre[2] + half[2])
