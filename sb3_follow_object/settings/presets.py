"""Settings of a run: from YAML files in rl_zoo3's layout and from single overrides."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..any_task.derived import derived
from ..any_task.tasks import (
    registered_horizon,
    steps_of_object,
    success_distance_of,
    surface_choices,
)
from ..common.numbers import as_number, shown
from ..common.plain_yaml import load_yaml
from ..common.reports import Report
from ..common.suggestions import did_you_mean
from ..envs import IDS, object_id
from ..envs.goal_envs import check_task
from ..envs.registration import import_task
from ..envs.task_table import BUILT_IN
from ..envs.tasks import SUCCESS_DISTANCE
from ..zoo_configs import FOLDER
from .fields import Group, check_names
from .learning import AlgorithmSettings, check_auxiliary
from .methods import METHODS as METHODS
from .methods import STOCK, WITHOUT_PAPER, check_methods
from .run_config import CONFIG, RunConfig
from .sizes import check_sizes
from .stages import BEHIND, ReachTeachingSettings, StageSettings
from .table import check_dotted
from .zoo_yaml import SIMILAR, WRAPPER, ZooFile, of_data, with_numbers

PRESETS = ("default", "paper")
SAVED_STATE = "state.safetensors"  # what FollowObject.save writes, and a run's folder has not
# Settings in metres that are meant as shares of the distance within which goals are reached.
_TOLERANCES = (
    ("curriculum", "min_distance"),
    ("replay_buffer_kwargs", "moved_distance"),
    ("replay_buffer_kwargs", "min_goal_distance"),
    ("replay_buffer_kwargs", "scene_distance"),
)
_HORIZON = 50  # steps of the episodes that presets give updates and tests for
# What makes an entry this or that method.
MARKS = (
    f"fo has env_wrapper {WRAPPER}, shaped reward_type dense, cher a setting "
    "replay_buffer_kwargs.cher, the auxiliary reward gives its name, and rher has none of these "
    "but settings of reach"
)
# Whose settings stand side by side in an entry.
_GROUPS: tuple[type[Group], ...] = (RunConfig, StageSettings, AlgorithmSettings)


def preset_file(method: str, preset: str = "default") -> Path:
    """Return the YAML file that comes with the package for a method or a stock algorithm.

    Args:
        method: one of `METHODS`, or "ddpg", "td3", "sac" or "tqc", whose files rl_zoo3 reads.
        preset: "default" or "paper".

    Raises:
        ValueError: there is no such method or preset, with the nearest that there is.
    """
    stock = STOCK.get(str(method))
    if stock is not None and preset == "default":
        return FOLDER / stock
    if method not in METHODS:
        raise ValueError(f"there is no method {method!r}{did_you_mean(method, METHODS)}")
    if preset not in PRESETS:
        raise ValueError(f"there is no preset {preset!r}{did_you_mean(preset, PRESETS)}")
    if method in WITHOUT_PAPER and preset == "paper":
        raise ValueError(
            f"{method!r} has no preset 'paper', for the paper has no such rival; leave the preset "
            "out"
        )
    name = method if preset == "default" else f"{method}-{preset}"
    return FOLDER / f"{name}.yml"


def run_config(
    env_id: str,
    *,
    method: str | None = None,
    preset: str = "default",
    file: str | os.PathLike[str] | None = None,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    report: Report = lambda sentence: None,
) -> RunConfig:
    """Read a task's settings and return the configuration of a run.

    Args:
        env_id: the task; the file must have an entry for it, or one named "default". A task that
            was added by `register_task` is otherwise set up as the package's most similar one.
        method: one of `METHODS`; None takes what the file trains, without a file "fo".
        preset: "default" or "paper", of the files that come with the package.
        file: YAML in rl_zoo3's layout, in place of a preset.
        seed: of the run.
        overrides: settings by their dotted names, e.g. {"curriculum.p": 0.5}; they win.
        report: called with a sentence where looking at a task of others may take minutes.

    Raises:
        ValueError: an invalid id, file, key or value, with the nearest valid one.
    """
    name = check_task(env_id)
    module = env_id.rpartition(":")[0] if name in IDS and name not in BUILT_IN else ""
    env_id = name if name in IDS else env_id
    if file is None:
        method = "fo" if method is None else method
        check_methods([method])
        path = preset_file(method, preset)
    else:
        path = Path(file)
    known = ZooFile(path)
    imagine = known.imagines(env_id)
    settings = _task_settings(known, env_id, imagine, report)
    ours = file is None and preset == "default"  # the paper's cycles are the paper's
    if ours and _is_unknown(known, env_id):
        _fit_to_horizon(settings, env_id)
    changes: dict[str, Any] = {}
    if not isinstance(overrides, Mapping | None):
        raise ValueError(f"overrides must be a mapping of settings, not {shown(overrides)}")
    for name, value in (overrides or {}).items():
        if not isinstance(name, str):
            raise ValueError(f"overrides has no setting {shown(name)}; names are text")
        _override(changes, name, value)
        _override(settings, name, value)
    check_dotted(changes, "--set")
    _checked(changes, "--set")
    settings = _checked(settings, str(path))
    if settings.get("auxiliary"):
        check_auxiliary(settings["auxiliary"])
    found = method_of(settings, imagine)
    if method is not None and method != found:
        if env_id in IDS and IDS[env_id][1]:
            raise ValueError(
                f"{env_id!r} is the object alone, which the first stage trains; give the robot's "
                f"id, {env_id.replace('Object-v', '-v')!r}, or --method her"
            )
        raise ValueError(
            f"{path} trains {env_id} with method {found!r}{' after --set' * bool(changes)}, "
            f"not {method!r}: {MARKS}"
        )

    of_run, of_class, of_algorithm = (
        {group[name].field: settings[name] for name in settings if name in group}
        for group in map(of_data, _GROUPS)
    )
    config = RunConfig(
        env_id,
        found,
        seed=seed,
        settings={
            "imagine": imagine,
            **of_class,
            **({"algorithm": of_algorithm} if of_algorithm else {}),
        },
        module=module or None,
        **of_run,
    )
    check_sizes(config)
    return config


def _is_unknown(known: ZooFile, env_id: str) -> bool:
    """Whether neither the package nor a file of settings knows an environment."""
    return env_id not in IDS and not known.names(env_id)


def _task_settings(known: ZooFile, env_id: str, imagine: bool, report: Report) -> dict[str, Any]:
    """Return what a file says of a task, its object's stage included, as fits the task."""
    settings = known.settings(env_id)
    needs_networks = _auxiliary_name(settings) == "sldr"
    if env_id in IDS:
        alone = known.object_settings(object_id(env_id)) if imagine or needs_networks else {}
        return settings | alone
    if needs_networks:
        raise ValueError(
            f"{env_id!r} is not a task of this package, whose observations alone SLDR's reward "
            "can read the object's state from; train it with --method fo or her"
        )
    if imagine:
        derived(env_id, report)  # refused here if its object cannot be followed
    if _is_unknown(known, env_id):
        settings = _similar_settings(known, env_id, imagine, report)
    return settings | (known.object_settings(object_id(SIMILAR[False])) if imagine else {})


