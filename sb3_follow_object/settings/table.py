"""Every setting with its values, default and sentence: for the command line and for the docs.

`python -m sb3_follow_object.settings.table docs/runs.md` writes the tables of the docs anew.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

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
BEGIN, END = "<!-- settings: written by", "<!-- settings: end -->\n"


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


def markdown() -> str:
    """Return the tables of the docs."""
    parts = []
    for group in GROUPS:
        rows = [
            f"| `{each.name}` | {values(each)} | {default(each)} | {each.sentence} |\n"
            for each in listed(group)
        ]
        head = f"{group.title}:\n\n| name | values | default | |\n|---|---|---|---|\n"
        parts.append(head + "".join(rows))
    return "\n".join(parts)


def with_tables(text: str) -> str:
    """Return a page with the tables between its marks written anew."""
    before, mark, rest = text.partition(BEGIN)
    if not mark or END not in rest:
        raise ValueError(f"there are no marks {BEGIN} ... {END.strip()}")
    comment = rest[: rest.index("\n") + 1]
    return f"{before}{mark}{comment}\n{markdown()}\n{END}{rest.partition(END)[2]}"


def lines(name: str | None = None) -> list[str]:
    """Return what there is to say of every setting, or of those with this name or below it.

    Args:
        name: dotted, as --set takes it, e.g. "curriculum" or "curriculum.p".

    Raises:
        ValueError: there is none of that name, with the nearest that there is.
    """
    found = {
        f"{prefix}{each.name}": each for group, prefix in GROUPS.items() for each in listed(group)
    }
    wanted = found if name is None else _below(found, name)
    if not wanted:
        raise ValueError(f"there is no setting {name!r}{did_you_mean(str(name), found)}")
    return [
        f"{dotted}: {values(each)}, default {default(each)}; {each.sentence}"
        for dotted, each in wanted.items()
    ]


def _below(found: dict[str, Setting], name: str) -> dict[str, Setting]:
    """Return a setting with all below it; what is in the object's algorithm is in the robot's."""
    first, _, rest = name.partition(".")
    if first == "object_algorithm" and rest:
        return {f"{first}.{dotted}": each for dotted, each in _below(found, rest).items()}
    return {n: each for n, each in found.items() if f"{n}.".startswith(f"{name}.")}


if __name__ == "__main__":
    for file in map(Path, sys.argv[1:]):
        file.write_text(with_tables(file.read_text()))
