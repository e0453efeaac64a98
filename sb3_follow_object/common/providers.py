"""What a lower room asks for by name and a higher one has.

The package's top says where each thing is, as "module:name"; it is imported when it is first asked
for. So F_phi's wrapper can ask for a predictor without knowing who learns one.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PROVIDED: dict[str, dict[str, str]] = {}


def provide(kind: str, name: str, place: str) -> None:
    """Say where something of a kind is.

    Args:
        kind: what it is asked for as, e.g. "auxiliary reward".
        name: of the thing among its kind.
        place: "module:name", e.g. "sb3_follow_object.ddpg.rnd:RndReward".
    """
    _PROVIDED.setdefault(kind, {})[name] = place


def provided(kind: str) -> list[str]:
    """Return the names that a kind has."""
    return list(_PROVIDED.get(kind, {}))


def provider(kind: str, name: str) -> Any:
    """Import a thing and return it.

    Raises:
        KeyError: there is none of that name.
    """
    module, _, attribute = _PROVIDED[kind][name].partition(":")
    return getattr(import_module(module), attribute)