def _similar_settings(known: ZooFile, env_id: str, imagine: bool, report: Report) -> dict[str, Any]:
    """Return what a file says of the package's task that is most similar to one of others."""
    try:
        derived(env_id, report)
    except ValueError:  # nothing can be followed, which a method without imagined goals need not
        return known.settings(env_id)
    on_surface = surface_choices(env_id)[0]
    settings = known.settings(SIMILAR[True] if on_surface else env_id)
    _scale_distances(settings, success_distance_of(env_id) / SUCCESS_DISTANCE)
    reach = settings.get("reach")
    # With imagined goals it depends on whether the object has learned to stay on its surface.
    if on_surface and not imagine and reach is not None and reach.get("standoff") in (None, "auto"):
        settings["reach"] = {**reach, "standoff": BEHIND}
    return settings


def method_of(settings: Mapping[str, Any], imagine: bool) -> str:
    """Return the name of the method that settings describe: its marks joined.

    Without any it is "her" or, where something reaches first, "rher": what another method begins
    its episodes with does not make it another one.
    """
    auxiliary = _auxiliary_name(settings)
    marks = {
        "fo": imagine,
        "shaped": settings.get("reward_type") == "dense",
        auxiliary: bool(auxiliary),
        "cher": (settings.get("replay_buffer_kwargs") or {}).get("cher") is not None,
    }
    alone = "her" if settings.get("reach") is None else "rher"
    return "-".join(name for name, marked in marks.items() if marked) or alone


