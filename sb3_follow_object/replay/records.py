"""Many fields of a transition side by side in memory, fetched by one cache miss."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import torch as th

from ..common.copies import WholeCopies

_Batch = TypeVar("_Batch", np.ndarray, th.Tensor)
_LINE = 64  # bytes of a cache line
_FLOAT = np.dtype(np.float32).itemsize


class Records(WholeCopies):
    """A float32 record for each (slot, environment), and its fields as views.

    A batch drawn at random from millions of transitions costs what its cache misses cost: an array
    a field means a miss a field, a record means one, and the lines after it come by themselves.

    Args:
        n_slots: time-steps that are kept.
        n_envs: records of a time-step.
        fields: name -> shape of one entry, each () or (size,); they lie in this order.
        block: records are made a multiple of so many floats long, so that they begin where a line
            or an equal part of one does, where that adds no more than `spare` to their length.
        spare: share of a record that may be left empty.

    Attributes:
        array: (n_slots, n_envs, width) float32.
    """

    def __init__(
        self,
        n_slots: int,
        n_envs: int,
        fields: Mapping[str, tuple[int, ...]],
        block: int = _LINE // _FLOAT,
        spare: float = 0.1,
    ) -> None:
        self._columns: dict[str, int | slice] = {}
        width = 0
        for name, shape in fields.items():
            size = int(np.prod(shape))
            self._columns[name] = slice(width, width + size) if shape else width
            width += size
        padded = -(-width // block) * block
        self.array = _aligned((n_slots, n_envs, padded if padded <= (1 + spare) * width else width))

    def views(self) -> dict[str, np.ndarray]:
        """The fields of all records, (n_slots, n_envs, ...); what is written to them is stored."""
        return {name: self.array[..., columns] for name, columns in self._columns.items()}

    def take(self, flat: np.ndarray) -> np.ndarray:
        """Copy the records (n, width) with indices slot * n_envs + environment."""
        return self.array.reshape(-1, self.array.shape[-1]).take(flat, axis=0)

    def fields(self, batch: _Batch) -> dict[str, _Batch]:
        """The fields of records (n, width), an array or a tensor, as views of it (n, ...)."""
        return {name: batch[:, columns] for name, columns in self._columns.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.array = _aligned(self.array.shape)
        self.array[:] = state["array"]


def _aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros (float32) that begin with a cache line."""
    size = int(np.prod(shape))
    room = np.zeros(size + _LINE // _FLOAT, dtype=np.float32)
    first = -room.ctypes.data % _LINE // _FLOAT
    return room[first : first + size].reshape(shape)
