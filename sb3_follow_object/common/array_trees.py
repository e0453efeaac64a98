"""Trees of arrays and plain values in one safetensors file, checksummed and without pickle.

The file's metadata begin with the SHA-256 of the whole file, taken while the digest itself read as
zeros. So the file is an ordinary safetensors file, and no bit of it can change unnoticed.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from safetensors import SafetensorError, safe_open

from .copies import WholeCopies
from .files import atomic_file

_TREE = "tree"  # the metadata entry that holds everything but the arrays
_KINDS = ("array", "tensor", "dict", "tuple")
_LENGTH_BYTES = 8  # of the header's length, which a safetensors file begins with
_DIGEST = b'{"__metadata__":{"sha256":"'  # what the header begins with
_ZEROS = b"0" * 64
_DIGEST_AT = _LENGTH_BYTES + len(_DIGEST)
_BLOCK = 1 << 22  # bytes hashed at a time
_DTYPES = {
    f"{kind}{bits}": f"{kind[0].upper()}{bits}"
    for kind in ("int", "uint", "float")
    for bits in (8, 16, 32, 64)
    if (kind, bits) != ("float", 8)
}
_DTYPES["bool"] = "BOOL"


@dataclass(frozen=True)
class Snapshot:
    """A tree as it stood at one moment: nothing that happens later changes it.

    Attributes:
        arrays: copies of the tree's arrays by name.
        plain: the rest of the tree, as JSON.
    """

    arrays: dict[str, np.ndarray]
    plain: str

    def write(self, path: str | os.PathLike[str]) -> int:
        """Write the tree to a file, atomically, and return the file's size in bytes.

        Raises:
            OSError: the file cannot be written; the old one is then as it was.
        """
        # Widest first, so that every array lies on a multiple of its item's size.
        arrays = dict(sorted(self.arrays.items(), key=lambda item: -item[1].itemsize))
        entries: dict[str, Any] = {"__metadata__": {"sha256": _ZEROS.decode(), _TREE: self.plain}}
        end = 0
        for name, array in arrays.items():
            start, end = end, end + array.nbytes
            dtype = _DTYPES[array.dtype.name]
            entries[name] = {"dtype": dtype, "shape": array.shape, "data_offsets": [start, end]}
        header = json.dumps(entries, separators=(",", ":")).encode()
        header += b" " * (-len(header) % _LENGTH_BYTES)
        digest = hashlib.sha256()
        with atomic_file(path) as file:
            blocks: list[bytes | memoryview] = [
                len(header).to_bytes(_LENGTH_BYTES, "little"),
                header,
            ]
            blocks += [array.reshape(-1).view(np.uint8).data for array in arrays.values()]
            for block in blocks:
                digest.update(block)
                file.write(block)
            file.seek(_DIGEST_AT)
            file.write(digest.hexdigest().encode())
        return _LENGTH_BYTES + len(header) + end


class Camera(WholeCopies):
    """Takes snapshots of nested dicts, lists and tuples of arrays, tensors and JSON values.

    It keeps the memory of its last snapshot for the next one, which must not be taken before the
    last is done with: copying to memory that the process has already is many times faster.
    """

    def __init__(self) -> None:
        self._memory: dict[str, np.ndarray] = {}

    def take(self, tree: Any) -> Snapshot:
        """Copy a tree.

        Args:
            tree: what to copy; dict keys may be strings or integers.

        Raises:
            TypeError: the tree holds something else than the above.
        """
        arrays: dict[str, np.ndarray] = {}
        plain = self._encode(tree, arrays)
        return Snapshot(arrays, json.dumps(plain))

    def _encode(self, node: Any, arrays: dict[str, np.ndarray]) -> Any:
        """Replace arrays by references to copies; tag what JSON would lose."""
        if isinstance(node, th.Tensor):
            return {"tensor": self._encode(node.detach().cpu().numpy(), arrays)["array"]}
        if isinstance(node, np.ndarray):
            name = str(len(arrays))
            arrays[name] = self._copy(name, node)
            return {"array": name}
        if isinstance(node, dict):
            pairs = [[key, self._encode(value, arrays)] for key, value in node.items()]
            return {"dict": pairs}
        if isinstance(node, tuple):
            return {"tuple": [self._encode(value, arrays) for value in node]}
        if isinstance(node, list):
            return [self._encode(value, arrays) for value in node]
        if isinstance(node, np.generic):
            return node.item()
        if node is None or isinstance(node, (bool, int, float, str)):
            return node
        raise TypeError(f"a checkpoint cannot hold a {type(node).__name__}")

    def _copy(self, name: str, array: np.ndarray) -> np.ndarray:
        if array.dtype.name not in _DTYPES:
            raise TypeError(f"a checkpoint cannot hold an array of {array.dtype}")
        memory = self._memory.get(name)
        if memory is None or memory.nbytes < array.nbytes:
            # A view of an array that is being filled will grow to it; what is not used of the
            # memory until then costs nothing.
            whole = array.base if isinstance(array.base, np.ndarray) else array
            memory = np.empty(max(array.nbytes, whole.nbytes), dtype=np.uint8)
            self._memory[name] = memory
        copy: np.ndarray = memory[: array.nbytes].view(array.dtype).reshape(array.shape)
        np.copyto(copy, array)
        return copy


def save_tree(path: str | os.PathLike[str], tree: Any) -> None:
    """Write a tree, as `Camera` takes it, to a file, atomically.

    Raises:
        TypeError: the tree holds something that cannot be saved.
        OSError: the file cannot be written; the old one is then as it was.
    """
    Camera().take(tree).write(path)


def load_tree(path: str | os.PathLike[str]) -> Any:
    """Read what `save_tree` wrote.

    Raises:
        ValueError: the file is missing, damaged, or was not written by `save_tree`.
    """
    try:
        has_digest = _check_digest(Path(path))
        with safe_open(Path(path), framework="numpy") as file:
            metadata = file.metadata() or {}
            if not has_digest and set(metadata) != {_TREE}:  # the first files had none
                raise ValueError("it does not begin with its checksum")
            return _decode(json.loads(metadata[_TREE]), file.get_tensor)
    except FileNotFoundError as error:
        raise ValueError(f"there is no file {path}") from error
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a whole checkpoint ({error})") from error


def _check_digest(path: Path) -> bool:
    """Return whether the file has a checksum; raise a ValueError unless it is the right one."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        head = file.read(_DIGEST_AT + len(_ZEROS))
        if head[_LENGTH_BYTES:_DIGEST_AT] != _DIGEST:
            return False
        digest.update(head[:_DIGEST_AT] + _ZEROS)
        while block := file.read(_BLOCK):
            digest.update(block)
    if head[_DIGEST_AT:] != digest.hexdigest().encode():
        raise ValueError("its content does not match its checksum")
    return True


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
