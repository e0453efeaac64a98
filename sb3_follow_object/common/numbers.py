"""Numbers that come from anywhere, a sweep in NumPy included, as Python's own."""

from __future__ import annotations

import math
import operator
from numbers import Real
from typing import Any

import numpy as np


def as_flag(value: Any) -> bool:
    """Return true or false as Python's; a number is neither.

    Raises:
        ValueError: it is no boolean.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError("it is neither true nor false")
    return bool(value)


def as_whole(value: Any) -> int:
    """Return a whole number as Python's; true and 2.0 are none.

    Raises:
        ValueError: it is no whole number.
    """
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        return operator.index(value)
    except TypeError:
        raise ValueError("it is no whole number") from None


def as_number(value: Any) -> float:
    """Return a number as Python's, NaN and infinity among them; true is none.

    Raises:
        ValueError: it is no number, or beyond what a float holds.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise ValueError("it is no number")
    try:
        return float(value)
    except OverflowError:
        raise ValueError("it is more than a float holds") from None


def shown(value: Any) -> str:
    """Return a value as a sentence shows it: NumPy's as Python's, a long one by its beginning."""
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def checked_whole(name: str, value: Any, low: int | None = None, high: int | None = None) -> int:
    """Return a whole number as Python's.

    Args:
        name: what a sentence calls it.
        value: given for it.
        low: the least that it may be; None, any.
        high: the most that it may be; None, any.

    Raises:
        ValueError: it is no whole number, or outside its range.
    """
    try:
        number = as_whole(value)
    except ValueError:
        raise ValueError(f"{name} must be a whole number, not {shown(value)}") from None
    if low is not None and number < low:
        raise ValueError(f"{name} is {number}; it must be at least {low}")
    if high is not None and number > high:
        raise ValueError(f"{name} is {number}; it must be at most {high}")
    return number


def checked_number(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> float:
    """Return a finite number as Python's float.

    Args:
        name: what a sentence calls it.
        value: given for it.
        low: the least that it may be.
        high: the most that it may be.

    Raises:
        ValueError: it is no number, or outside its range.
    """
    try:
        number = as_number(value)
    except ValueError:
        raise ValueError(f"{name} must be a number, not {shown(value)}") from None
    if not (low <= number <= high and number < math.inf):
        end = ")" if high == math.inf else "]"
        raise ValueError(f"{name} is {shown(value)}; it must lie in [{low:g}, {high:g}{end}")
    return number
