"""Small helpers around PyTorch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from stable_baselines3.common.utils import get_device


@contextmanager
def matmul_at(precision: str) -> Iterator[None]:
    """Multiply float32 matrices with this precision for a while."""
    earlier = th.get_float32_matmul_precision()
    th.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        th.set_float32_matmul_precision(earlier)


@contextmanager
def threads_at(n: int | None) -> Iterator[None]:
    """Let PyTorch use n threads for a while; with None, as many as it does already."""
    earlier = th.get_num_threads()
    th.set_num_threads(earlier if n is None else n)
    try:
        yield
    finally:
        th.set_num_threads(earlier)


def lowest(q_values: list[th.Tensor]) -> th.Tensor:
    """Elementwise minimum over critics (n, 1)."""
    return q_values[0] if len(q_values) == 1 else th.stack(q_values).amin(dim=0)


def usable_device(name: Any) -> th.device:
    """Return PyTorch's device of this name; "auto" is a GPU where there is one.

    Raises:
        ValueError: there is none of that name here.
    """
    try:
        return get_device(name)
    except (RuntimeError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device {name!r} cannot be used: {reason}") from error
