"""Settings with their defaults and what the default preset has instead: the docs' tables, lines.

`python -m sb3_follow_object.settings.docs_tables docs/runs.md` writes them anew.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from ..envs import TASKS
from .presets import run_config
from .run_config import flat
from .table import GROUPS, by_name, default, lines, listed, values

BEGIN, END = "<!-- settings: written by", "<!-- settings: end -->\n"
SHOWN = "PnPSimpleV2"  # whose preset the tables show
EXAMPLE = "PnPShelf"  # whose preset lines show, where it is not every task's


def markdown() -> str:
    """Return the tables of the docs."""
    parts, preset = [], _preset(SHOWN)
    for group, prefix in GROUPS.items():
        rows = [
            f"| `{each.name}` | {values(each)} | {default(each)} "
            f"| {preset.get(prefix + each.name, '')} | {each.sentence} |\n"
            for each in listed(group)
        ]
        head = f"{group.title}:\n\n| name | values | default | `fo` | |\n|---|---|---|---|---|\n"
        parts.append(head + "".join(rows))
    return "\n".join(parts)


def with_tables(text: str) -> str:
    """Return a page with the tables between its marks written anew."""
    before, mark, rest = text.partition(BEGIN)
    if not mark or END not in rest:
        raise ValueError(f"there are no marks {BEGIN} ... {END.strip()}")
    comment = rest[: rest.index("\n") + 1]
    return f"{before}{mark}{comment}\n{markdown()}\n{END}{rest.partition(END)[2]}"


def lines_with_preset(name: str | None = None) -> list[str]:
    """Return `lines` of the settings, each with what FO's default preset has instead."""
    presets = {task: _preset(task) for task in (EXAMPLE, *TASKS)}
    said = {}
    for dotted in {dotted: None for preset in presets.values() for dotted in preset}:
        task = next(task for task, preset in presets.items() if dotted in preset)
        value = presets[task][dotted]
        everywhere = all(preset.get(dotted) == value for preset in presets.values())
        said[dotted] = f"fo's preset {value}" + (f" on {task}, by task" if not everywhere else "")
    return lines(name, said)


def _preset(task: str) -> dict[str, str]:
    """Return what FO's default preset sets otherwise than the classes do, by dotted names."""
    config = run_config(f"FollowObject/{task}-v0")
    said = {name.removeprefix("algorithm."): value for name, value in flat(config.settings).items()}
    said |= {name: value for name, value in config.settings.items() if value == {}}
    said |= {"n_timesteps": config.total_timesteps}
    said |= {name: getattr(config, name) for name in ("eval_every", "solved_at")}
    defaults = {name: default(each) for name, each in by_name().items()}
    words = {name: json.dumps(value).strip('"') for name, value in said.items()}
    return {
        name: word
        for name, word in words.items()
        if defaults.get(name.removeprefix("object_algorithm.")) != word
    }


if __name__ == "__main__":
    for file in map(Path, sys.argv[1:]):
        file.write_text(with_tables(file.read_text("utf-8")), "utf-8")
