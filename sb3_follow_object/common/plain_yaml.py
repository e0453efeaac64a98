"""YAML as plain values: no objects, no self-reference, no more than was written."""

from __future__ import annotations

from typing import Any

import yaml

from .reports import reason

SIZE_LIMIT = 1 << 17  # characters
NODES_LIMIT = 20_000  # after every alias has been replaced by what it stands for
DEPTH_LIMIT = 32
_MERGE = "tag:yaml.org,2002:merge"


def load_yaml(text: str) -> Any:
    """Return what YAML says in dicts with text as keys, lists, text, numbers, booleans and None.

    An alias may stand for something written before, as anchors in settings do, but not multiply it
    beyond `NODES_LIMIT` (a "billion laughs").

    Raises:
        ValueError: the text is not YAML, is too large or too deep, holds anything else, or gives a
            key twice.
    """
    if len(text) > SIZE_LIMIT:
        raise ValueError(f"it has {len(text)} characters, more than {SIZE_LIMIT}")
    try:
        node = yaml.compose(text, yaml.SafeLoader)
        if node is None:
            return None
        _count(node, {}, 0)
        # Merging copies what is merged, so its size has to be known by now.
        value = yaml.constructor.SafeConstructor().construct_document(node)
    except yaml.YAMLError as error:
        raise ValueError(reason(error)) from error
    except RecursionError as error:
        raise ValueError(f"it is nested more than {DEPTH_LIMIT} deep") from error
    except (AttributeError, KeyError, OverflowError, TypeError) as error:  # !!timestamp, !!binary
        raise ValueError(f"a tagged value cannot be read ({error})") from error
    _check_plain(value)
    return value


def _count(node: Any, known: dict[int, int | None], depth: int) -> int:
    """Return the nodes below and including one, aliases counted as often as they are used."""
    if depth > DEPTH_LIMIT:
        raise ValueError(f"it is nested more than {DEPTH_LIMIT} deep")
    if id(node) in known:
        size = known[id(node)]
        if size is None:
            raise ValueError("it contains itself")
        return size
    known[id(node)] = None
    total = 1
    if isinstance(node, yaml.SequenceNode):
        total += sum(_count(item, known, depth + 1) for item in node.value)
    elif isinstance(node, yaml.MappingNode):
        _check_keys(node)
        total += sum(_count(item, known, depth + 1) for pair in node.value for item in pair)
    if total > NODES_LIMIT:
        raise ValueError(f"its aliases stand for more than {NODES_LIMIT} values")
    known[id(node)] = total
    return total


def _check_keys(node: Any) -> None:
    """Raise a ValueError for a key that a mapping has twice; what is merged into it may have it."""
    lines: dict[tuple[str, str], int] = {}
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode) or key.tag == _MERGE:
            continue
        line = key.start_mark.line + 1
        if (key.tag, key.value) in lines:
            first = lines[key.tag, key.value]
            raise ValueError(f"{key.value!r} is given in line {first} and again in line {line}")
        lines[key.tag, key.value] = line


def _check_plain(value: Any) -> None:
    if isinstance(value, dict):
        for key, inner in value.items():
            if not isinstance(key, str):
                raise ValueError(f"{key!r} is a key, where keys must be text")
            _check_plain(inner)
    elif isinstance(value, list):
        for inner in value:
            _check_plain(inner)
    elif value is not None and not isinstance(value, bool | int | float | str):
        raise ValueError(f"it holds a {type(value).__name__}, not text, numbers, true or false")
