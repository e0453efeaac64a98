"""A run's folder: what is in it, and whose it is."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ..common.files import atomic_write, is_left_over
from ..envs import IDS
from ..settings.run_config import CONFIG, RunConfig, flat
from .checkpoints import checkpoint_files

RESULT, EVALUATIONS = "result.json", "evaluations.csv"
POLICY, BEST_POLICY = "policy.safetensors", "best_policy.safetensors"
VERSIONS = "versions.json"
CROSS_TESTS = "cross_tests.json"  # the policy on other tasks
COMMAND = "command.txt"  # what started the run, and what gave it other steps later
PACKAGES = ["sb3-follow-object", "stable-baselines3", "gymnasium", "gymnasium-robotics"]
PACKAGES += ["mujoco", "torch", "numpy"]

# What everything that reads a result needs of it.
_RESULT: dict[str, type] = {"env_steps": int, "wall_s": float, "success_rate": float}


def check_empty(folder: Path) -> None:
    """Raise a ValueError unless a run can start in the folder."""
    if folder.exists() and not (folder.is_dir() and all(map(_is_of_a_start, folder.iterdir()))):
        raise ValueError(f"{folder} is not empty; resume the run in it or give another folder")


def _is_of_a_start(path: Path) -> bool:
    """Whether a file is what a start leaves that did not come to the configuration."""
    return is_left_over(path) or path.name in (VERSIONS, COMMAND)


def task_label(env_id: str) -> str:
    """Return the short name of one of the package's tasks, or another environment's id."""
    task, alone = IDS.get(env_id.rpartition(":")[2], (None, False))
    return env_id if task is None or alone else task.name


def check_same_run(folder: Path, config: RunConfig) -> None:
    """Raise a ValueError unless the folder holds the run of the configuration, steps apart."""
    path = folder / CONFIG
    if not path.exists():
        raise ValueError(f"{folder} holds no run to resume")
    try:
        kept = RunConfig(**json.loads(path.read_text("utf-8")))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not the configuration of a run ({error})") from error
    same_steps = replace(kept, total_timesteps=config.total_timesteps)
    different = difference(asdict(same_steps), asdict(config))
    if different is not None:
        name, ours, theirs = different
        raise ValueError(
            f"the run in {folder} has {name} {ours!r}, not {theirs!r}; "
            "resume it with all its settings, on the command line by no flag at all, or start "
            "another in another folder"
        )


def difference(kept: dict[str, Any], wanted: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first setting that differs, by its dotted name, and its two values."""
    ours, theirs = (flat(json.loads(json.dumps(settings))) for settings in (kept, wanted))
    for name in {**ours, **theirs}:
        if ours.get(name) != theirs.get(name):
            return name, ours.get(name), theirs.get(name)
    return None


def claim(folder: Path, config: RunConfig, command: str = "") -> None:
    """Create a run's folder with its config and versions: what `train(resume=True)` asks for."""
    folder.mkdir(parents=True, exist_ok=True)
    check_empty(folder)  # again, now that no other process can come in between
    write_versions(folder)
    if command:
        atomic_write(folder / COMMAND, f"{command}\n".encode())
    atomic_write(folder / CONFIG, json.dumps(asdict(config), indent=2).encode())


def write_versions(folder: Path) -> None:
    """Note in a folder what its results depend on besides its settings."""
    versions: dict[str, str | None] = {n: importlib.metadata.version(n) for n in PACKAGES}
    versions |= {"python": platform.python_version(), "commit": source_commit()}
    atomic_write(folder / VERSIONS, json.dumps(versions, indent=2).encode())


def take_steps(folder: Path, config: RunConfig, command: str = "") -> None:
    """Note in a run's folder the steps that it is resumed with, where they are others.

    Raises:
        ValueError: its newest checkpoint has had more than that; nothing is written.
    """
    kept = RunConfig(**json.loads((folder / CONFIG).read_text("utf-8")))
    if kept.total_timesteps == config.total_timesteps:
        return
    gone = max((int(path.stem.rpartition("-")[2]) for path in checkpoint_files(folder)), default=0)
    _check_steps(folder, config, gone)
    if command and (folder / COMMAND).exists():
        earlier = _commands(folder)
        atomic_write(folder / COMMAND, f"{earlier}{command}\n".encode())
    atomic_write(folder / CONFIG, json.dumps(asdict(config), indent=2).encode())


