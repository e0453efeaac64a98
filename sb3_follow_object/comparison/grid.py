"""A comparison's grid: the runs that it wants, and how each of them is made."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium as gym

from ..common.reports import Report
from ..common.suggestions import did_you_mean
from ..envs import IDS, TASKS
from ..envs.goal_envs import check_task
from ..runs.run_folder import CONFIG, difference, task_label
from ..settings.fields import settings_of
from ..settings.learning import AuxiliarySettings
from ..settings.methods import METHODS
from ..settings.presets import load_config, run_config
from ..settings.run_config import RunConfig
from .cells import Cell, Settings, file_name, is_empty, unread
from .ledger import check_settings
from .variants import read_configs, run_folders

# A run's share of the machine; what it learns does not hang on it but for rounding.
_SHARES = ("torch_threads", "settings.n_threads", "checkpoint_minutes")

# The paper's epoch is 50 cycles of 38 episodes, after which 380 episodes are tested.
_EPOCH_EPISODES, _PAPER_EPISODES = 1900, 380
_TO_THE_END = {"solved_at": 0.0}  # methods are compared after equally many steps
# Groups of settings that some methods have and that would make another method of the others.
_MARKS = ("reach", "auxiliary", "replay_buffer_kwargs.cher")


def plan(
    folder: str | os.PathLike[str],
    tasks: Sequence[str],
    methods: Sequence[str],
    seeds: Sequence[int],
    settings: Settings,
    threads: int = 1,
    report: Report = lambda sentence: None,
) -> list[Cell]:
    """Return the runs of a grid, a seed's before the next one's, without touching the folder.

    Args:
        folder: of the results; may hold a part of the grid already, and more than it.
        tasks: short names or ids of environments with goals.
        methods: names of methods.
        seeds: >= 0.
        settings: of all runs.
        threads: of each run's simulation and of its PyTorch, where the settings do not say.
        report: called with a sentence where looking at a task of others may take minutes.

    Raises:
        ValueError: an unknown name, settings that contradict each other, two tasks whose runs would
            have one folder, or the folder holds results of other settings or one run twice.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; give a folder for the results")
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"there is no method {method!r}{did_you_mean(method, METHODS)}")
    ids: dict[str, str] = {}
    for env_id in map(_env_id, tasks):  # one name is one task, with a module before its id or not
        ids.setdefault(task_label(env_id), env_id)
    _check_apart(ids, methods)
    of_some = _without_networks(settings, methods)
    read = {(e, m): _read_by(e, m, of_some, report) for e in ids.values() for m in methods}
    for name in settings.overrides or {}:
        if not any(name in (its.overrides or {}) for its in read.values()):
            raise ValueError(f"--set {name} does nothing: none of {', '.join(methods)} reads it")
    check_settings(folder, settings)
    if folder.exists():
        read_configs(run_folders(folder))  # or no table could be written in the end
    cells = []
    for seed in dict.fromkeys(seeds):
        for task, env_id in ids.items():
            for method in dict.fromkeys(methods):
                own = read[env_id, method]
                config = _config(env_id, method, seed, own, threads)
                path = folder / f"{_begins(task, method)}-{seed}"
                command = _command(path, config, own)
                cell = Cell(path, task, config, command)
                kept = _kept_config(cell)
                if kept is not None:
                    cell = replace(cell, config=kept, command=_command(path, kept, own))
                cells.append(cell)
    return cells


def _check_apart(ids: Mapping[str, str], methods: Sequence[str]) -> None:
    """Raise a ValueError where runs of two tasks would have one folder."""
    kept: dict[str, str] = {}
    for task, env_id in ids.items():
        for method in dict.fromkeys(methods):
            begins = _begins(task, method)
            other = kept.setdefault(begins, env_id)
            if other != env_id:
                raise ValueError(
                    f"{other!r} and {env_id!r} would both be kept in {begins}-<seed>; "
                    "compare them in folders of their own"
                )


def _begins(task: str, method: str) -> str:
    """Return how the names of a task's and a method's folders begin; a seed comes after it."""
    return f"{file_name(task)}-{method}"


def _without_networks(settings: Settings, methods: Sequence[str]) -> Settings:
    """Return the settings without those of networks that only SLDR reads, where no method has it.

    Where one has it the others keep them: they share the object's stage, which fits the networks.
    """
    if any("sldr" in method.split("-") for method in methods):
        return settings
    given = settings.overrides or {}
    kept = {name: given[name] for name in given if name.partition(".")[0] != "inverse_fit"}
    return replace(settings, overrides=kept)


