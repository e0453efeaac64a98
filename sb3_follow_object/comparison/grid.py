"""A comparison's grid: the runs that it wants, where they lie and how far each one is."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym

from ..common.files import atomic_write
from ..common.suggestions import did_you_mean
from ..envs import IDS, TASKS
from ..envs.goal_envs import check_task
from ..object_stage.sldr import reads_object_networks
from ..runs.object_stage_files import OBJECT_STAGE
from ..runs.run_folder import CONFIG, RESULT, claim, difference
from ..settings.methods import METHODS
from ..settings.presets import load_config, run_config
from ..settings.run_config import RunConfig

GRID, OBJECT, LOGS = "grid.json", "object", "logs"
FINISHED, FAILED, UNFINISHED, NOT_RUN = "finished", "failed", "unfinished", "not run"
ATTEMPTS = 2  # a run that failed is taken up again once
_FORMAT = 1

# A run's share of the machine; what it learns does not hang on it but for rounding.
_SHARES = ("torch_threads", "settings.n_threads", "checkpoint_minutes")

# The paper's epoch is 50 cycles of 38 episodes, after which 380 episodes are tested.
_EPOCH_EPISODES, _PAPER_EPISODES = 1900, 380


@dataclass(frozen=True)
class Settings:
    """What all runs of a grid have in common.

    Attributes:
        steps: env steps of each run, >= 1; None leaves them to the preset.
        preset: of the package's settings, "default" or "paper".
        overrides: settings by their dotted names, as `run_config` takes them.
        paper_evaluation: validate on 380 episodes every 1,900 episodes' env steps, the epoch of
            the paper (section 5.3), in place of the settings' own rhythm.
    """

    steps: int | None = None
    preset: str = "default"
    overrides: Mapping[str, Any] | None = None
    paper_evaluation: bool = False


@dataclass(frozen=True)
class Cell:
    """One run of a grid.

    Attributes:
        folder: of the run.
        task: its short name, e.g. PnPShelf, or another environment's id.
        config: of the run; once the folder holds a run, that run's.
        command: the command line that makes the same run by itself.
    """

    folder: Path
    task: str
    config: RunConfig
    command: str

    @property
    def name(self) -> str:
        """Name of the cell, which is its folder's."""
        return self.folder.name

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.config.method

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.config.seed

    @property
    def finished(self) -> bool:
        """Whether the run has its result."""
        return (self.folder / RESULT).exists()

    @property
    def stage(self) -> Path | None:
        """Folder of the object stage that the run shares; None where it needs none."""
        if not needs_object_stage(self.config):
            return None
        return self.folder.parent / OBJECT / f"{_file_name(self.task)}-{self.seed}"


def plan(
    folder: str | os.PathLike[str],
    tasks: Sequence[str],
    methods: Sequence[str],
    seeds: Sequence[int],
    settings: Settings,
    threads: int = 1,
) -> list[Cell]:
    """Return the runs of a grid, a seed's before the next one's, without touching the folder.

    Args:
        folder: of the results; may hold a part of the grid already, and more than it.
        tasks: short names or ids of environments with goals.
        methods: names of methods.
        seeds: >= 0.
        settings: of all runs.
        threads: of each run's simulation and of its PyTorch, where the settings do not say.

    Raises:
        ValueError: an unknown name, or the folder holds results of other settings.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; give a folder for the results")
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"there is no method {method!r}{did_you_mean(method, METHODS)}")
    ids = {task_name(env_id): env_id for env_id in map(_env_id, tasks)}
    _check_settings(folder, settings)
    cells = []
    for seed in dict.fromkeys(seeds):
        for task, env_id in ids.items():
            for method in dict.fromkeys(methods):
                config = _config(env_id, method, seed, settings, threads)
                path = folder / f"{_file_name(task)}-{method}-{seed}"
                command = _command(path, config, settings)
                cell = Cell(path, task, config, command)
                kept = _kept_config(cell)
                if kept is not None:
                    cell = replace(cell, config=kept, command=_command(path, kept, settings))
                cells.append(cell)
    return cells


def task_name(env_id: str) -> str:
    """Return the short name of one of the package's tasks, or another environment's id."""
    name = env_id.rpartition(":")[2].removeprefix("FollowObject/").removesuffix("-v0")
    return name if name in TASKS else env_id


def needs_object_stage(config: RunConfig) -> bool:
    """Whether a run begins with what its object learns alone."""
    algorithm = config.settings.get("algorithm") or {}
    return bool(config.settings.get("imagine", True)) or reads_object_networks(algorithm)


def stage_settings(config: RunConfig) -> dict[str, Any]:
    """Return the settings that decide what a run's object stage comes to."""
    return {
        name: value
        for name, value in config.settings.items()
        if name.startswith("object_") or name.endswith("_fit") or name == "n_paths"
    }


