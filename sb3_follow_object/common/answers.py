"""Arrays that come from outside, looked at once where they come in: nothing is broadcast."""

from __future__ import annotations

from typing import Any

import numpy as np


def one_each(answer: Any, n: int, what: str) -> np.ndarray:
    """Return the numbers (n,) that somebody's method gave for n rows, as (n,) or (n, 1).

    Args:
        answer: of the method.
        n: rows that it was asked about, >= 1.
        what: beginning of the sentence, e.g. "the environment's compute_reward".

    Raises:
        ValueError: it is another shape, not numbers, or not finite.
    """
    array = answer if isinstance(answer, np.ndarray) else _array(answer)
    kind, shape = array.dtype.kind, array.shape
    fits = shape == (n,) or shape == (n, 1) or array.size == n == 1
    if not fits or kind not in "biuf":
        raise ValueError(
            f"{what} must accept batches: for {n} rows it must return {n} numbers, {(n,)}, "
            f"not {_told(array)}"
        )
    if kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{what} returned NaN or infinity")
    return array if shape == (n,) else array.reshape(n)


def one_number(answer: Any, what: str) -> float:
    """Return the one finite number that somebody's method gave, as a number or an array of one.

    Raises:
        ValueError: it is something else.
    """
    array = _array(answer)
    if array.size != 1 or array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise ValueError(f"{what} must give one finite number, not {_told(array)}")
    return float(array.item())


def check_shape(array: Any, shape: tuple[int, ...], what: str) -> None:
    """Raise a ValueError unless an array has this shape."""
    found = tuple(np.shape(array))
    if found != shape:
        raise ValueError(f"{what} must have the shape {shape}, not {found}")


def _array(answer: Any) -> np.ndarray:
    try:
        return np.asarray(answer)
    except (TypeError, ValueError):  # rows of unequal lengths, or what is no array at all
        return np.asarray(None)


def _told(array: np.ndarray) -> str:
    """What an answer is, in a sentence."""
    if array.dtype.kind not in "biuf":
        return f"something of the type {array.dtype}"
    return f"the shape {array.shape}" if array.size != 1 else f"{array.item()!r}"
