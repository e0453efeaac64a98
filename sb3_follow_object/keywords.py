"""Keyword arguments that come as data, from YAML or a caller's dict."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

from .envs.tasks import did_you_mean


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
