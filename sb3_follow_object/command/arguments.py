"""What the arguments of several commands mean, and which of them exclude each other."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# Nothing heavier here: --help must not wait for torch.

# The settings that a flag gives; others of them may be said with --set than with the flag.
_FLAGS = {
    "steps": ("n_timesteps",),
    "n_envs": ("n_envs",),
    "threads": ("n_threads", "torch_threads"),
}


def overrides_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that --set and the flags give.

    Raises:
        ValueError: a flag says one thing and --set another, or --set is given no setting.
    """
    from ..settings.presets import parse_override

    said = dict(parse_override(text) for text in args.set)
    flags: dict[str, Any] = {}
    for flag, names in _FLAGS.items():
        given = getattr(args, flag)
        check_agreed(flag, given, said)
        if given is not None:
            flags |= dict.fromkeys(names, given)
    return flags | said


def check_agreed(flag: str, given: int | None, said: Mapping[str, Any]) -> None:
    """Raise a ValueError where a flag is given and --set leaves nothing of it.

    Args:
        flag: one of `_FLAGS`.
        given: with it; None, it is not given.
        said: what --set gives.
    """
    names = _FLAGS[flag]
    if given is not None and all(said.get(name, given) != given for name in names):
        others = " ".join(f"{name}={said[name]}" for name in names)
        raise ValueError(
            f"--{flag.replace('_', '-')} is {given}, but --set says {others}; give one of them"
        )


def policy_of(run: Path) -> Path:
    """Return the file of a run's policy.

    Raises:
        ValueError: the folder holds none.
    """
    from ..runs.run_folder import POLICY, RESULT

    path = run / POLICY
    if not path.exists():
        ended = (run / RESULT).exists()
        why = "the run has ended, but its policy is not" if ended else "no policy has been"
        raise ValueError(f"there is no file {path}: {why} kept there")
    return path
