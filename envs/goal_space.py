"""What goals are: how far two are apart, what lies between them, where in space one is.

The goal of an object that is followed is a position so far. Another kind, such as a pose, is a
class here and an entry of `KINDS`: whatever compares, imagines, draws or stores goals asks it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class GoalSpace:
    """Goals as vectors, of whatever environment: what hindsight replay knows of them.

    Args:
        size: numbers of a goal, >= 1.

    Attributes:
        n_encoded: numbers that a network is shown of a goal.
    """

    kind = "vector"  # what files call it
    said = "vectors"  # what sentences call it

    def __init__(self, size: int) -> None:
        self.size = size
        self.n_encoded = size

    def distance(self, first: Any, second: Any) -> Any:
        """How far goals (..., size) are apart, (...); of arrays or of tensors."""
        return ((first - second) ** 2).sum(-1) ** 0.5

    def between(self, first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Goals (..., size) that lie so far on the way from first to second, shares (...)."""
        share = share[..., None]
        way: np.ndarray = (1.0 - share) * first + share * second
        return way

    def as_with_margin(self, achieved: Any, desired: Any, margin: float) -> Any:
        """Achieved goals (..., size) so far off that a tolerance judges them as with a margin.

        Args:
            achieved: of arrays or of tensors.
            desired: the same.
            margin: share in [0, 1) of the tolerance that is not good enough.
        """
        return desired + 1.0 / (1.0 - margin) * (achieved - desired)

    def point(self, goals: np.ndarray) -> np.ndarray:
        """Where goals (..., size) are in space, (..., 3) metres; at least 3 numbers each."""
        return goals[..., :3]

    def height(self, goals: np.ndarray) -> np.ndarray:
        """How high goals (..., size) lie, (...) metres."""
        height: np.ndarray = self.point(goals)[..., 2]
        return height

    def encode(self, goals: np.ndarray) -> np.ndarray:
        """What a network is shown of goals (..., size), (..., n_encoded)."""
        return goals

    def decode(self, encoded: np.ndarray) -> np.ndarray:
        """The goals that a network means, the inverse of `encode`."""
        return encoded


class Positions(GoalSpace):
    """Where an object shall be, (3,) metres."""

    kind = "position"
    said = "positions of an object, of the shape (3,), in metres"

    def __init__(self) -> None:
        super().__init__(3)


POSITIONS = Positions()
KINDS: dict[str, GoalSpace] = {space.kind: space for space in (POSITIONS,)}  # can be followed


def goal_space(shape: Sequence[int]) -> GoalSpace:
    """Return the space of an environment's goals, by their shape."""
    for space in KINDS.values():
        if tuple(shape) == (space.size,):
            return space
    return GoalSpace(int(shape[-1]))


def followed_space(shape: Sequence[int] | None) -> GoalSpace:
    """Return the space of goals that an object can be followed to, by their shape.

    Raises:
        ValueError: they are of no kind that can be followed.
    """
    space = goal_space(shape) if shape else None
    if space is None or space.kind not in KINDS:
        known = " or ".join(each.said for each in KINDS.values())
        what = "are of no single shape" if shape is None else f"have the shape {shape}"
        raise ValueError(f"the environment's goals {what}; what can be followed are {known}")
    return space
