"""The finished episodes of a replay buffer, and drawing from them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..common.copies import WholeCopies

_BUCKETS = 2  # for each episode: most points then need no search, and the guide is small


class EpisodeTable(WholeCopies):
    """The finished episodes of the buffer: where each starts and how long it is.

    Sampling draws from this table, never from the slots, and finds the episode of a drawn number by
    looking it up in equal buckets, so its cost hardly depends on how many episodes there are.
    """

    def __init__(self) -> None:
        # Start, environment, length and nothing: what is read together lies together.
        self.facts = np.zeros((64, 4), dtype=np.int32)
        self.priority = np.zeros(64)  # 0: drawn with all episodes only
        self._free = list(range(63, -1, -1))
        self._row_of: dict[tuple[int, int], int] = {}
        self._draw_lists: dict[bool, _DrawList] = {}

    @property
    def start(self) -> np.ndarray:
        """First slot of each row's episode."""
        return self.facts[:, 0]

    @property
    def env(self) -> np.ndarray:
        """Environment of each row's episode."""
        return self.facts[:, 1]

    @property
    def length(self) -> np.ndarray:
        """Steps of each row's episode, 0 where the row holds none."""
        return self.facts[:, 2]

    def insert(self, start: int, env: int, length: int, priority: float) -> int:
        """Add an episode and return its row."""
        if not self._free:
            n = len(self.facts)
            self.facts = np.concatenate([self.facts, np.zeros_like(self.facts)])
            self.priority = np.concatenate([self.priority, np.zeros_like(self.priority)])
            self._free = list(range(2 * n - 1, n - 1, -1))
        row = self._free.pop()
        self.facts[row, :3] = start, env, length
        self.priority[row] = priority
        self._row_of[start, env] = row
        self._draw_lists.clear()
        return row

    def row_of(self, start: int, env: int) -> int:
        """Row of the episode of an environment that starts in a slot."""
        return self._row_of[start, env]

    def remove(self, row: int) -> None:
        """Forget the episode in `row`."""
        del self._row_of[int(self.start[row]), int(self.env[row])]
        self.facts[row, 2] = 0
        self._free.append(row)
        self._draw_lists.clear()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next draws depend on."""
        return {"facts": self.facts, "priority": self.priority, "free": self._free}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.facts, self.priority = state["facts"].copy(), state["priority"].copy()
        self._free = list(state["free"])
        self._row_of = {
            (start, env): row
            for row, (start, env, length, _) in enumerate(self.facts.tolist())
            if length
        }
        self._draw_lists.clear()

    def draw_list(self, by_priority: bool = False) -> _DrawList:
        """All episodes, or those with a priority, as `draw` draws from them."""
        if by_priority not in self._draw_lists:
            length = self.length.astype(np.float64)
            weight = length * self.priority if by_priority else length
            rows = np.flatnonzero(weight > 0)
            ends = np.cumsum(weight[rows])
            self._draw_lists[by_priority] = _DrawList(rows, ends, self.length[rows])
        return self._draw_lists[by_priority]

    def n_transitions(self, with_priority: bool = False) -> int:
        """Transitions in finished episodes, or in those with a priority."""
        return self.draw_list(with_priority).n_transitions

    def draw(
        self, n: int, rng: np.random.Generator, by_priority: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw n transitions: rows of the table (n,) and steps within them (n,).

        Uniformly over transitions, or episodes in proportion to length times priority.
        """
        episodes = self.draw_list(by_priority)
        row = episodes.at(rng.random(n) * episodes.ends[-1])
        if episodes.same_length:  # the same numbers in a third of the time
            return row, rng.integers(episodes.same_length, size=n)
        return row, rng.integers(self.facts.take(row, axis=0)[:, 2])


class _DrawList:
    """Episodes side by side on a line, each as long as its weight.

    Args:
        rows: of the table, (m,).
        ends: where each ends, (m,), the running sum of the weights.
        length: their steps, (m,).

    Attributes:
        n_transitions: in all of them.
        same_length: the steps of each if all have as many, else 0.
    """

    def __init__(self, rows: np.ndarray, ends: np.ndarray, length: np.ndarray) -> None:
        self.rows = rows.astype(np.int32)
        self.ends = ends
        self.n_transitions = int(length.sum())
        self.same_length = int(length[0]) if len(length) and np.ptp(length) == 0 else 0
        self._guide: np.ndarray | None = None

    def at(self, points: np.ndarray) -> np.ndarray:
        """Rows of the episodes (n,) at points (n,) of the line: those of a binary search."""
        if self._guide is None:
            self._guide = self._make_guide()
        found = self._guide.take(self._bucket(points), mode="clip")
        found += points >= self.ends.take(found)
        wrong = np.flatnonzero(points >= self.ends.take(found, mode="clip"))
        if len(wrong):
            found[wrong] = np.searchsorted(self.ends, points[wrong], side="right")
        return self.rows.take(found, mode="clip")  # a point rounded up to the end is in the last

    def _bucket(self, points: np.ndarray) -> np.ndarray:
        return (points * (_BUCKETS * len(self.ends) / self.ends[-1])).astype(np.int64)

    def _make_guide(self) -> np.ndarray:
        """First episode (int32) that a point of each bucket can lie in.

        Rounding changes no order, so an episode whose end is in an earlier bucket than a point ends
        before the point: the guide is never too far.
        """
        n_buckets = _BUCKETS * len(self.ends)
        n_ends = np.bincount(self._bucket(self.ends), minlength=n_buckets + 1)[:n_buckets]
        guide = np.minimum(np.cumsum(n_ends) - n_ends, len(self.ends) - 1)
        return guide.astype(np.int32)  # half the memory, so that it stays in the cache
