"""Small helpers around PyTorch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch as th

_PROCESS = os.getpid()  # in a process forked from this one another number


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


@contextmanager
def fork_safe() -> Iterator[None]:
    """Use one thread for a while in a forked process, which has none of its parent's threads.

    OpenMP does not know that and would wait for them without end.
    """
    with ExitStack() as stack:
        if os.getpid() != _PROCESS:
            stack.enter_context(threads_at(1))
        yield


@contextmanager
def usual_defaults() -> Iterator[None]:
    """Make float32 tensors on the CPU by default for a while, whatever the process's defaults.

    Networks are built and Adam keeps its counts by these defaults; what they meet is float32.
    """
    dtype = th.get_default_dtype()
    with fork_safe(), ExitStack() as stack:
        if dtype != th.float32:
            stack.callback(th.set_default_dtype, dtype)
            th.set_default_dtype(th.float32)
        if th.get_default_device().type != "cpu":
            stack.enter_context(th.device("cpu"))
        yield


def lowest(q_values: list[th.Tensor]) -> th.Tensor:
    """Elementwise minimum over critics (n, 1)."""
    return q_values[0] if len(q_values) == 1 else th.stack(q_values).amin(dim=0)
