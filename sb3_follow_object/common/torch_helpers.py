"""Small helpers around PyTorch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch as th


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


@cache
def one_thread_after_forks() -> None:
    """Let PyTorch use one thread in processes that are forked off from now on.

    Its other threads do not survive a fork, and a child that waited for them would wait for ever.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: th.set_num_threads(1))


def lowest(q_values: list[th.Tensor]) -> th.Tensor:
    """Elementwise minimum over critics (n, 1)."""
    return q_values[0] if len(q_values) == 1 else th.stack(q_values).amin(dim=0)