def shared_stage(cell: Cell) -> Path | None:
    """Make the folder of the object stage that the cell's run will share, and return it.

    Returns:
        None where the run needs none or has begun already, and where the one of its task and seed
        is another's, with other settings: the run then makes its own.
    """
    stage = cell.stage
    if stage is None or (cell.folder / CONFIG).exists():
        return None
    if not (stage / CONFIG).exists():
        # A whole one, with F_phi, serves the runs that do not imagine goals as well.
        settings = {**cell.config.settings, "imagine": True}
        _claim_whole(stage, replace(cell.config, settings=settings))
    same = stage_settings(load_config(stage)) == stage_settings(cell.config)
    return stage if same else None


def stage_is_ready(stage: Path) -> bool:
    """Whether an object stage has ended: this file is its last."""
    return (stage / OBJECT_STAGE).exists()


def prepare(cell: Cell, stage: Path | None) -> None:
    """Make the cell's folder, ready to be resumed, with a copy of the object stage if one is given.

    The stage's env steps are told with it, so each run that uses it counts them.
    """
    if not (cell.folder / CONFIG).exists():
        _claim_whole(cell.folder, cell.config, stage, cell.command)


def _claim_whole(
    folder: Path, config: RunConfig, stage: Path | None = None, command: str = ""
) -> None:
    """Make a run's folder appear as a whole: a part of one could not be resumed."""
    new = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    if _is_empty(folder):
        shutil.rmtree(folder)
    claim(new, config, command)
    for path in stage.iterdir() if stage else ():
        if path.is_dir():
            shutil.copytree(path, new / path.name)
        elif not (new / path.name).exists() and not path.name.startswith((".", "checkpoint")):
            shutil.copyfile(path, new / path.name)
    os.replace(new, folder)


class Ledger:
    """The grid file: the settings, the cells that were ever asked for, and their failures.

    Args:
        folder: of the results; is created.
        settings: of all runs, which `plan` has checked.
        cells: the runs that are wanted now; those of the file stay.
        retry_failed: forget earlier failures of these cells.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        cells: Iterable[Cell],
        retry_failed: bool = False,
    ):
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / GRID
        self._content = read_grid(folder) or {"format": _FORMAT, **_plain(settings), "cells": {}}
        self.cells: dict[str, dict[str, Any]] = self._content["cells"]
        for cell in cells:
            row = {"task": cell.task, "method": cell.method, "seed": cell.seed}
            entry = self.cells.setdefault(cell.name, {**row, "failures": 0, "error": None})
            if retry_failed:
                entry |= {"failures": 0, "error": None}
        self._write()

    def failed(self, name: str) -> bool:
        """Whether a cell has used up its attempts."""
        return bool(self.cells[name]["failures"] >= ATTEMPTS)

    def note_failure(self, name: str, error: str, final: bool = False) -> None:
        """Count a failure of a cell; a final one uses up its attempts."""
        entry = self.cells[name]
        entry["failures"] = ATTEMPTS if final else entry["failures"] + 1
        entry["error"] = error
        self._write()

    def note_success(self, name: str) -> None:
        """Forget a cell's failure: the second attempt came through."""
        if self.cells[name]["failures"]:
            self.cells[name] |= {"failures": 0, "error": None}
            self._write()

    def _write(self) -> None:
        atomic_write(self._path, json.dumps(self._content, indent=1).encode())


