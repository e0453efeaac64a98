"""The methods that have presets; kept apart from what needs torch, for the command line's help."""

from __future__ import annotations

from collections.abc import Iterable

METHODS = ("fo", "her", "shaped", "rnd", "sldr", "cher", "fo-sldr", "rher")
WITHOUT_PAPER = ("rher",)  # the paper has no such rival, so there is no preset of its settings
# Stock algorithms, which have no presets here, and the files that rl_zoo3 trains them with.
STOCK = {"ddpg": "ddpg.yml", "td3": "ddpg.yml", "sac": "sac.yml", "tqc": "tqc.yml"}


def who_trains(name: str) -> str:
    """Say who trains a stock algorithm; "" where a name is not one's."""
    file = STOCK.get(str(name).lower())
    if file is None:
        return ""
    return f"rl_zoo3 trains stock algorithms, {name} with zoo_configs/{file} (docs/sb3.md)"


def check_methods(names: Iterable[str]) -> None:
    """Raise a ValueError for a method that another program trains."""
    for name in names:
        if who := who_trains(name):
            raise ValueError(f"there is no method {name!r}; {who}")
