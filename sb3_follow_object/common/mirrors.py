"""Planes of symmetry: what a state and an action are on the other side of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .numbers import checked_number, checked_whole


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
        swaps: pairs of entries that change places, as those of two fingers do.
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
        pairs = [tuple(pair) for pair in self.swaps]
        if any(len(pair) != 2 for pair in pairs):
            raise ValueError(f"a mirror's swaps are pairs of entries, not {self.swaps}")
        checked = {
            "axis": checked_whole("a mirror's axis", self.axis, 0, 2),
            "at": checked_number("a mirror's at", self.at, -1e6, 1e6),
            "positions": _entries(self.positions),
            "signs": _entries(self.signs),
            "swaps": tuple(_entries(pair) for pair in pairs),
            "actions": _entries(self.actions),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        told = [*self.positions, *self.signs, *(entry for pair in self.swaps for entry in pair)]
        for entries in (told, self.actions):
            if len(set(entries)) < len(entries):
                raise ValueError(f"a mirror tells an entry twice: {sorted(entries)}")

    @property
    def needs(self) -> tuple[int, int]:
        """Entries that an observation and an action must have at least."""
        told = [*self.positions, *self.signs, *(entry for pair in self.swaps for entry in pair)]
        return max(told, default=-1) + 1, max(self.actions, default=-1) + 1

    def plain(self) -> dict[str, Any]:
        """Return the fields as JSON and YAML have them, which `as_mirror` takes."""
        return {
            "axis": self.axis,
            "at": self.at,
            "positions": [*self.positions],
            "signs": [*self.signs],
            "swaps": [[*pair] for pair in self.swaps],
            "actions": [*self.actions],
        }


def as_mirror(given: Mirror | Mapping[str, Any]) -> Mirror:
    """Return a mirror from its fields by their names, as YAML gives them.

    Raises:
        ValueError: a field is unknown, missing or wrong.
    """
    if isinstance(given, Mirror):
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"a mirror is a mapping with axis and at, not {given!r}")
    try:
        return Mirror(**given)
    except TypeError as error:
        raise ValueError(f"a mirror is a mapping with axis and at, not {dict(given)}") from error


def _entries(values: Any) -> tuple[int, ...]:
    return tuple(checked_whole("an entry of a mirror", value, 0) for value in values)
