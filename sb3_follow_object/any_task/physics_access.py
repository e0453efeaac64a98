"""The compiled model and its state inside an environment, wherever its author put them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import gymnasium as gym

from ..envs.physics_engine import mujoco

_DEPTH = 4  # attributes of attributes that are looked through
_LIKELY = ("data", "_data", "sim")  # looked at before others


class NoSimulation(ValueError):
    """Raised for an environment that MuJoCo does not simulate, or where that is not found."""


def is_simulated(env: gym.Env) -> bool:
    """Whether an environment runs a MuJoCo simulation."""
    try:
        physics_of(env)
    except NoSimulation:
        return False
    return True


def physics_of(env: gym.Env) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return model and data of the simulation that an environment runs.

    Asked for anew after each reset, since some environments make another model then.

    Raises:
        NoSimulation: there is none of MuJoCo in it.
    """
    todo: deque[tuple[Any, int]] = deque([(env.unwrapped, 0)])
    seen: set[int] = set()
    models: list[mujoco.MjModel] = []
    while todo:
        thing, depth = todo.popleft()
        if isinstance(thing, mujoco.MjModel):
            models.append(thing)
        if isinstance(thing, mujoco.MjData):
            model = getattr(thing, "model", None)  # newer MuJoCo's data know it
            if model is None and not models:
                continue
            return model or models[0], thing
        if id(thing) in seen or depth > _DEPTH:
            continue
        seen.add(id(thing))
        todo.extend((value, depth + 1) for value in _attributes(thing))
    name = type(env.unwrapped).__name__
    raise NoSimulation(f"{name} holds no MuJoCo simulation (mujoco.MjModel and MjData)")


def placed(
    model: mujoco.MjModel, data: mujoco.MjData, into: mujoco.MjData | None = None
) -> mujoco.MjData:
    """Return a state with bodies where its joints say, as `data` may not have them yet.

    Args:
        model: compiled.
        data: a state of it, which stays as it is.
        into: is written to and returned; None makes a new one.
    """
    now = mujoco.MjData(model) if into is None else into
    now.qpos[:] = data.qpos
    now.mocap_pos[:], now.mocap_quat[:] = data.mocap_pos, data.mocap_quat
    mujoco.mj_kinematics(model, now)
    return now


def _attributes(thing: Any) -> Iterator[Any]:
    """What an object holds, likely places first; containers of plain values are not searched."""
    held = getattr(thing, "__dict__", None)
    if not isinstance(held, dict) or isinstance(thing, type):
        return
    for name in _LIKELY:
        if name in held:
            yield held[name]
    for name, value in held.items():
        if name not in _LIKELY and not callable(value):
            yield value