def _auxiliary_name(settings: Mapping[str, Any]) -> str:
    """Return the name of the auxiliary reward, "" without one."""
    auxiliary = settings.get("auxiliary")
    return str(auxiliary.get("name", "")) if isinstance(auxiliary, dict) else ""


def read_config(folder: str | os.PathLike[str]) -> RunConfig:
    """Return the configuration that a run folder was started with; imports no task.

    Raises:
        ValueError: the folder holds no run, or its configuration is damaged.
    """
    path = Path(folder) / CONFIG
    try:
        saved = json.loads(path.read_text("utf-8"))
        return RunConfig(**{**saved, "settings": saved["settings"]})  # without, it is none
    except FileNotFoundError as error:
        raise ValueError(f"{folder} holds no run: {_instead(path)}") from error
    except NotADirectoryError as error:
        raise ValueError(f"{folder} is no folder of a run: {_instead(path)}") from error
    except (OSError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not the configuration of a run ({error})") from error


def _instead(path: Path) -> str:
    """Say what there is in place of a run's configuration, and what reads it."""
    folder = path.parent
    if (folder / SAVED_STATE).exists():
        return "a FollowObject was saved there, which FollowObject.load reads"
    if folder.is_file() and folder.suffix == ".zip":
        return "it is a saved model, which HerDDPG.load reads, or the class that saved it"
    return "it is a file" if folder.is_file() else f"there is no {path}"


def load_config(folder: str | os.PathLike[str]) -> RunConfig:
    """Return the configuration of a run folder whose task is known from here on.

    Raises:
        ValueError: as `read_config`, or the module that registers the task cannot be imported.
    """
    config = read_config(folder)
    import_task(config.full_id)
    return config


def parse_override(text: str) -> tuple[str, Any]:
    """Split "key.sub=value", the value in YAML's notation, into name and value.

    Raises:
        ValueError: there is no "=", or the value is no YAML.
    """
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ValueError(f"{text!r} is no setting; write key=value or key.sub=value")
    try:
        return name, with_numbers(load_yaml(value))
    except ValueError as error:
        raise ValueError(f"the value of {text!r} is not YAML: {error}") from error


def _scale_distances(settings: dict[str, Any], factor: float) -> None:
    """Fit what presets say in metres to how near its goal an object must be.

    What is invalid is left to be refused as it was given.
    """
    for outer, name in _TOLERANCES:
        group = settings.get(outer)
        if isinstance(group, dict) and name in group:
            with suppress(ValueError):
                if (metres := as_number(group[name])) > 0:
                    settings[outer] = {**group, name: round(metres * factor, 6)}


def _fit_to_horizon(settings: dict[str, Any], env_id: str) -> None:
    """Keep updates and tests per env step what they are in the presets' episodes.

    Validations of longer episodes come after as many more env steps, or they took most of the time.
    """
    horizon = registered_horizon(env_id)
    if horizon in (None, _HORIZON):
        return
    robot, alone = horizon / _HORIZON, steps_of_object(env_id, horizon) / _HORIZON
    reach, of_object = settings.get("reach"), settings.get("object_algorithm")
    if reach is not None:
        reach.setdefault("n_updates", ReachTeachingSettings.n_updates)
    for group, name, factor in (
        (settings, "gradient_steps", robot),
        (settings, "test_every", 1 / robot),
        (settings, "eval_every", max(1, robot)),
        (reach or {}, "n_updates", robot),
        (of_object or {}, "gradient_steps", alone),
        (settings, "object_test_every", 1 / alone),
    ):
        if group.get(name, -1) > 0:
            group[name] = max(1, round(group[name] * factor))


def _override(settings: dict[str, Any], name: str, value: Any) -> None:
    *outer, last = name.split(".")
    for part in outer:
        inner = settings.get(part)
        settings[part] = dict(inner) if isinstance(inner, dict) else {}
        settings = settings[part]
    settings[last] = value


def _checked(settings: dict[str, Any], where: str) -> dict[str, Any]:
    """Return an entry's settings as the groups have them."""
    known = {name: each for group in _GROUPS for name, each in of_data(group).items()}
    check_names(settings, known, where)
    return {name: known[name].checked(value, where, data=True) for name, value in settings.items()}
