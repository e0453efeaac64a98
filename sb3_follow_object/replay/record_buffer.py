"""SB3's replay buffer with the fields of a transition side by side in memory."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from ..common.copies import WholeCopies
from .records import Records
from .steps import fitted, refuse_infinite, same_bytes

HALVES = ("observations", "next_observations")
DESIRED, NEXT_DESIRED = "observations.desired_goal", "next_observations.desired_goal"
ACHIEVED = "next_observations.achieved_goal"
# What sentences call them.
_SAID = {"observations": "the observation", "next_observations": "the next observation"}
_SAID |= {"actions": "the action", "rewards": "the reward", "dones": "the end of the episode"}


@dataclass
class Gathered:
    """Copies of n stored transitions; the arrays may be views of one another.

    Attributes:
        observations, next_observations: key -> (n, ...).
        actions: (n, action_dim).
        rewards: (n,).
        dones: (n,), 1 where the episode terminated, 0 where it went on or was truncated.
    """

    observations: dict[str, np.ndarray]
    next_observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray

    def desired_goals(self) -> list[np.ndarray]:
        """Return the desired goals of both, once where they are the same array."""
        here, there = (o["desired_goal"] for o in (self.observations, self.next_observations))
        return [here] if there is here else [here, there]

    def pick(self, rows: np.ndarray) -> Gathered:
        """Return some of them, in this order."""
        return Gathered(
            {key: value[rows] for key, value in self.observations.items()},
            {key: value[rows] for key, value in self.next_observations.items()},
            self.actions[rows],
            self.rewards[rows],
            self.dones[rows],
        )


class RecordReplayBuffer(WholeCopies, HerReplayBuffer):
    """HerReplayBuffer whose arrays are views of float32 records; see `Records`.

    Physics in float64 is needed while stepping, not while learning. Images and what is not float
    stay in arrays of their own. Achieved goals are read twice, with a transition and as hindsight
    goals, so those of next observations are records by themselves: they fit into the cache. The
    desired goals of next observations are stored apart only once they differ from the others.

    The arguments are HerReplayBuffer's.
    """

    # Goals of the step to come (n_envs, d), where an episode goes on to another than is stored.
    _goals_ahead: np.ndarray | None = None

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        fields: dict[str, tuple[int, ...]] = {}
        for half in HALVES:
            store = getattr(self, half)
            for key, array in store.items():
                if array.dtype == np.float64:
                    store[key] = np.zeros(array.shape, dtype=np.float32)
                if store[key].dtype == np.float32 and array.ndim == 3:
                    fields[f"{half}.{key}"] = array.shape[2:]
        if self.actions.dtype == np.float32:
            fields["actions"] = self.actions.shape[2:]
        fields |= {"rewards": (), "dones": (), "timeouts": ()}
        self.goals_are_shared = fields.pop(NEXT_DESIRED, None) is not None
        goal = fields.pop(ACHIEVED, None)
        self.records = Records(self.buffer_size, self.n_envs, fields)
        # Three coordinates and an empty place are read in half the time of three.
        self.achieved = (
            None
            if goal is None
            else Records(self.buffer_size, self.n_envs, {ACHIEVED: goal}, block=4, spare=0.34)
        )
        for name in ("ep_start", "ep_length"):  # half of SB3's bytes
            setattr(self, name, np.zeros((self.buffer_size, self.n_envs), dtype=np.int32))
        self._connect()

    def _views(self) -> dict[str, np.ndarray]:
        """Every array of SB3's that is a view, by its name."""
        views = self.records.views()
        if self.achieved is not None:
            views |= self.achieved.views()
        if self.goals_are_shared:
            views[NEXT_DESIRED] = views[DESIRED]
        return views

    def _connect(self) -> None:
        """Let SB3's arrays be views of the records."""
        for name, view in self._views().items():
            half, _, key = name.partition(".")
            if key:
                getattr(self, half)[key] = view
            else:
                setattr(self, name, view)
        self._find_checked()

    def _find_checked(self) -> None:
        """Note the arrays that a step's numbers are in, where they can be NaN or infinite."""
        stores = RecordReplayBuffer._stores(self).values()
        self._checked = [store for store in stores if store.dtype.kind == "f"]

    def reset(self) -> None:
        """Forget all steps: the arrays are as in a new buffer."""
        used = self.size()
        if self._can_share_goals():
            self._share_goals(True)
        for store in self._stores().values():
            store[:used] = 0
        for at in np.ndindex(self.infos[:used].shape):
            self.infos[at] = {}
        self._current_ep_start[:] = 0
        self._goals_ahead = None
        super().reset()

    def _can_share_goals(self) -> bool:
        """Whether desired goals are in the records, so that those of next ones need no array."""
        return DESIRED in self.records.views()

    def _share_goals(self, shared: bool) -> None:
        """Store desired goals of observations and next observations once, or twice."""
        self.goals_are_shared = shared
        goals = self.observations["desired_goal"]
        self.next_observations["desired_goal"] = goals if shared else goals.copy()
        self._find_checked()

    def _write(
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Write a step of every environment into the slot at `pos`, which stays where it is.

        Raises:
            ValueError: an array does not fit, or holds NaN or infinity.
        """
        pos = self.pos
        if self.goals_are_shared:
            goals, later = obs["desired_goal"], next_obs["desired_goal"]
            if later is not goals and not same_bytes(later, goals) and (later != goals).any():
                self._share_goals(False)  # stored twice from now on
        for half, given in zip(HALVES, (obs, next_obs), strict=True):
            for key, store in getattr(self, half).items():
                slot, array = store[pos], given[key]
                if np.shape(array) != slot.shape:
                    array = fitted(array, slot.shape, f"{_SAID[half]} {key!r}")
                slot[...] = array
        for name, array in (("actions", action), ("rewards", reward), ("dones", done)):
            slot = getattr(self, name)[pos]
            if np.shape(array) != slot.shape:
                array = fitted(array, slot.shape, _SAID[name])
            slot[...] = array
        if len(infos) != self.n_envs:
            raise ValueError(f"there are {len(infos)} infos for {self.n_envs} environments")
        for env_idx in self.dones[pos].nonzero()[0]:
            for key, value in (infos[env_idx].get("terminal_observation") or {}).items():
                if key in self.observations:
                    shape = self.observations[key].shape[2:]
                    fitted(value, shape, f"the terminal observation {key!r}")
        if self.handle_timeout_termination:
            self.timeouts[pos] = [info.get("TimeLimit.truncated", False) for info in infos]
        if not all(np.isfinite(store[pos]).all() for store in self._checked):
            refuse_infinite(self._slot(pos))

    def _slot(self, pos: int) -> dict[str, np.ndarray]:
        """What a slot holds, by what a sentence calls it."""
        named = {
            f"{_SAID[half]} {key!r}": store[pos]
            for half in HALVES
            for key, store in getattr(self, half).items()
        }
        return named | {_SAID[name]: getattr(self, name)[pos] for name in ("actions", "rewards")}

    def _broken_off(self, running: np.ndarray) -> np.ndarray:
        """Environments (m,) whose step at `pos` does not begin where their last one ended.

        Args:
            running: whose episode waits for more steps, (n_envs,) bool; no other is broken off.
        """
        pos, broken = self.pos, np.zeros(0, dtype=bool)
        for key, store in self.observations.items():
            here, before = store[pos], self.next_observations[key][pos - 1]
            if key == "desired_goal" and self._goals_ahead is not None:
                before = self._goals_ahead
            if not same_bytes(here, before):
                differs = (here != before).reshape(self.n_envs, -1).any(axis=1) & running
                broken = broken | differs if len(broken) else differs
        return broken.nonzero()[0]

    def bytes_per_transition(self) -> float:
        """Bytes of arrays that a stored transition takes."""
        n_bytes = sum(store.nbytes for store in self._stores().values())
        return n_bytes / (self.buffer_size * self.n_envs)

    def _stores(self) -> dict[str, np.ndarray]:
        """Every array with one entry a slot, none of them a view of another."""
        stores = {"records": self.records.array}
        if self.achieved is not None:
            stores["achieved"] = self.achieved.array
        views = self._views()
        for half in HALVES:
            for key, array in getattr(self, half).items():
                stores[f"{half}.{key}"] = array
        for name in ("actions", "ep_start", "ep_length"):
            stores[name] = getattr(self, name)
        return {name: store for name, store in stores.items() if name not in views}

    def _check_content(self, state: Mapping[str, Any]) -> None:
        """Raise a ValueError unless a saved content fits: "pos", "full", "slots", "buffer_size"."""
        slots, full = state["slots"], state["full"]
        shapes = {name: store.shape[1:] for name, store in self._stores().items()}
        if self._can_share_goals():
            shapes.pop(NEXT_DESIRED, None)
            if NEXT_DESIRED in slots:
                shapes[NEXT_DESIRED] = self.observations["desired_goal"].shape[1:]
        if {name: slot.shape[1:] for name, slot in slots.items()} != shapes:
            raise ValueError("the saved replay buffer has another shape than this one")
        used = len(slots["records"])
        # Older states do not tell their size: a full one's is `used`, another's is more than that.
        size = state.get("buffer_size", used if full else max(used + 1, self.buffer_size))
        if size != self.buffer_size:
            raise ValueError(
                f"the saved replay buffer needs room for {size} steps of each environment, and "
                f"this one has room for {self.buffer_size}: give it the saved one's buffer_size"
            )
        if any(len(slot) != (size if full else state["pos"]) for slot in slots.values()):
            raise ValueError("the saved replay buffer holds another number of steps than it says")

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        views = self._views()
        for half in HALVES:
            state[half] = {
                key: None if f"{half}.{key}" in views else array
                for key, array in state[half].items()
            }
        del state["_checked"]
        return {name: value for name, value in state.items() if name not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._connect()

    def __deepcopy__(self, memo: dict[int, Any]) -> RecordReplayBuffer:
        twin = memo[id(self)] = type(self).__new__(type(self))
        twin.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        twin.env = copy.deepcopy(self.env, memo)  # only pickles leave it out, as SB3's do
        return twin

    def _gather(self, flat: np.ndarray, achieved: np.ndarray) -> Gathered:
        """Copy the transitions with indices slot * n_envs + environment (n,).

        What they achieved has been copied already by `_achieved_goals`.
        """
        batch = self.records.fields(self.records.take(flat))
        batch[ACHIEVED] = self._goals_in(achieved)
        if self.goals_are_shared:
            batch[NEXT_DESIRED] = batch[DESIRED]

        def field(name: str, store: np.ndarray) -> np.ndarray:
            return batch[name] if name in batch else self._take(store, flat)

        obs, next_obs = (
            {key: field(f"{half}.{key}", store) for key, store in getattr(self, half).items()}
            for half in HALVES
        )
        return Gathered(
            obs,
            next_obs,
            field("actions", self.actions),
            batch["rewards"].copy(),
            batch["dones"] * (1.0 - batch["timeouts"]),
        )

    def _achieved_goals(self, flat: np.ndarray) -> np.ndarray:
        """Copies of what the transitions achieved: (n, d), or longer rows that begin with it.

        `_goals_in` cuts them. Before that, `take` picks some of them in a tenth of the time.
        """
        if self.achieved is None:
            return self._take(self.next_observations["achieved_goal"], flat)
        return self.achieved.take(flat)

    def _goals_in(self, achieved: np.ndarray) -> np.ndarray:
        """The goals (n, d) that rows of `_achieved_goals` begin with."""
        return achieved if self.achieved is None else self.achieved.fields(achieved)[ACHIEVED]

    def _take(self, store: np.ndarray, flat: np.ndarray) -> np.ndarray:
        """Copy of the (slot, environment) entries with the given flat indices."""
        return store.reshape(self.buffer_size * self.n_envs, *store.shape[2:]).take(flat, axis=0)
