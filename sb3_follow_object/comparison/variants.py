"""Which runs are seeds of one method, and how others of the same method are told apart."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..envs.task_table import BUILT_IN
from ..runs.run_folder import CONFIG, RESULT, task_label
from ..settings.fields import settings_of
from ..settings.presets import PRESETS, read_config, run_config
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

    What is the preset's own on a task goes without saying, so that one odd run does not rename the
    others. What is said on one task is said on all of them where a run has the same value, so that
    one choice of settings has one name.
    """
    of_methods: dict[str, dict[Path, RunConfig]] = {}
    for folder, config in configs.items():
        of_methods.setdefault(config.method, {})[folder] = config
    return {
        folder: words
        for method, runs in of_methods.items()
        for folder, words in _words_of_method(method, runs).items()
    }


def _words_of_method(method: str, configs: Mapping[Path, RunConfig]) -> dict[Path, str]:
    """Return `words_apart` of the runs of one method."""
    settings = {folder: decisive(config) for folder, config in configs.items()}
    tasks: dict[str, list[Path]] = {}
    for folder, config in configs.items():
        tasks.setdefault(config.env_id, []).append(folder)
    apart = {task: names_apart([settings[run] for run in runs]) for task, runs in tasks.items()}
    if not any(apart.values()):
        return dict.fromkeys(configs, "")
    usual = _usual_words(method, {task: [settings[f] for f in of] for task, of in tasks.items()})
    unusual = {f: _words(settings[f]) - usual[config.env_id] for f, config in configs.items()}
    said = dict.fromkeys(
        word
        for task, runs in tasks.items()
        for name in apart[task]
        for run in runs
        if (word := in_words(settings[run], [name])) in unusual[run]
    )
    return {run: ", ".join(word for word in said if word in its) for run, its in unusual.items()}


def _usual_words(
    method: str, of_tasks: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, set[str]]:
    """Return by task what goes without saying of a method's runs: the words of its preset.

    Args:
        method: its name.
        of_tasks: the settings of its runs by task. The preset is the one that they have most of; of
            what a run has not got nothing is said, so there the preset's is no longer usual.
    """
    found: list[dict[str, set[str]]] = []
    for preset in PRESETS:
        words: dict[str, set[str]] = {}
        for task, runs in of_tasks.items():
            own = _preset_settings(task, method, preset)
            words[task] = _words({n: own[n] for n in own if all(n in each for each in runs)})
        found.append(words)

    def shared(words: Mapping[str, set[str]]) -> int:
        return sum(len(words[t] & _words(run)) for t, runs in of_tasks.items() for run in runs)

    return max(found, key=shared)


def _preset_settings(task: str, method: str, preset: str) -> dict[str, Any]:
    """Return what a run of a preset hangs on, nothing where there is no such preset.

    Nothing of tasks of others either: their presets cannot be told without importing them.
    """
    if task not in BUILT_IN:
        return {}
    try:
        return decisive(run_config(task, method=method, preset=preset))
    except ValueError:
        return {}


def _words(settings: Mapping[str, Any]) -> set[str]:
    return {in_words(settings, [name]) for name in settings}
