"""Keyword arguments that come as data, from YAML or a caller's dict."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

from ..common.suggestions import did_you_mean


def check_keywords(
    name: str, given: Iterable[str], function: Callable[..., Any], hidden: Iterable[str] = ()
) -> None:
    """Raise a ValueError for the first keyword that a function does not take.

    Args:
        name: what the sentence calls the mapping.
        given: the keywords.
        function: takes them.
        hidden: its parameters that do not come as data.
    """
    known = {*inspect.signature(function).parameters} - {"self", "cls", *hidden}
    for key in given:
        if key not in known:
            raise ValueError(f"{name} has no setting {key!r}{did_you_mean(key, sorted(known))}")


def with_tuples(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings with SB3's train_freq, a list in YAML and JSON, as the tuple it wants."""
    return {
        name: with_tuples(value)
        if isinstance(value, dict)
        else tuple(value)
        if name == "train_freq" and isinstance(value, list)
        else value
        for name, value in settings.items()
    }
