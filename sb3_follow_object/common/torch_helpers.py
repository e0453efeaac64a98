"""Small helpers around PyTorch."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

import torch as th
from stable_baselines3.common.utils import get_device
from torch import nn

from .copies import WholeCopies


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


def own(tensor: th.Tensor) -> th.Tensor:
    """Return a tensor that no other process writes to: itself, or a copy of a shared one."""
    return tensor.clone() if tensor.is_shared() else tensor


def load_optimizer(optimizer: th.optim.Optimizer, state: dict[str, Any]) -> None:
    """Load `state_dict` of an optimiser, which may go on: PyTorch would share its tensors."""
    optimizer.load_state_dict(copy.deepcopy(state))


class WholeModule(WholeCopies, nn.Module):
    """A module whose copies have memory of their own.

    PyTorch lets a module that multiprocessing sends share its memory with the one that stays, so
    that training either would change both.
    """

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        for tensor in (*self.parameters(), *self.buffers()):
            tensor.data = own(tensor.data)
        for module in self.modules():
            optimizer = vars(module).get("optimizer")
            for values in optimizer.state.values() if optimizer is not None else ():
                for name, value in values.items():
                    values[name] = own(value) if isinstance(value, th.Tensor) else value


@cache
def one_thread_after_forks() -> None:
    """Let PyTorch use one thread in processes that are forked off from now on.

    Its other threads do not survive a fork, and a child that waited for them would wait for ever.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: th.set_num_threads(1))


@contextmanager
def usual_defaults() -> Iterator[None]:
    """Make float32 tensors on the CPU by default for a while, whatever the process's defaults.

    Networks are built and Adam keeps its counts by these defaults; what they meet is float32.
    """
    dtype = th.get_default_dtype()
    with ExitStack() as stack:
        if dtype != th.float32:
            stack.callback(th.set_default_dtype, dtype)
            th.set_default_dtype(th.float32)
        if th.get_default_device().type != "cpu":
            stack.enter_context(th.device("cpu"))
        yield


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
