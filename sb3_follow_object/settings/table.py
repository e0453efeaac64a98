"""Every setting with its values, default and sentence: for the command line and for the docs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from ..common.suggestions import did_you_mean
from .fields import Group, Setting, settings_of
from .learning import (
    AlgorithmSettings,
    AuxiliarySettings,
    CherSettings,
    InverseSettings,
    PolicySettings,
    PredictorSettings,
    ReplaySettings,
    RndSettings,
    SldrSettings,
)
from .run_config import RunConfig
from .stages import CurriculumSettings, ReachSettings, StageSettings

# Each with the dotted name that its settings stand under.
GROUPS: dict[type[Group], str] = {
    RunConfig: "",
    StageSettings: "",
    CurriculumSettings: "curriculum.",
    ReachSettings: "reach.",
    AlgorithmSettings: "",
    ReplaySettings: "replay_buffer_kwargs.",
    CherSettings: "replay_buffer_kwargs.cher.",
    PolicySettings: "policy_kwargs.",
    AuxiliarySettings: "auxiliary.",
    RndSettings: "auxiliary.",
    SldrSettings: "auxiliary.",
    PredictorSettings: "predictor_fit.",
    InverseSettings: "inverse_fit.",
}

# What config.json and Python have and data has not, and what says it there.
_OTHERWISE = {
    "total_timesteps": "say n_timesteps, or --steps",
    "seed": "say --seed",
    "env_id": "say --env",
    "method": "say --method",
    "algorithm": "say what it holds alone, e.g. noise_std for algorithm.noise_std",
    "settings": "say what it holds alone, e.g. n_envs for settings.n_envs",
}


def listed(group: type[Group]) -> list[Setting]:
    """Return what data can say of a group, without what a group before it says already."""
    shared = settings_of(AuxiliarySettings) if group is not AuxiliarySettings else {}
    known = settings_of(group).items()
    return [each for name, each in known if each.data and not _is_of(shared, name, each)]


def _is_of(shared: dict[str, Setting], name: str, each: Setting) -> bool:
    return name in shared and shared[name].sentence == each.sentence


def values(each: Setting) -> str:
    """Return a setting's type, range and unit."""
    kind = each.kind.removeprefix("a ") or "anything"
    return " ".join(part for part in (kind, each.range, each.unit) if part)


def default(each: Setting) -> str:
    """Return a setting's default as YAML has it, or what None stands for."""
    if each.default is None:
        return each.none or "none"
    return json.dumps(each.default).strip('"')


def lines(name: str | None = None, preset: Mapping[str, str] | None = None) -> list[str]:
    """Return what there is to say of every setting, or of those with this name or below it.

    Args:
        name: dotted, as --set takes it, e.g. "curriculum" or "curriculum.p".
        preset: what to say of a preset's values, by dotted names, where they are not the defaults.

    Raises:
        ValueError: there is none of that name, with the nearest that there is.
    """
    found = by_name()
    wanted = found if name is None else _below(found, name)
    if not wanted:
        first = str(name).partition(".")[0]
        meant = _otherwise(first) or _nested(str(name)) or did_you_mean(str(name), found)
        raise ValueError(f"there is no setting {name!r}{meant}")
    said = preset or {}
    return [
        f"{dotted}: {values(each)}, default {default(each)}"
        + (f", {said[dotted]}" if said.get(dotted, "") else "")
        + f"; {each.sentence}"
        for dotted, each in wanted.items()
    ]


def check_dotted(names: Iterable[str], where: str) -> None:
    """Raise a ValueError for a name that a setting has in its group alone, or elsewhere.

    Args:
        names: that stand for themselves, without their group's.
        where: beginning of the sentence.
    """
    known = by_name()
    for name in names:
        if name not in known and (meant := _otherwise(name) or _nested(name)):
            raise ValueError(f"{where} has no setting {name!r}{meant}")


def _otherwise(name: str) -> str:
    """The end of a sentence about a name that something else than data has; "" of others."""
    return f"; {_OTHERWISE[name]}" if name in _OTHERWISE else ""


def _nested(name: str) -> str:
    """The end of a sentence about a name that only settings of groups have; "" where none has."""
    meant = [repr(dotted) for dotted in by_name() if dotted.endswith(f".{name}")]
    return f"; did you mean {' or '.join(meant)}?" if meant else ""


def by_name() -> dict[str, Setting]:
    """Return every setting by its dotted name, as --set takes it."""
    return {
        f"{prefix}{each.name}": each for group, prefix in GROUPS.items() for each in listed(group)
    }


def _below(found: dict[str, Setting], name: str) -> dict[str, Setting]:
    """Return a setting with all below it; what is in the object's algorithm is in the robot's."""
    first, _, rest = name.partition(".")
    if first == "object_algorithm" and rest:
        return {f"{first}.{dotted}": each for dotted, each in _below(found, rest).items()}
    return {n: each for n, each in found.items() if f"{n}.".startswith(f"{name}.")}