def _read_by(env_id: str, method: str, settings: Settings, report: Report) -> Settings:
    """Return the settings without the overrides that a method does not read."""
    given = settings.overrides or {}
    plain = {name: given[name] for name in given if name.rpartition(".")[0] not in _MARKS}
    config = _config(env_id, method, 0, replace(settings, overrides=plain), 1, report)
    own = {name: given[name] for name in given if name in plain or _has(config, name)}
    if len(own) > len(plain):
        config = _config(env_id, method, 0, replace(settings, overrides=own), 1)
    read = {name: value for name, value in own.items() if unread(name, config) is None}
    return replace(settings, overrides=read)


def _has(config: RunConfig, setting: str) -> bool:
    """Whether a method has the group that a setting is in; given one, it would be another method.

    Args:
        config: of the method, without changes to such groups.
        setting: its dotted name.
    """
    group, _, name = setting.rpartition(".")
    if group == "reach":
        return config.settings.get("reach") is not None
    algorithm = config.settings.get("algorithm") or {}
    if group == "replay_buffer_kwargs.cher":
        return (algorithm.get("replay_buffer_kwargs") or {}).get("cher") is not None
    reward = algorithm.get("auxiliary")
    if reward is None:
        return False
    own, of_any = settings_of(AuxiliarySettings.of(reward)), settings_of(AuxiliarySettings.of({}))
    return name in own or name not in of_any  # one that no reward has is refused by its name


def _env_id(task: str) -> str:
    """Return the id that a short name or an id means."""
    if task in TASKS:
        return f"FollowObject/{task}-v0"
    # Without a version it was meant as one of the short names.
    if task not in IDS and "-v" not in task and task not in gym.registry:
        raise ValueError(f"there is no task {task!r}{did_you_mean(task, TASKS)}")
    check_task(task)
    return task


def _config(
    env_id: str,
    method: str,
    seed: int,
    settings: Settings,
    threads: int,
    report: Report = lambda sentence: None,
) -> RunConfig:
    overrides: dict[str, Any] = {"n_threads": threads, "torch_threads": threads, **_TO_THE_END}
    if settings.steps is not None:
        overrides["n_timesteps"] = settings.steps
    overrides |= _paper_rhythm(env_id, settings)
    overrides |= settings.overrides or {}
    return run_config(
        env_id,
        method=method,
        preset=settings.preset,
        seed=seed,
        overrides=overrides,
        report=report,
    )


def _paper_rhythm(env_id: str, settings: Settings) -> dict[str, int]:
    """Return the paper's rhythm of validations, where the settings ask for it."""
    if not settings.paper_evaluation:
        return {}
    horizon = gym.spec(env_id.rpartition(":")[2]).max_episode_steps
    assert horizon is not None  # check_task has seen to it
    rhythm = {"eval_every": _EPOCH_EPISODES * horizon, "n_eval_episodes": _PAPER_EPISODES}
    for name in rhythm:
        if name in (settings.overrides or {}):
            raise ValueError(f"--paper-evaluation decides {name}; leave it or --set {name} out")
    return rhythm


def _command(path: Path, config: RunConfig, settings: Settings) -> str:
    words = ["sb3-follow-object", "train", "--run", str(path), "--env", config.full_id]
    words += ["--method", config.method, "--seed", str(config.seed)]
    words += ["--threads", str(config.torch_threads)]
    if settings.steps is not None:
        words += ["--steps", str(settings.steps)]
    if settings.preset != "default":
        words += ["--preset", settings.preset]
    changes: dict[str, Any] = {**_TO_THE_END, **_paper_rhythm(config.env_id, settings)}
    changes |= settings.overrides or {}
    words += ["--set", *(f"{name}={json.dumps(value)}" for name, value in changes.items())]
    return shlex.join(words)


def _kept_config(cell: Cell) -> RunConfig | None:
    """Return the configuration of the run that the cell's folder holds already."""
    if not (cell.folder / CONFIG).exists():
        if cell.folder.exists() and not is_empty(cell.folder):
            raise ValueError(f"{cell.folder} is not empty but holds no run; move it away")
        return None
    kept = load_config(cell.folder)
    different = difference(_without_shares(kept), _without_shares(cell.config))
    if different is not None:
        name, old, new = different
        raise ValueError(
            f"the run in {cell.folder} has {name} {old!r}, not {new!r}; compare with the same "
            "settings or in another folder"
        )
    return kept


def _without_shares(config: RunConfig) -> dict[str, Any]:
    plain = asdict(config)
    for name in _SHARES:
        *outer, last = name.split(".")
        inner = plain
        for part in outer:
            inner = inner[part]
        inner.pop(last, None)
    return plain
