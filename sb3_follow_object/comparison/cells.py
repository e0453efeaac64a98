"""A run of a comparison: what it is, where it lies, and the object stage that it shares."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..object_stage.sldr import reads_object_networks
from ..runs.object_stage_files import OBJECT_STAGE
from ..runs.run_folder import CONFIG, RESULT, claim
from ..settings.presets import load_config
from ..settings.run_config import RunConfig
from ..settings.stages import CurriculumSettings, StageSettings

OBJECT = "object"  # folder of the object stages that runs share
# Settings that only runs with imagined goals read, and those that decide F_phi.
_OF_IMAGINED = ("curriculum", "test_every", "n_test_episodes", "store_tests")
_OF_PREDICTOR = ("predictor_fit", "n_paths")


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
        return self.folder.parent / OBJECT / f"{file_name(self.task)}-{self.seed}"


def needs_object_stage(config: RunConfig) -> bool:
    """Whether a run begins with what its object learns alone."""
    algorithm = config.settings.get("algorithm") or {}
    return bool(config.settings.get("imagine", True)) or reads_object_networks(algorithm)


def unread(setting: str, config: RunConfig) -> str | None:
    """Return why a setting, by its dotted name, does nothing in a run; None where it is read."""
    first = setting.partition(".")[0]
    imagines, begins = bool(config.settings.get("imagine", True)), needs_object_stage(config)
    # F_phi is fitted to tell how rough the object's ways are where it is not for imagined goals.
    judged = config.settings.get("object_error", StageSettings.object_error) > 0.0
    fitted = imagines or (begins and judged)
    if (first in _OF_IMAGINED and not imagines) or (first in _OF_PREDICTOR and not fitted):
        return f"method {config.method!r} imagines no goals"
    if not begins and (first.startswith("object_") or first == "inverse_fit"):
        return f"method {config.method!r} has no object's stage"
    curriculum = config.settings.get("curriculum") or {}
    levels = curriculum.get("levels", CurriculumSettings.levels)
    if setting == "curriculum.n_levels" and levels == "time":
        return "with curriculum.levels=time there is a level for each time-step"
    if setting == "solved_validations" and config.solved_at == 0.0:
        return "with solved_at=0 no validation ends the run"
    return None


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
        None where the run needs none or has begun already, and where the one of its folder's name
        is of another task or of other settings: the run then makes its own.
    """
    stage = cell.stage
    if stage is None or (cell.folder / CONFIG).exists():
        return None
    if not (stage / CONFIG).exists():
        # A whole one, with F_phi, serves the runs that do not imagine goals as well.
        settings = {**cell.config.settings, "imagine": True}
        _claim_whole(stage, replace(cell.config, settings=settings))
    kept, wanted = load_config(stage), cell.config
    same = kept.env_id == wanted.env_id and stage_settings(kept) == stage_settings(wanted)
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
    if is_empty(folder):
        shutil.rmtree(folder)
    claim(new, config, command)
    for path in stage.iterdir() if stage else ():
        if path.is_dir():
            shutil.copytree(path, new / path.name)
        elif not (new / path.name).exists() and not path.name.startswith((".", "checkpoint")):
            shutil.copyfile(path, new / path.name)
    os.replace(new, folder)


def is_empty(folder: Path) -> bool:
    """Whether this is a folder with nothing in it but hidden files, such as locks."""
    return folder.is_dir() and all(path.name.startswith(".") for path in folder.iterdir())


def file_name(task: str) -> str:
    """Return a task's name or id as a part of folders' names."""
    return task.replace("/", "_").replace(":", "_")
