"""Trees of arrays and plain values in one safetensors file, without pickle."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialise

from .files import atomic_write

_TREE = "tree"  # the metadata entry that holds everything but the arrays
_KINDS = ("array", "tensor", "dict", "tuple")


def save_tree(path: str | os.PathLike[str], tree: Any) -> None:
    """Write nested dicts, lists and tuples of arrays, tensors and JSON values, atomically.

    Args:
        path: file to create or replace.
        tree: what to save; dict keys may be strings or integers.

    Raises:
        TypeError: the tree holds something else.
        OSError: the file cannot be written; the old one is then as it was.
    """
    arrays: dict[str, np.ndarray] = {}
    plain = _encode(tree, arrays)
    atomic_write(path, serialise(arrays, metadata={_TREE: json.dumps(plain)}))


def load_tree(path: str | os.PathLike[str]) -> Any:
    """Read what `save_tree` wrote.

    Raises:
        ValueError: the file is missing or is not a whole file written by `save_tree`.
    """
    try:
        with safe_open(Path(path), framework="numpy") as file:
            plain = json.loads((file.metadata() or {})[_TREE])
            return _decode(plain, file.get_tensor)
    except FileNotFoundError as error:
        raise ValueError(f"there is no file {path}") from error
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a whole checkpoint ({error})") from error


def _encode(node: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Replace arrays by references; tag what JSON would lose."""
    if isinstance(node, th.Tensor):
        return {"tensor": _encode(node.detach().cpu().numpy(), arrays)["array"]}
    if isinstance(node, np.ndarray):
        name = str(len(arrays))
        arrays[name] = np.ascontiguousarray(node).reshape(node.shape)
        return {"array": name}
    if isinstance(node, dict):
        return {"dict": [[key, _encode(value, arrays)] for key, value in node.items()]}
    if isinstance(node, tuple):
        return {"tuple": [_encode(value, arrays) for value in node]}
    if isinstance(node, list):
        return [_encode(value, arrays) for value in node]
    if isinstance(node, np.generic):
        return node.item()
    if node is None or isinstance(node, (bool, int, float, str)):
        return node
    raise TypeError(f"a checkpoint cannot hold a {type(node).__name__}")


def _decode(node: Any, get_array: Any) -> Any:
    if isinstance(node, list):
        return [_decode(value, get_array) for value in node]
    if not isinstance(node, dict):
        return node
    (kind, content), *rest = node.items()
    if rest or kind not in _KINDS:
        raise ValueError(f"unknown entry {kind!r}")
    if kind == "array":
        return get_array(content)
    if kind == "tensor":
        return th.from_numpy(get_array(content))
    if kind == "tuple":
        return tuple(_decode(value, get_array) for value in content)
    return {key: _decode(value, get_array) for key, value in content}
