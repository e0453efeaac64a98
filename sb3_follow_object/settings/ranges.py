"""What the values of settings may be."""

from __future__ import annotations

import math
from typing import Any

_AT_LEAST_ONE = {"n_timesteps", "batch_size", "buffer_size", "gradient_steps", "n_paths"}
_AT_LEAST_ONE |= {"object_timesteps", "object_n_envs", "test_every", "n_test_episodes", "n_threads"}

# What is more cannot be meant, and would fill the memory.
_AT_MOST = {"n_envs": 4096, "object_n_envs": 4096, "n_threads": 1024, "torch_threads": 1024}
_AT_MOST |= {"batch_size": 10**6, "n_sampled_goal": 1000, "n_critics": 16, "n_levels": 10**4}
_AT_MOST |= {"buffer_size": 10**8, "n_paths": 10**6, "keep_checkpoints": 1000}
_LARGEST = 10**15  # of all other whole numbers
_LAYERS, _WIDTH = 16, 8192
# Numbers with another range, as a sentence says it: the least, the most, whether each is included.
_RANGES: dict[str, tuple[float, float, str]] = {
    "tau": (0.0, 1.0, "(]"),
    "gamma": (0.0, 1.0, "[)"),
    "learning_rate": (0.0, math.inf, "()"),
    "learning_starts": (0.0, math.inf, "[)"),
    "features_clip": (0.0, math.inf, "()"),
    "imagined_ratio": (0.0, 1.0, "[]"),
    "test_share": (0.0, 1.0, "()"),
    "n_paths": (2.0, math.inf, "[)"),
    "epochs": (1.0, math.inf, "[)"),
}


def check_value(name: str, value: Any, where: str) -> None:
    """Refuse a value of the right type that cannot be meant, before anything is built from it.

    Args:
        name: of the setting, without what it is nested in.
        value: given for it.
        where: beginning of the sentence.

    Raises:
        ValueError: the value is out of the setting's range.
    """
    if name in _AT_LEAST_ONE:
        if not isinstance(value, int):
            raise ValueError(f"{where}: {name} must be a whole number, not {value!r}")
        if value < 1:
            raise ValueError(f"{where}: {name} is {value}; it must be at least 1")
    if isinstance(value, int) and abs(value) > _AT_MOST.get(name, _LARGEST):
        limit = _AT_MOST.get(name, _LARGEST)
        raise ValueError(f"{where}: {name} is {value:.6g}; it must be at most {limit}")
    if name in _RANGES:
        low, high, ends = _RANGES[name]
        number = value if isinstance(value, int | float) else math.nan
        above = low <= number if ends[0] == "[" else low < number
        below = number <= high if ends[1] == "]" else number < high
        if not (above and below):
            interval = f"{ends[0]}{low:g}, {high:g}{ends[1]}"
            raise ValueError(f"{where}: {name} is {value!r}; it must lie in {interval}")
    if name in ("net_arch", "hidden"):
        _check_widths(value, f"{where}: {name}", least=int(name == "hidden"))
    if name == "train_freq":
        number, unit = value if isinstance(value, list) and len(value) == 2 else (value, "step")
        if type(number) is not int or number < 1 or unit not in ("step", "episode"):
            raise ValueError(
                f"{where}: train_freq must be a number of steps, [n, step] or [n, episode], "
                f"at least 1, not {value!r}"
            )
    if name == "object_on_table" and not isinstance(value, bool):
        raise ValueError(f"{where}: object_on_table must be true or false, not {value!r}")
    if name == "policy" and value != "MultiInputPolicy":
        raise ValueError(f"{where}: policy must be MultiInputPolicy, not {value!r}")


def _check_widths(value: Any, where: str, least: int = 0) -> None:
    """Refuse networks that nobody means, before they are built."""
    if isinstance(value, dict):  # SB3's way to give actor and critic networks of their own
        for name, widths in value.items():
            if name not in ("pi", "qf"):
                raise ValueError(f"{where} can have pi and qf, not {name!r}")
            _check_widths(widths, f"{where}.{name}")
        return
    fits = isinstance(value, list) and least <= len(value) <= _LAYERS
    if not fits or not all(type(width) is int and 1 <= width <= _WIDTH for width in value):
        raise ValueError(
            f"{where} must be {least} to {_LAYERS} whole numbers in 1..{_WIDTH}, not {value!r}"
        )


def check_positive(**values: int) -> None:
    """Raise a ValueError for a count below 1."""
    for name, value in values.items():
        if value < 1:
            raise ValueError(f"{name} is {value!r}; it must be at least 1")