def _check_steps(folder: Path, config: RunConfig, gone: int) -> None:
    """Raise a ValueError for fewer env steps than a run has had."""
    if config.total_timesteps < gone:
        raise ValueError(
            f"the run in {folder} has had {gone} env steps already; its steps are counted from its "
            "beginning, so give at least that many"
        )


def noted_command(folder: Path, command: str = "") -> str:
    """Return what made a run, as one line of a shell; `command` where its folder does not say."""
    if not (folder / COMMAND).exists():
        return command
    return " && ".join(_commands(folder).splitlines())


def _commands(folder: Path) -> str:
    """Return what started a run, and what gave it other steps later, a line each."""
    path = folder / COMMAND
    try:
        return path.read_text("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not what started a run ({error})") from error


def drop_later_rows(folder: Path, env_steps: int) -> None:
    """Drop a run's validations that came after a checkpoint, as no training may follow on it.

    Args:
        folder: of the run; it need not have been validated.
        env_steps: of the checkpoint.

    Raises:
        ValueError: the file of validations is damaged.
    """
    path = folder / EVALUATIONS
    if not path.exists():
        return
    lines = path.read_text("utf-8").splitlines(keepends=True)
    head, rows = lines[:1], lines[1:]
    try:
        kept = [row for row in rows if int(row.split(",")[0]) <= env_steps]
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if kept != rows:
        atomic_write(path, "".join(head + kept).encode())


def finished_result(folder: Path, config: RunConfig) -> dict[str, Any] | None:
    """Return the result of a run that has had its steps; None for one that can go on.

    Raises:
        ValueError: it ended after fewer and kept no checkpoint to go on from; or it has had more
            than the steps that it is given now.
    """
    if not (folder / RESULT).exists():
        return None
    result = read_result(folder)
    kept = RunConfig(**json.loads((folder / CONFIG).read_text("utf-8")))
    if config.total_timesteps != kept.total_timesteps:
        _check_steps(folder, config, result["env_steps"])
    if result["env_steps"] >= config.total_timesteps or result.get("solved"):
        return result
    if not checkpoint_files(folder):
        raise ValueError(
            f"the run in {folder} ended after {result['env_steps']} env steps and kept no "
            "checkpoint to go on from; one started with --set keep_last_checkpoint=true keeps it"
        )
    return None


def read_result(folder: Path) -> dict[str, Any]:
    """Return the content of a run's result.json.

    Raises:
        ValueError: the file is damaged.
    """
    path = folder / RESULT
    try:
        result = json.loads(path.read_text("utf-8"))
        for name, kind in _RESULT.items():
            result[name] = kind(result[name])
        if not 0.0 <= result["success_rate"] <= 1.0:
            raise ValueError(f"success_rate is {result['success_rate']}")
        return dict(result)
    except (OSError, KeyError, TypeError, ArithmeticError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not the result of a run ({error})") from error


def source_commit() -> str | None:
    """Return the commit of the package's source tree; None for an installed wheel."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        run = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return run.stdout.strip()


def trained_steps(folder: str | os.PathLike[str]) -> int | None:
    """Return the env steps that a run folder's training took; None where it does not say."""
    folder = Path(folder)
    if (folder / RESULT).exists():
        return int(read_result(folder)["env_steps"])
    if (folder / EVALUATIONS).exists():
        rows = (folder / EVALUATIONS).read_text("utf-8").splitlines()[1:]
        try:
            return int(rows[-1].split(",")[0]) if rows else None
        except ValueError as error:
            raise ValueError(f"{folder / EVALUATIONS} is damaged: {error}") from error
    return None
