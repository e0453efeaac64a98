"""Which runs are seeds of one method, and how others of the same method are told apart."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..runs.run_folder import CONFIG, RESULT, task_label
from ..settings.fields import settings_of
from ..settings.presets import read_config
from ..settings.run_config import RunConfig, flat

# A run's share of the machine and what is kept of it: they change no result.
_WITHOUT_EFFECT = {"n_threads", "torch_threads", "checkpoint_minutes"}
_WITHOUT_EFFECT |= {"keep_checkpoints", "keep_last_checkpoint"}


def run_folders(results: Path) -> list[Path]:
    """Return the run folders in a folder of results, links behind all others."""
    found = [path for path in results.iterdir() if (path / CONFIG).exists()]
    seen = [path for path in found if not path.name.startswith(".")]
    return sorted(seen, key=lambda path: (path.is_symlink(), path.name))


def read_configs(folders: Iterable[Path]) -> dict[Path, RunConfig]:
    """Return the configurations of run folders, of each folder once, whatever links lead to it.

    Args:
        folders: of two names of one folder the first is taken.

    Raises:
        ValueError: a folder holds no run, or two hold the same finished one.
    """
    places: dict[Path, Path] = {}
    for folder in folders:
        places.setdefault(folder.resolve(), folder)
    configs = {folder: read_config(folder) for folder in places.values()}
    finished: dict[str, Path] = {}
    for folder, config in configs.items():
        if not (folder / RESULT).exists():
            continue
        which = [config.env_id, config.method, config.seed, decisive(config)]
        other = finished.setdefault(json.dumps(which, sort_keys=True), folder)
        if other != folder:
            raise ValueError(
                f"{other} and {folder} are both seed {config.seed} of {config.method} on "
                f"{task_label(config.env_id)} with the same settings, and would count twice; "
                "leave one of them out"
            )
    return configs


def decisive(config: RunConfig) -> dict[str, Any]:
    """Return what a run's result hangs on besides task, method and seed, by dotted names."""
    own = {name: getattr(config, each.field) for name, each in settings_of(RunConfig).items()}
    named = {**own, **flat(config.settings)}
    return {name: value for name, value in named.items() if name not in _WITHOUT_EFFECT}


def names_apart(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of the settings in which several runs' differ; having none is another."""
    names = dict.fromkeys(name for each in settings for name in each)
    return [name for name in names if len({repr(each.get(name, "")) for each in settings}) > 1]


def in_words(settings: Mapping[str, Any], names: Iterable[str]) -> str:
    """Return those of a run's settings that have these names, in words."""
    return ", ".join(f"{name}={json.dumps(settings[name])}" for name in names if name in settings)


def words_apart(configs: Mapping[Path, RunConfig]) -> dict[Path, str]:
    """Return in words, for each run, the settings in which runs of its method differ on a task.

    What differs on one task is said on all of them, so that one choice of settings has one name.
    """
    settings = {folder: decisive(config) for folder, config in configs.items()}
    alike: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for folder, config in configs.items():
        alike.setdefault((config.method, config.env_id), []).append(settings[folder])
    names: dict[str, dict[str, None]] = {}  # by method
    for (method, _), group in alike.items():
        names.setdefault(method, {}).update(dict.fromkeys(names_apart(group)))
    return {
        folder: in_words(settings[folder], names[config.method])
        for folder, config in configs.items()
    }
