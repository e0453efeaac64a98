"""How an action is changed to explore: Gaussian noise, and now and then any other action."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise

from ..common.answers import check_shape


_SMOOTHING = 0.02  # weight of an episode in the running success rate


def explored(
    actions: np.ndarray,
    noise: float | ActionNoise,
    random_prob: float,
    rng: np.random.Generator,
    share: float = 1.0,
) -> np.ndarray:
    """Return the actions (n_envs, action_dim) in [-1, 1] that are taken in place of the actor's.

    Args:
        actions: of the actor, in [-1, 1].
        noise: standard deviation of the Gaussian noise that is added, or what is asked for other.
        random_prob: probability of an environment's action being uniform instead.
        rng: drawn from.
        share: of the noise and of the probability that is left, in [0, 1].

    Raises:
        ValueError: the noise is of another shape.
    """
    if callable(noise):
        added = np.asarray(noise())
        added = added[None] if len(actions) == 1 and added.ndim == 1 else added
        check_shape(added, actions.shape, "action_noise")
    else:
        added = rng.normal(0.0, noise, size=actions.shape)
    taken = np.clip(actions + share * added, -1.0, 1.0)
    random = rng.random(len(actions)) < share * random_prob
    taken[random] = rng.uniform(-1.0, 1.0, size=(random.sum(), *actions.shape[1:]))
    return taken


def running_success(rate: float, dones: np.ndarray, infos: list[dict[str, Any]]) -> float:
    """Return a running success rate after a step, of episodes that show their original goals.

    Args:
        rate: before the step, in [0, 1].
        dones: shape (n_envs,), which episodes end with it.
        infos: of the step; those without "is_success" tell nothing.
    """
    for index in np.flatnonzero(dones):
        info = infos[index]
        if "is_success" in info and not info.get("imagined_level", 0):
            rate += _SMOOTHING * (float(info["is_success"]) - rate)
    return rate