def read_grid(folder: Path) -> dict[str, Any] | None:
    """Return the grid file's content, None where the folder has no such file.

    Raises:
        ValueError: the file is damaged.
    """
    path = folder / GRID
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_text())
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is {content['format']!r}, not {_FORMAT}")
        for cell in content["cells"].values():
            str(cell["task"]), str(cell["method"]), int(cell["seed"]), int(cell["failures"])
            str(cell["error"])
    except (OSError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not the file of a comparison's grid ({error})") from error
    return dict(content)


def _env_id(task: str) -> str:
    """Return the id that a short name or an id means."""
    if task in TASKS:
        return f"FollowObject/{task}-v0"
    # Without a version it was meant as one of the short names.
    if task not in IDS and "-v" not in task and task not in gym.registry:
        raise ValueError(f"there is no task {task!r}{did_you_mean(task, TASKS)}")
    check_task(task)
    return task


def _config(env_id: str, method: str, seed: int, settings: Settings, threads: int) -> RunConfig:
    # None ends early: methods are compared after equally many steps.
    overrides: dict[str, Any] = {
        "n_threads": threads,
        "torch_threads": threads,
        "solved_at": 0.0,
    }
    if settings.steps is not None:
        overrides["n_timesteps"] = settings.steps
    if settings.paper_evaluation:
        overrides |= _paper_rhythm(env_id)
    overrides |= settings.overrides or {}
    return run_config(env_id, method=method, preset=settings.preset, seed=seed, overrides=overrides)


def _paper_rhythm(env_id: str) -> dict[str, int]:
    horizon = gym.spec(env_id.rpartition(":")[2]).max_episode_steps
    assert horizon is not None  # check_task has seen to it
    return {"eval_every": _EPOCH_EPISODES * horizon, "n_eval_episodes": _PAPER_EPISODES}


def _command(path: Path, config: RunConfig, settings: Settings) -> str:
    words = ["sb3-follow-object", "train", "--run", str(path), "--env", config.full_id]
    words += ["--method", config.method, "--seed", str(config.seed)]
    words += ["--threads", str(config.torch_threads)]
    if settings.steps is not None:
        words += ["--steps", str(settings.steps)]
    if settings.preset != "default":
        words += ["--preset", settings.preset]
    changes = dict(_paper_rhythm(config.env_id)) if settings.paper_evaluation else {}
    changes |= settings.overrides or {}
    if changes:
        words += ["--set", *(f"{name}={json.dumps(value)}" for name, value in changes.items())]
    return shlex.join(words)


def _kept_config(cell: Cell) -> RunConfig | None:
    """Return the configuration of the run that the cell's folder holds already."""
    if not (cell.folder / CONFIG).exists():
        if cell.folder.exists() and not _is_empty(cell.folder):
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


def _is_empty(folder: Path) -> bool:
    """Whether this is a folder with nothing in it but hidden files, such as locks."""
    return folder.is_dir() and all(path.name.startswith(".") for path in folder.iterdir())


def _without_shares(config: RunConfig) -> dict[str, Any]:
    plain = asdict(config)
    for name in _SHARES:
        *outer, last = name.split(".")
        inner = plain
        for part in outer:
            inner = inner[part]
        inner.pop(last, None)
    return plain


def _check_settings(folder: Path, settings: Settings) -> None:
    kept = read_grid(folder)
    if kept is None:
        return
    wanted = _plain(settings)
    different = difference({name: kept.get(name) for name in wanted}, wanted)
    if different is not None:
        name, old, new = different
        raise ValueError(
            f"{folder} was compared with {name} {old!r}, not {new!r}; use the same settings or "
            "another folder"
        )


def _plain(settings: Settings) -> dict[str, Any]:
    return {
        "steps": settings.steps,
        "preset": settings.preset,
        "set": dict(settings.overrides or {}),
        "paper_evaluation": settings.paper_evaluation,
    }


def _file_name(task: str) -> str:
    return task.replace("/", "_").replace(":", "_")
