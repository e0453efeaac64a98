"""What of a robot touches the object: the ends of what hangs last on it."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import gymnasium as gym
import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import carrier, robot_bodies, touching_geoms
from .physics_access import physics_of, placed


def fingertips(env: gym.Env) -> np.ndarray:
    """The middle of a robot's fingertips, (3,) metres, read from its simulation.

    For `effector=`, where an environment's observation does not hold it. Fingertips are the ends of
    what has the most joints above it: of two fingers that move both, of one that moves its own.

    Args:
        env: runs a MuJoCo simulation with a robot, which is what actuators drive.

    Raises:
        ValueError: there is no simulation, or no robot in it.
    """
    model, data = physics_of(env)
    known = _KNOWN.get(env)
    if known is None or known[0] is not model:  # some environments make another at a reset
        known = _KNOWN[env] = model, Fingertips(model), mujoco.MjData(model)
    _, tips, scratch = known
    now = placed(model, data, scratch)
    return tips.middle(now.xpos, now.xmat.reshape(-1, 3, 3))


_Known = tuple[mujoco.MjModel, "Fingertips", mujoco.MjData]
_KNOWN: WeakKeyDictionary[gym.Env, _Known] = WeakKeyDictionary()


class Fingertips:
    """The ends of the geoms on the bodies that have the most joints above them in a robot.

    Args:
        model: compiled.

    Raises:
        ValueError: nothing in it is driven by an actuator.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        robot = robot_bodies(model)
        if not robot.any():
            raise ValueError("the scene has no robot: no actuator drives anything in it")
        depth = np.zeros(model.nbody, dtype=int)
        for body in range(1, model.nbody):  # parents come before their children
            depth[body] = depth[model.body_parentid[body]] + int(model.body_jntnum[body] > 0)
        geoms = np.flatnonzero(robot[model.geom_bodyid])
        touching = geoms[touching_geoms(model)[geoms]]
        geoms = touching if touching.size else geoms
        if geoms.size:
            of_geoms = depth[model.geom_bodyid[geoms]]
            last = geoms[of_geoms == of_geoms.max()]
            at_rest = mujoco.MjData(model)  # all joints where the model was drawn
            mujoco.mj_kinematics(model, at_rest)
            self._bodies = model.geom_bodyid[last].astype(int)
            self._ends = np.array([_far_end(model, at_rest, int(geom)) for geom in last])
        else:
            self._bodies = np.flatnonzero(robot & (depth == depth[robot].max()))
            self._ends = np.zeros((len(self._bodies), 3))

    def middle(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return their middle (..., 3), where bodies are at (..., nbody, 3), (..., nbody, 3, 3)."""
        turned = np.einsum("...bij,bj->...bi", rotations[..., self._bodies, :, :], self._ends)
        middle: np.ndarray = (positions[..., self._bodies, :] + turned).mean(axis=-2)
        return middle


def _far_end(model: mujoco.MjModel, at_rest: mujoco.MjData, geom: int) -> np.ndarray:
    """The end of a geom's longest side that is farther from the joint before its body's, (3,).

    In the frame of its body.
    """
    body = int(model.geom_bodyid[geom])
    before = carrier(model, int(model.body_parentid[carrier(model, body)]))
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.geom_quat[geom])
    centre, half = np.split(model.geom_aabb[geom], 2)
    long = np.where(np.arange(3) == half.argmax(), half, 0.0)
    ends = model.geom_pos[geom] + (centre + np.stack([long, -long])) @ frame.reshape(3, 3).T
    there = at_rest.xpos[body] + ends @ at_rest.xmat[body].reshape(3, 3).T
    far: np.ndarray = ends[np.linalg.norm(there - at_rest.xpos[before], axis=1).argmax()]
    return far
