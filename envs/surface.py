"""How far an object may go that stays on the surface it lies on (section 4.1)."""

from __future__ import annotations

from itertools import product

import numpy as np

from .physics_engine import mujoco
from .robot_parts import touching_geoms

_NEAR = 0.01  # metres between an object and the surface that it lies on
_GAP = 1e-3  # metres between faces that a body does not go over
_SQUARE = 1e-3  # how far off the world's axes a box may be turned
_GEOM = mujoco.mjtGeom


def no_edge() -> np.ndarray:
    """The bounds, (2, 2), of what may go anywhere."""
    return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])


def surface_bounds(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Where a body's origin may be while the body lies on its surface, however it is turned.

    The origin keeps as far from the edge as the body is narrow: what is long may hang over, what
    weighs down does not. Found are boxes along the world's axes that stand still right below a body
    with a free joint; planes have no edge, and of every other surface none is known, nor of one
    that goes on in another as high.

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
    corners = np.concatenate([_corners(model, data, geom) for geom in touching[of_body]])
    origin, lowest = data.xpos[body], corners[:, 2].min()
    faces = [face for geom in touching[~of_body] if (face := _face(model, data, geom)) is not None]
    near = [edges for edges, height in faces if abs(lowest - height) < _NEAR]
    for edges in near:
        below = ((edges[0] <= origin[:2]) & (origin[:2] <= edges[1])).all()
        if below and all(_holds(edges, other) or _apart(edges, other) for other in near):
            narrow = _narrowest(corners[:, :2] - origin[:2])
            bounds = edges + np.array([[narrow], [-narrow]])
            return bounds if (bounds[0] <= bounds[1]).all() else unknown
    return unknown


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Corners (8, 3) of the box along a geom's own axes that is around it."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    corners = centre + half * np.array(list(product((-1.0, 1.0), repeat=3)))
    placed: np.ndarray = data.geom_xpos[geom] + corners @ data.geom_xmat[geom].reshape(3, 3).T
    return placed


def _narrowest(points: np.ndarray) -> float:
    """How far points (n, 2) reach beside 0 in the direction in which they reach least far."""
    turns = np.radians(np.arange(0.0, 360.0, 2.0))
    farthest = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ points.T
    points = points[np.unique(farthest.argmax(axis=1))]  # of the hull alone, as pairs are many
    sides = (points[:, None] - points).reshape(-1, 2)
    length = np.linalg.norm(sides, axis=1)
    ahead = sides[length > 0.0] / length[length > 0.0, None]
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)  # among them the hull's normals
    return max(0.0, float((across @ points.T).max(axis=1).min()))


def _holds(edges: np.ndarray, other: np.ndarray) -> bool:
    """Whether a face (2, 2) is all of another, or more."""
    return bool((edges[0] <= other[0]).all() and (other[1] <= edges[1]).all())


def _apart(edges: np.ndarray, other: np.ndarray) -> bool:
    """Whether there is a gap between two faces (2, 2)."""
    return bool((edges[1] + _GAP < other[0]).any() or (other[1] + _GAP < edges[0]).any())


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
