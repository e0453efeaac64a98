"""A step of every environment, looked at before it is stored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

Arrays = Mapping[str, np.ndarray]


def check_step(
    stores: tuple[Arrays, Arrays],
    obs: Arrays,
    next_obs: Arrays,
    action: np.ndarray,
    reward: np.ndarray,
    done: np.ndarray,
    infos: list[dict[str, Any]],
    action_size: int,
) -> None:
    """Refuse a step of every environment whose arrays do not fit, or hold NaN or infinity.

    Args:
        stores: key -> (n_slots, n_envs, ...), of observations and of next observations.
        obs: key -> (n_envs, ...); whole numbers may lack the last axis, one environment the first.
        next_obs: the same one step later.
        action: (n_envs, ...), `action_size` numbers each.
        reward: (n_envs,).
        done: (n_envs,).
        infos: one of each environment.
        action_size: numbers of an action.

    Raises:
        ValueError: with what is wrong and, for numbers that are not finite, of which environment.
    """
    for stored, given, name in zip(stores, (obs, next_obs), _NAMES, strict=True):
        for key, store in stored.items():
            shape, array = store.shape[1:], np.asarray(given[key])
            if np.shape(array) != shape:
                _check_size(array, shape, f"{name} {key!r}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                _refuse(array, len(infos), f"{name} {key!r}")
    n_envs = store.shape[1]
    if np.size(action) != n_envs * action_size:
        _check_size(action, (n_envs, action_size), "the action")
    for name, array in (("the reward", reward), ("the end of the episode", done)):
        if np.shape(array) != (n_envs,):
            _check_size(array, (n_envs,), name)
    if len(infos) != n_envs:
        raise ValueError(f"there are {len(infos)} infos for {n_envs} environments")
    for name, array in (("the action", action), ("the reward", reward)):
        if not np.isfinite(array).all():
            _refuse(array, n_envs, name)
    if np.any(done):
        for i in np.flatnonzero(done):
            for key, value in (infos[i].get("terminal_observation") or {}).items():
                if key in next_obs:
                    shape = stores[1][key].shape[2:]
                    if np.shape(value) != shape:
                        _check_size(value, shape, f"the terminal observation {key!r}")


_NAMES = ("the observation", "the next observation")


def _check_size(array: Any, shape: tuple[int, ...], name: str) -> None:
    """Refuse an array that would have to be broadcast to a shape."""
    found = np.shape(array)
    if int(np.prod(found)) != int(np.prod(shape)):
        raise ValueError(f"{name} has the shape {found}, not {shape}")


def _refuse(array: Any, n_envs: int, name: str) -> None:
    """Say which environment's numbers are not finite."""
    index = int(np.flatnonzero(~np.isfinite(np.reshape(array, (n_envs, -1))).all(axis=1))[0])
    raise ValueError(f"{name} of environment {index} holds NaN or infinity")


def goes_on(stored: Arrays, pos: int, running: np.ndarray, obs: Arrays) -> np.ndarray | None:
    """Which running episodes an observation goes on with (n_envs,); None where it is all of them.

    Args:
        stored: key -> next observations (n_slots, n_envs, ...).
        pos: the slot that comes next.
        running: whether an environment's episode waits for more steps, (n_envs,).
        obs: that the environments stand at, key -> (n_envs, ...).
    """
    fits = None
    for key, store in stored.items():
        last = store[pos - 1]
        same = np.reshape(obs[key], last.shape).astype(last.dtype, copy=False) == last
        if not same.all():
            each = same.reshape(len(running), -1).all(axis=1) | ~running
            fits = each if fits is None else fits & each
    return None if fits is None or fits.all() else fits


def lost_steps(info: Mapping[str, Any], n_stored: int) -> bool:
    """Whether SB3's Monitor counted other steps in an episode that ends than were stored.

    An algorithm of SB3 whose `learn` is stopped in the middle of a step does not store it, and goes
    on from the observation before it where `reset_num_timesteps` is False: what it stores next
    never happened. A count of half as many again or more is that of a wrapper which repeats
    actions or ends episodes in parts.
    """
    n_steps = (info.get("episode") or {}).get("l")
    return n_steps is not None and n_steps != n_stored and n_steps < 1.5 * n_stored
