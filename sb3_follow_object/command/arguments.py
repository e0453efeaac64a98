"""What the arguments of several commands mean, and which of them exclude each other."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

# Nothing heavier here: --help must not wait for torch.

# The settings that a flag gives; others of them may be said with --set than with the flag.
_FLAGS = {
    "steps": ("n_timesteps",),
    "n_envs": ("n_envs",),
    "threads": ("n_threads", "torch_threads"),
}


def shell_line(words: Sequence[str]) -> str:
    """Return a command as one line of a shell, in letters that every file can hold.

    Words with others, such as line breaks or bytes that are no text, are written as bash's $'...'.
    """
    return " ".join(shlex.quote(word) if word.isprintable() else _escaped(word) for word in words)


def _escaped(word: str) -> str:
    plain = {byte: chr(byte) for byte in range(32, 127) if byte not in b"'\\"}
    return "$'" + "".join(plain.get(byte, f"\\x{byte:02x}") for byte in os.fsencode(word)) + "'"


def make_absolute(args: argparse.Namespace) -> None:
    """Make paths those that they are now: making an environment may change the working folder."""
    for name, value in vars(args).items():
        if isinstance(value, Path):
            setattr(args, name, value.absolute())
        elif isinstance(value, list):
            setattr(args, name, [v.absolute() if isinstance(v, Path) else v for v in value])


def said_with_set(texts: Iterable[str]) -> dict[str, Any]:
    """Return the settings that --set gives.

    Raises:
        ValueError: it is given no setting, or one twice: by itself, or within another.
    """
    from ..settings.presets import parse_override

    said: dict[str, Any] = {}
    for text in texts:
        name, value = parse_override(text)
        for other in said:
            if name == other:
                raise ValueError(f"--set gives {name!r} twice; give it once")
            outer, inner = sorted((name, other), key=len)
            if inner.startswith(f"{outer}."):
                raise ValueError(f"--set gives {inner!r} and {outer!r}, which holds it; give one")
        said[name] = value
    return said


def overrides_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that --set and the flags give.

    Raises:
        ValueError: a flag says one thing and --set another, or as `said_with_set`.
    """
    said = said_with_set(args.set)
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
