"""Running moments of a replay buffer's content, by which inputs are standardised."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd

from ..common.mirrors import Mirror

# Floor of the standard deviations, so that entries that hardly vary are not blown up.
MIN_STD = 0.01


class InputMoments(RunningMeanStd):
    """Mean and variance of "observation" and goal, as everything stored so far has them.

    Args:
        n_features: numbers of an observation and a goal together.
    """

    def __init__(self, n_features: int) -> None:
        super().__init__(shape=(n_features,))
        self._pos = 0  # the buffer's, where what has not been taken in yet begins
        self._added = 0  # time-steps that it had been given then, overwritten ones included

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (n_features,), none too small to divide by."""
        return np.sqrt(self.var).clip(min=MIN_STD)

    def take(self, buffer: ReplayBuffer, mirrors: Sequence[Mirror] = ()) -> bool:
        """Take in what was stored since the last call; goals count as shown and as achieved.

        Args:
            buffer: of the algorithm.
            mirrors: over which the networks' inputs are folded.

        Returns:
            Whether there was anything.
        """
        added = getattr(buffer, "n_added", 0)
        overwritten = added - self._added >= buffer.buffer_size
        new = (buffer.pos - self._pos) % buffer.buffer_size
        new = buffer.buffer_size if overwritten else new
        self._pos, self._added = buffer.pos, added
        if new == 0:
            return False
        with np.errstate(under="ignore"):
            self._take_rows(buffer, new, mirrors)
        return True

    def _take_rows(self, buffer: ReplayBuffer, new: int, mirrors: Sequence[Mirror]) -> None:
        """Take in the last `new` time-steps."""
        rows = (buffer.pos - new + np.arange(new)) % buffer.buffer_size
        obs = buffer.observations["observation"][rows].reshape(new * buffer.n_envs, -1)
        for key in ("desired_goal", "achieved_goal"):
            goals = buffer.next_observations[key][rows].reshape(len(obs), -1)
            inputs = obs
            for mirror in mirrors:
                low = (goals[:, mirror.axis] < mirror.at)[:, None]
                inputs = np.where(low, mirror.observation(inputs), inputs)
                goals = np.where(low, mirror.goal(goals), goals)
            self.update(np.concatenate([inputs, goals], axis=1).astype(np.float64))

    def begin_anew(self, buffer: ReplayBuffer) -> None:
        """Take in from now on what an empty buffer is given, in addition to what has been."""
        self._pos, self._added = 0, getattr(buffer, "n_added", 0)

    def buffer_was_loaded(self, buffer: ReplayBuffer) -> None:
        """Go on with a buffer that was loaded: its content is new only where nothing else was."""
        new = 0 if self.count >= 1.0 else buffer.size()
        self._pos = (buffer.pos - new) % buffer.buffer_size
        self._added = getattr(buffer, "n_added", 0) - new

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training needs."""
        return {"mean": self.mean, "var": self.var, "count": float(self.count), "pos": self._pos}

    def load_state_dict(self, state: dict[str, Any], buffer: ReplayBuffer) -> None:
        """Continue from `state_dict`; the buffer may be given its content afterwards."""
        self.mean, self.var = state["mean"].copy(), state["var"].copy()
        self.count, self._pos = state["count"], state["pos"]
        self._added = getattr(buffer, "n_added", 0)
