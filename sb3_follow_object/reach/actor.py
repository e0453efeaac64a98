"""The reach policy as environments play it."""

from __future__ import annotations

import numpy as np


class ReachActor:
    """The reach policy's network in NumPy: small, copied and sent between processes as it is.

    Attributes:
        idle: (action_dim,) bool, entries of actions that reaching does not need.
    """

    def __init__(
        self,
        layers: list[tuple[np.ndarray, np.ndarray]],
        mean: np.ndarray,
        std: np.ndarray,
        clip: float,
        idle: np.ndarray,
    ) -> None:
        self.layers = layers
        self.mean, self.std, self.clip = mean, std, clip
        self.idle = idle

    def __call__(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return actions (n, action_dim) in [-1, 1] for observations (n, d) and places (n, 3)."""
        x = (np.concatenate([observation, goal], axis=1) - self.mean) / self.std
        x = np.clip(x, -self.clip, self.clip)
        *hidden, (weight, bias) = self.layers
        for w, b in hidden:
            x = np.maximum(x @ w + b, 0.0)
        return np.tanh(x @ weight + bias)
