"""Which episodes begin with reaching, where the effector is taken, and what it does meanwhile."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from ..any_task.tasks import effector_seen_in, steps_to_reach
from ..envs import IDS
from ..envs.goal_envs import missing_goal_keys
from ..envs.goal_space import followed_space, goal_space
from ..settings.stages import BEHIND, ReachFirstSettings, part_of_reach
from .actor import ReachActor

Observation = dict[str, np.ndarray]
STREAM = 0x5EAC  # parts the reaching's random numbers from those of the environment's own seed
AHEAD = 0.1  # metres of the object's way, whose end says where it shall go next
ABOVE, TO_PLACE, PUSH = 0, 1, 2  # legs of the effector's way


class Approach:
    """The reaching that n copies of an environment do, each in its own episode.

    The effector is taken above the place that it shall reach, then down to it, and from there on
    the learner acts. The place is the object itself or, with a `standoff`, behind the object as
    seen from where it shall go; then it goes on to the same distance behind there, and so pushes
    the object some of the way.

    Args:
        n_envs: copies.
        action_space: of each copy.
        settings: how reaching is done, the standoff in metres.

    Attributes:
        actor: what reaches; until there is one nothing does.
        share: of the episodes that begin with reaching; may be set at any time.
        counts: episodes that have ended, (2, 2): whether they began with reaching, and whether the
            effector came to the place.
    """

    def __init__(self, n_envs: int, action_space: spaces.Box, settings: ReachFirstSettings) -> None:
        self.settings = settings
        self.effector = list(settings.effector)
        self._low, self._high = action_space.low, action_space.high
        self.share = 0.0
        self.actor: ReachActor | None = None
        self.rng = np.random.default_rng()
        self.reaching = np.zeros(n_envs, dtype=bool)
        self.began = np.zeros(n_envs, dtype=bool)  # with reaching
        self.came = np.zeros(n_envs, dtype=bool)  # to the place, by reaching or by itself
        self._place = np.zeros((n_envs, 3))
        self._push = np.zeros((n_envs, 3))  # from the place on, zero where nothing is pushed
        self._leg = np.zeros(n_envs, dtype=np.int64)  # of the way: above, to the place, the push
        self._steps = np.zeros(n_envs, dtype=np.int64)
        # What the entries of actions do that reaching does not need, drawn for an episode.
        self._idle = np.zeros((n_envs, *action_space.shape))
        self.counts = np.zeros((2, 2), dtype=np.int64)

    def begin(self, rows: np.ndarray, obs: Observation, ahead: np.ndarray) -> None:
        """Start episodes.

        Args:
            rows: the copies, (m,).
            obs: of all copies.
            ahead: where each object shall go next, goals (m, 3).
        """
        chosen = self.rng.random(len(rows)) < self.share
        self._idle[rows] = self.rng.uniform(-1.0, 1.0, self._idle[rows].shape)
        self.began[rows] = self.reaching[rows] = chosen & (self.actor is not None)
        self._leg[rows] = ABOVE if self.settings.height > 0.0 else TO_PLACE
        self._steps[rows] = 0
        self.came[rows] = False
        space = goal_space(obs["achieved_goal"].shape[1:])
        place = np.array(space.point(obs["achieved_goal"][rows]), dtype=np.float64)
        if self.settings.standoff > 0.0:
            way = space.point(ahead) - place
            way[:, 2] = 0.0
            length = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
            place -= self.settings.standoff * way / length
            self._push[rows] = way * np.minimum(1.0, AHEAD / length)
        self._place[rows] = place

    def act(self, obs: Observation, actions: np.ndarray) -> np.ndarray:
        """Return what is executed in place of the actions given, both (n, action_dim)."""
        rows = np.flatnonzero(self.reaching)
        if not rows.size:
            return actions
        assert self.actor is not None
        actions = np.array(actions)
        place = self._target()[rows]
        chosen = self.actor(obs["observation"][rows].astype(np.float32), place.astype(np.float32))
        idle = self.actor.idle
        chosen[:, idle] = self._idle[rows][:, idle]
        chosen += self.rng.normal(0.0, self.settings.noise, chosen.shape)
        share = 0.5 * (np.clip(chosen, -1.0, 1.0) + 1.0)  # of the way from low to high
        actions[rows] = self._low + share * (self._high - self._low)
        return actions

    def arrive(self, obs: Observation, dones: np.ndarray) -> None:
        """Take in where a step has led to; `obs` holds the last ones of ended episodes."""
        effector = obs["observation"][:, self.effector]
        tolerance = self.settings.tolerance
        self.came |= np.linalg.norm(effector - self._place, axis=1) <= tolerance
        self._steps += 1
        near = np.linalg.norm(effector - self._target(), axis=1) <= tolerance
        last = PUSH if self.settings.standoff > 0.0 else TO_PLACE
        arrived = near & (self._leg == last)
        # Not every effector gets so high: after half of its steps it goes for the place itself.
        late = (self._leg == ABOVE) & (2 * self._steps >= self.settings.max_steps)
        self._leg += (near & ~arrived) | late
        self.reaching &= ~arrived & (self._steps < self.settings.max_steps)
        self.count(dones)

    def count(self, ended: np.ndarray) -> None:
        """Count episodes that have ended, a mask (n,) of the copies."""
        np.add.at(self.counts, (self.began[ended].astype(int), self.came[ended].astype(int)), 1)

    def _target(self) -> np.ndarray:
        target = self._place.copy()
        target[:, 2] += self.settings.height * (self._leg == ABOVE)
        return target + self._push * (self._leg == PUSH)[:, None]

    def take_counts(self) -> np.ndarray:
        """Return `counts` since the last call."""
        counts, self.counts = self.counts, np.zeros((2, 2), dtype=np.int64)
        return counts

    _ARRAYS = ("reaching", "began", "came", "_place", "_push", "_leg", "_steps", "_idle", "counts")

    def state_dict(self) -> dict[str, Any]:
        """Return everything that running and coming episodes depend on; the actor comes apart."""
        return {
            "rng": copy.deepcopy(self.rng.bit_generator.state),
            "share": float(self.share),
            **{name: getattr(self, name).copy() for name in self._ARRAYS},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict` of as many copies.

        Raises:
            ValueError: it is of others.
        """
        n, ours = len(state["reaching"]), len(self.reaching)
        if n != ours:
            raise ValueError(f"the saved reaching is of {n} environments, and there are {ours}")
        self.rng.bit_generator.state = state["rng"]
        self.share = float(state["share"])
        for name in self._ARRAYS:
            current = getattr(self, name)
            setattr(self, name, np.asarray(state[name]).astype(current.dtype))


