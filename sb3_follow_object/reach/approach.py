"""Which episodes begin with reaching, where the effector is taken, and what it does meanwhile."""

from __future__ import annotations

import copy
from typing import Any, cast

import numpy as np
from gymnasium import spaces

from ..envs.goal_envs import missing_goal_keys
from ..settings.stages import ReachSettings
from .actor import ReachActor

Observation = dict[str, np.ndarray]
STREAM = 0x5EAC  # parts the reaching's random numbers from those of the environment's own seed
AHEAD = 0.1  # metres of the object's way, whose end says where it shall go next


class Approach:
    """The reaching that n copies of an environment do, each in its own episode.

    The effector is taken above the place that it shall reach, then down to it, and from there on
    the learner acts. The place is the object itself or, with a `standoff`, behind the object as
    seen from where it shall go.

    Args:
        n_envs: copies.
        settings: how reaching is done.

    Attributes:
        actor: what reaches; until there is one nothing does.
        share: of the episodes that begin with reaching; may be set at any time.
    """

    def __init__(self, n_envs: int, settings: ReachSettings) -> None:
        self.settings = settings
        self.effector = list(settings.effector)
        self.share = settings.share
        self.actor: ReachActor | None = None
        self.rng = np.random.default_rng()
        self.reaching = np.zeros(n_envs, dtype=bool)
        self.began = np.zeros(n_envs, dtype=bool)  # with reaching
        self.came = np.zeros(n_envs, dtype=bool)  # to the place, by reaching or by itself
        self._place = np.zeros((n_envs, 3))
        self._above = np.zeros(n_envs, dtype=bool)
        self._steps = np.zeros(n_envs, dtype=np.int64)
        self._idle = np.zeros((n_envs, 1))
        # Episodes that ended since `take_counts`: begun with reaching, those of them that came to
        # the place; others, and those of them that came.
        self.counts = np.zeros(4, dtype=np.int64)

    def begin(self, rows: np.ndarray, obs: Observation, ahead: np.ndarray) -> None:
        """Start episodes.

        Args:
            rows: the copies, (m,).
            obs: of all copies.
            ahead: where each object shall go next, (m, 3) metres.
        """
        chosen = self.rng.random(len(rows)) < self.share
        idle = self.rng.uniform(-1.0, 1.0, len(rows))
        self.began[rows] = self.reaching[rows] = chosen & (self.actor is not None)
        self._idle[rows, 0] = idle
        self._above[rows] = self.settings.height > 0.0
        self._steps[rows] = 0
        self.came[rows] = False
        place = np.array(obs["achieved_goal"][rows], dtype=np.float64)
        if self.settings.standoff > 0.0:
            way = ahead - place
            way[:, 2] = 0.0
            length = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
            place -= self.settings.standoff * way / length
        self._place[rows] = place

    def act(self, obs: Observation, actions: np.ndarray) -> np.ndarray:
        """Return the actions (n, action_dim) in [-1, 1] that are executed in place of others."""
        rows = np.flatnonzero(self.reaching)
        if not rows.size:
            return actions
        assert self.actor is not None
        actions = np.array(actions)
        place = self._target()[rows]
        chosen = self.actor(obs["observation"][rows].astype(np.float32), place.astype(np.float32))
        chosen[:, self.actor.idle] = self._idle[rows]
        chosen += self.rng.normal(0.0, self.settings.noise, chosen.shape)
        actions[rows] = np.clip(chosen, -1.0, 1.0)
        return actions

    def arrive(self, obs: Observation, dones: np.ndarray) -> None:
        """Take in where a step has led to; `obs` holds the last ones of ended episodes."""
        effector = obs["observation"][:, self.effector]
        tolerance = self.settings.tolerance
        self.came |= np.linalg.norm(effector - self._place, axis=1) <= tolerance
        self._steps += 1
        near = np.linalg.norm(effector - self._target(), axis=1) <= tolerance
        arrived = near & ~self._above
        self._above &= ~near
        self.reaching &= ~arrived & (self._steps < self.settings.max_steps)
        self.counts[0] += (dones & self.began).sum()
        self.counts[1] += (dones & self.began & self.came).sum()
        self.counts[2] += (dones & ~self.began).sum()
        self.counts[3] += (dones & ~self.began & self.came).sum()

    def _target(self) -> np.ndarray:
        target = self._place.copy()
        target[:, 2] += self.settings.height * self._above
        return target

    def take_counts(self) -> np.ndarray:
        """Return what `counts` has had since the last call."""
        counts, self.counts = self.counts, np.zeros(4, dtype=np.int64)
        return counts

    _ARRAYS = ("reaching", "began", "came", "_place", "_above", "_steps", "_idle", "counts")

    def state_dict(self) -> dict[str, Any]:
        """Return everything that running and coming episodes depend on; the actor comes apart."""
        return {
            "rng": copy.deepcopy(self.rng.bit_generator.state),
            "share": float(self.share),
            **{name: getattr(self, name).copy() for name in self._ARRAYS},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.rng.bit_generator.state = state["rng"]
        self.share = float(state["share"])
        for name in self._ARRAYS:
            current = getattr(self, name)
            setattr(self, name, np.asarray(state[name]).astype(current.dtype))


def check_reachable(space: spaces.Space, settings: ReachSettings) -> None:
    """Raise a ValueError for an environment in which an effector cannot reach for an object."""
    missing = missing_goal_keys(space)
    if missing:
        raise ValueError(
            f"Reaching first needs Dict goal observations; this environment lacks {missing}."
        )
    keys = cast(spaces.Dict, space)
    if keys["achieved_goal"].shape != (3,):
        raise ValueError(
            "Reaching first needs goals that are object positions of shape (3,); this "
            f"environment's have the shape {keys['achieved_goal'].shape}."
        )
    check_effector(list(settings.effector), keys["observation"])


def check_effector(effector: list[int], observation: spaces.Space) -> None:
    """Raise a ValueError unless a vector has an entry at each of the effector's indices."""
    shape = observation.shape
    if shape is None or len(shape) != 1 or max(effector) >= shape[0]:
        raise ValueError(
            f"reach: effector is {effector}; the environment's observation, of shape {shape}, must "
            "hold the effector's position there"
        )
