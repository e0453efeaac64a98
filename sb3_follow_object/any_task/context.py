"""What else episodes differ in: where things stand that the object must find its way round.

A number of a body's place is called by the body's name and the number's, such as "wall x". Those
that follow from start and goal are no context, since nu and F_phi see these.
"""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np

from ..envs.physics_engine import mujoco
from ..envs.robot_parts import body_name, rigid_group, robot_bodies, touching_geoms
from .physics_access import physics_of, placed
from .resets import Resets

# Position in metres, then the directions of the body's x and y axis.
NUMBERS = ("x", "y", "z", "xx", "xy", "xz", "yx", "yy", "yz")
_MATTERS = 1e-3  # metres, and parts of an axis of length 1


def context_of(model: mujoco.MjModel, resets: Resets, body: int) -> tuple[str, ...]:
    """Return which numbers of a scene decide, beside start and goal, what an object's way is.

    A number counts if it is not the same in all episodes, and no linear function of start, goal and
    the numbers before it: of parts that are moved together, one tells where all are.

    Args:
        model: of the robot's environment.
        resets: recorded in it, more than there are numbers.
        body: of the object.
    """
    known = np.column_stack([np.ones(len(resets)), resets.starts, resets.goals])
    names: list[str] = []
    for other in _others(model, body):
        places = resets.places[:, other]
        columns = place_numbers(places[:, :3], places[:, 3:]).T
        for number, values in zip(NUMBERS, columns, strict=True):
            weights = np.linalg.lstsq(known, values, rcond=None)[0]
            if np.abs(values - known @ weights).max() > _MATTERS:
                names.append(f"{body_name(model, other)} {number}")
                known = np.column_stack([known, values])
    return tuple(names)


def place_numbers(positions: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """Return the numbers (..., 9) of positions (..., 3) in metres with quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    first = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    second = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)
    return np.concatenate([positions, np.stack([*first, *second], axis=-1)], axis=-1)


def located(names: Sequence[str], model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the bodies and the numbers of their places that names mean in a model, (c,) int each.

    Raises:
        ValueError: there is no such body.
    """
    ids = {body_name(model, body): body for body in range(model.nbody)}
    bodies, numbers = zip(*(name.rsplit(" ", 1) for name in names), strict=True)
    missing = [name for name in bodies if name not in ids]
    if missing:
        raise ValueError(
            f"the predictor sees the place of {', '.join(bodies_in(names))}, but the environment "
            f"has no body {missing[0]!r}; give a predictor that was made for it"
        )
    return np.array([ids[name] for name in bodies]), np.array([NUMBERS.index(n) for n in numbers])


def bodies_in(names: Sequence[str]) -> list[str]:
    """Return the bodies that a context is about, each once."""
    return list(dict.fromkeys(name.rsplit(" ", 1)[0] for name in names))


def read_context(names: Sequence[str], env: gym.Env) -> np.ndarray:
    """Return the numbers (c,) of these names as they are in an environment now, whose state stays.

    Raises:
        ValueError: there is no MuJoCo simulation in it, or no such body.
    """
    if not names:
        return np.zeros(0)
    model, data = physics_of(env)
    bodies, numbers = located(names, model)
    now = placed(model, data)
    read: np.ndarray = place_numbers(now.xpos, now.xquat)[bodies, numbers]
    return read


def _others(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies that can touch anything and belong neither to the robot nor to the object."""
    touching, apart = touching_geoms(model), ~robot_bodies(model)
    apart[0] = False
    apart[rigid_group(model, body)] = False
    bodies = np.unique(model.geom_bodyid[touching])
    return [int(other) for other in bodies if apart[other]]
