"""Planes of symmetry: what a state and an action are on the other side of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .numbers import checked_number, checked_whole

_FARTHEST = 1e6  # metres that a plane may be away


@dataclass(frozen=True)
class Mirror:
    """A plane over which an environment is symmetric: mirrored actions have mirrored outcomes.

    It stands across one axis, and goals are positions (3,). Entries are counted from 0.

    Args:
        axis: of the coordinate that the plane stands across: 0, 1 or 2.
        at: that coordinate of the plane, metres.
        positions: entries of an observation that are this coordinate of a position.
        signs: entries that change their sign: this coordinate of a velocity or of a difference, the
            other two of an angular velocity or of Euler angles.
        swaps: pairs of entries that change places before that, as those of two fingers do.
        actions: entries of an action that change their sign.

    Raises:
        ValueError: an entry is no whole number of at least 0 or is told twice, the axis is none, or
            the plane is nowhere.
    """

    axis: int
    at: float
    positions: tuple[int, ...] = ()
    signs: tuple[int, ...] = ()
    swaps: tuple[tuple[int, int], ...] = ()
    actions: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        checked = {
            "axis": checked_whole("a mirror's axis", self.axis, 0, 2),
            "at": checked_number("a mirror's at", self.at, -_FARTHEST, _FARTHEST),
            "positions": _entries("positions", self.positions),
            "signs": _entries("signs", self.signs),
            "swaps": tuple(_pair(pair) for pair in _listed("swaps", self.swaps)),
            "actions": _entries("actions", self.actions),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        swapped = [entry for pair in self.swaps for entry in pair]
        for told in ([*self.positions, *self.signs], swapped, self.actions):
            if len(set(told)) < len(told):
                raise ValueError(f"a mirror tells an entry twice: {sorted(told)}")

    @property
    def needs(self) -> tuple[int, int]:
        """Entries that an observation and an action must have at least."""
        told = [*self.positions, *self.signs, *(entry for pair in self.swaps for entry in pair)]
        return max(told, default=-1) + 1, max(self.actions, default=-1) + 1

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Return the mirror image of observations (..., d), in their dtype."""
        order, sign, shift = self.table(observation.shape[-1])
        sign, shift = sign.astype(observation.dtype), shift.astype(observation.dtype)
        return observation[..., order] * sign + shift

    def goal(self, goal: np.ndarray) -> np.ndarray:
        """Return the mirror image of goals (..., 3)."""
        across = np.arange(goal.shape[-1]) == self.axis
        return np.where(across, 2.0 * self.at - goal, goal)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the mirror image of actions (..., a)."""
        return action * self.action_sign(action.shape[-1])

    def table(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return order, sign, shift (size,): entry i becomes sign[i] * x[order[i]] + shift[i]."""
        order, sign, shift = np.arange(size), np.ones(size), np.zeros(size)
        for first, second in self.swaps:
            order[[first, second]] = second, first
        sign[[*self.positions, *self.signs]] = -1.0
        shift[[*self.positions]] = 2.0 * self.at
        return order, sign, shift

    def action_sign(self, size: int) -> np.ndarray:
        """Return what each entry of an action is multiplied by, (size,)."""
        sign = np.ones(size)
        sign[[*self.actions]] = -1.0
        return sign

    def plain(self) -> dict[str, Any]:
        """Return the fields as JSON and YAML have them, which `as_mirrors` takes."""
        return {
            "axis": self.axis,
            "at": self.at,
            "positions": [*self.positions],
            "signs": [*self.signs],
            "swaps": [[*pair] for pair in self.swaps],
            "actions": [*self.actions],
        }


def as_mirrors(given: Any) -> list[Mirror]:
    """Return mirrors from a list of them or of their fields by name, as YAML gives them.

    Raises:
        ValueError: it is no list, or a field is unknown, missing or wrong.
    """
    if not isinstance(given, list | tuple):
        raise ValueError(
            f"mirrors are a list of Mirror or of mappings with axis and at, not {given!r}"
        )
    return [_as_mirror(each) for each in given]


def _as_mirror(given: Any) -> Mirror:
    if isinstance(given, Mirror):
        return given
    if not isinstance(given, Mapping) or not {"axis", "at"} <= set(given):
        raise ValueError(f"a mirror is a mapping with axis and at, not {given!r}")
    unknown = sorted(map(str, set(given) - set(Mirror.__dataclass_fields__)))
    if unknown:
        raise ValueError(
            f"a mirror has no {unknown[0]!r}; it has {', '.join(Mirror.__dataclass_fields__)}"
        )
    return Mirror(**given)


def _listed(name: str, values: Any) -> Iterable[Any]:
    if not isinstance(values, list | tuple):
        raise ValueError(f"a mirror's {name} are a list, not {values!r}")
    return values


def _entries(name: str, values: Any) -> tuple[int, ...]:
    return tuple(
        checked_whole(f"an entry of a mirror's {name}", v, 0) for v in _listed(name, values)
    )


def _pair(values: Any) -> tuple[int, ...]:
    pair = _entries("swaps", values)
    if len(pair) != 2:
        raise ValueError(f"a mirror's swaps are pairs of entries, not {list(pair)}")
    return pair
