"""How an action is changed to explore: Gaussian noise, and now and then any other action."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.noise import ActionNoise

from ..common.answers import check_shape


def explored(
    actions: np.ndarray, noise: float | ActionNoise, random_prob: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the actions (n_envs, action_dim) in [-1, 1] that are taken in place of the actor's.

    Args:
        actions: of the actor, in [-1, 1].
        noise: standard deviation of the Gaussian noise that is added, or what is asked for other.
        random_prob: probability of an environment's action being uniform instead.
        rng: drawn from.

    Raises:
        ValueError: the noise is of another shape.
    """
    if callable(noise):
        added = np.asarray(noise())
        added = added[None] if len(actions) == 1 and added.ndim == 1 else added
        check_shape(added, actions.shape, "action_noise")
    else:
        added = rng.normal(0.0, noise, size=actions.shape)
    taken = np.clip(actions + added, -1.0, 1.0)
    random = rng.random(len(actions)) < random_prob
    taken[random] = rng.uniform(-1.0, 1.0, size=(random.sum(), *actions.shape[1:]))
    return taken