def reach_first_settings(
    given: dict[str, Any], who: str, spec: EnvSpec | None
) -> ReachFirstSettings:
    """Return a wrapper's settings, the standoff in metres.

    In a task of others effector and steps are those that are found in it, unless they are given;
    where there is no MuJoCo simulation to look at, the effector is the observation's beginning.

    Args:
        given: to the wrapper, by their names.
        who: beginning of the sentence about what is invalid.
        spec: of the environment, which says whether its objects are pushed; None says no.

    Raises:
        ValueError: an invalid setting, or no part of the robot is told.
    """
    if spec is not None and spec.id not in IDS and spec.id in gym.registry:
        given = {"max_steps": steps_to_reach(spec.id), **given}
        if "effector" not in given:
            effector = effector_seen_in(spec.id)
            if effector is not None:
                given["effector"] = effector
    settings = ReachFirstSettings(**part_of_reach(ReachFirstSettings, given, who))
    if settings.standoff != "auto":
        return settings
    pushed = spec is not None and spec.id in IDS and IDS[spec.id][0].blocked_gripper
    return replace(settings, standoff=BEHIND if pushed else 0.0)


def check_reachable(
    space: spaces.Space, actions: spaces.Space, settings: ReachFirstSettings
) -> None:
    """Raise a ValueError for an environment in which an effector cannot reach for an object."""
    if not isinstance(actions, spaces.Box):
        raise ValueError(
            f"Reaching first needs actions in a Box; this environment's are {actions}."
        )
    missing = missing_goal_keys(space)
    if missing:
        raise ValueError(
            f"Reaching first needs Dict goal observations; this environment lacks {missing}."
        )
    keys = cast(spaces.Dict, space)
    followed_space(keys["achieved_goal"].shape)
    check_effector(list(settings.effector), keys["observation"])


def check_effector(effector: list[int], observation: spaces.Space) -> None:
    """Raise a ValueError unless a vector has an entry at each of the effector's indices."""
    shape = observation.shape
    if shape is None or len(shape) != 1 or max(effector) >= shape[0]:
        raise ValueError(
            f"reach: effector is {effector}; the environment's observation, of shape {shape}, must "
            "hold the effector's position there"
        )
