"""Types of settings that are neither a number, a word nor true or false."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BeforeValidator

from ..common.mirrors import as_mirrors
from ..common.numbers import as_number, as_whole
from .fields import Said, Unfit

LAYERS_LIMIT, WIDTH_LIMIT = 16, 8192  # of networks that anybody means
CRITICS_LIMIT = 16


def _widths(least: int) -> Callable[[Any], list[int]]:
    def widths(value: Any) -> list[int]:
        if not isinstance(value, list | tuple) or not least <= len(value) <= LAYERS_LIMIT:
            raise ValueError
        numbers = [as_whole(width) for width in value]
        if not all(1 <= width <= WIDTH_LIMIT for width in numbers):
            raise ValueError
        return numbers

    return widths


def _net_arch(value: Any) -> Any:
    if not isinstance(value, dict):
        return _widths(0)(value)
    if set(value) != {"pi", "qf"}:
        raise ValueError
    return {name: _widths(0)(widths) for name, widths in value.items()}


def _train_freq(value: Any) -> Any:
    pair = isinstance(value, list | tuple) and len(value) == 2
    number, unit = value if pair else (value, "step")
    number = as_whole(number)
    if number < 1 or unit not in ("step", "episode"):
        raise ValueError
    return (number, unit) if pair else number


def _gradient_steps(value: Any) -> int:
    number = as_whole(value)
    if number < 1 and number != -1:
        raise ValueError
    return number


def _target_clip(value: Any) -> Any:
    return "auto" if isinstance(value, str) and value == "auto" else _bounds(value)


def _bounds(value: Any) -> tuple[float, float]:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError
    low, high = (as_number(limit) for limit in value)
    if not low <= high:  # NaN either
        raise ValueError
    return low, high


def _rate(value: Any) -> Any:
    if callable(value):
        return value
    rate = as_number(value)
    if not 0.0 < rate < math.inf:
        raise ValueError
    return rate


def _strategy(value: Any) -> Any:
    if isinstance(value, enum.Enum) or value in ("future", "final", "episode"):
        return value
    raise ValueError


def _indices(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError
    numbers = tuple(as_whole(index) for index in value)
    if min(numbers) < 0:
        raise ValueError
    return numbers


def _standoff(value: Any) -> Any:
    if isinstance(value, str) and value == "auto":
        return "auto"
    metres = as_number(value)
    if not 0.0 <= metres < math.inf:
        raise ValueError
    return metres


def _mirrors(value: Any) -> Any:
    if isinstance(value, str) and value == "auto":
        return "auto"
    try:
        return [mirror.plain() for mirror in as_mirrors(value)]
    except ValueError as error:
        raise Unfit(str(error)) from error


def _policy(value: Any) -> Any:
    if isinstance(value, type) or value == "MultiInputPolicy":
        return value
    raise ValueError


_SOME_WIDTHS = f"to {LAYERS_LIMIT} whole numbers in 1..{WIDTH_LIMIT}"
Hidden = Annotated[Any, BeforeValidator(_widths(1)), Said(f"1 {_SOME_WIDTHS}")]
NetArch = Annotated[
    Any, BeforeValidator(_net_arch), Said(f"0 {_SOME_WIDTHS}, or such for each of pi and qf")
]
TrainFreq = Annotated[
    Any,
    BeforeValidator(_train_freq),
    Said("a number of steps, [n, step] or [n, episode], at least 1"),
]
GradientSteps = Annotated[
    int,
    BeforeValidator(_gradient_steps),
    Said("a whole number of at least 1, or -1 for the steps of a rollout"),
]
Bounds = Annotated[Any, BeforeValidator(_bounds), Said("(low, high) with low <= high or None")]
TargetClip = Annotated[
    Any, BeforeValidator(_target_clip), Said('(low, high) with low <= high, "auto" or None')
]
Rate = Annotated[Any, BeforeValidator(_rate), Said("a number in (0, inf)")]
Strategy = Annotated[Any, BeforeValidator(_strategy), Said("'future', 'final' or 'episode'")]
Indices = Annotated[Any, BeforeValidator(_indices), Said("three whole numbers of at least 0")]
Standoff = Annotated[Any, BeforeValidator(_standoff), Said('"auto" or a number of at least 0')]
Mirrors = Annotated[
    Any,
    BeforeValidator(_mirrors),
    Said('"auto" or a list of mirrors, each with axis and at'),
]
Policy = Annotated[Any, BeforeValidator(_policy), Said("MultiInputPolicy")]
PythonClass = Annotated[type, Said("a class, which only Python code can give")]
Reward = Annotated[Any, Said("rnd, sldr or a subclass of `AuxiliaryReward`")]
Networks = Annotated[Any, Said('"auto", a file, or `ObjectNetworks`')]
Device = Annotated[Any, Said("the name of a PyTorch device")]
