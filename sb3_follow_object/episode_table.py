"""The finished episodes of a replay buffer, and drawing from them."""

from __future__ import annotations

from typing import Any

import numpy as np


class EpisodeTable:
    """The finished episodes of the buffer: where each starts and how long it is.

    Sampling draws from this table, never from the slots, so its cost depends on the number of
    episodes only through a binary search.
    """

    _ARRAYS = ("start", "env", "length", "priority")

    def __init__(self) -> None:
        self.start = np.zeros(64, dtype=np.int64)
        self.env = np.zeros(64, dtype=np.int64)
        self.length = np.zeros(64, dtype=np.int64)
        self.priority = np.zeros(64)  # 0: drawn with all episodes only
        self._free = list(range(63, -1, -1))
        self._draw_lists: dict[bool, tuple[np.ndarray, np.ndarray]] = {}

    def insert(self, start: int, env: int, length: int, priority: float) -> int:
        """Add an episode and return its row."""
        if not self._free:
            n = len(self.length)
            for name in self._ARRAYS:
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
            self._free = list(range(2 * n - 1, n - 1, -1))
        row = self._free.pop()
        self.start[row], self.env[row] = start, env
        self.length[row], self.priority[row] = length, priority
        self._draw_lists.clear()
        return row

    def remove(self, row: int) -> None:
        """Forget the episode in `row`."""
        self.length[row] = 0
        self._free.append(row)
        self._draw_lists.clear()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next draws depend on."""
        return {**{name: getattr(self, name) for name in self._ARRAYS}, "free": self._free}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        for name in self._ARRAYS:
            setattr(self, name, state[name].copy())
        self._free = list(state["free"])
        self._draw_lists.clear()

    def _draw_list(self, by_priority: bool) -> tuple[np.ndarray, np.ndarray]:
        """Rows to draw from and the running sum of their weights."""
        if by_priority not in self._draw_lists:
            weight = self.length * self.priority if by_priority else self.length
            rows = np.flatnonzero(weight > 0)
            self._draw_lists[by_priority] = rows, np.cumsum(weight[rows])
        return self._draw_lists[by_priority]

    def n_transitions(self, with_priority: bool = False) -> int:
        """Transitions in finished episodes, or in those with a priority."""
        return int(self.length[self._draw_list(with_priority)[0]].sum())

    def draw(
        self, n: int, rng: np.random.Generator, by_priority: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw n transitions: rows of the table (n,) and steps within them (n,).

        Uniformly over transitions, or episodes in proportion to length times priority.
        """
        rows, ends = self._draw_list(by_priority)
        which = np.searchsorted(ends, rng.random(n) * ends[-1], side="right")
        row = rows[np.minimum(which, len(rows) - 1)]
        return row, rng.integers(self.length[row])
