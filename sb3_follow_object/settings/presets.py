"""Settings of a run: from YAML files in rl_zoo3's layout and from single overrides."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..any_task.tasks import (
    check_followable,
    registered_horizon,
    steps_of_object,
    success_distance_of,
    surface_choices,
)
from ..common.numbers import as_number
from ..common.plain_yaml import load_yaml
from ..common.suggestions import did_you_mean
from ..envs import IDS, object_id
from ..envs.goal_envs import check_task
from ..envs.registration import import_task
from ..envs.task_table import BUILT_IN
from ..envs.tasks import SUCCESS_DISTANCE
from ..zoo_configs import FOLDER
from .fields import Group, Setting, check_names, settings_of
from .learning import AlgorithmSettings, check_auxiliary
from .methods import METHODS as METHODS
from .methods import STOCK, WITHOUT_PAPER, check_methods
from .run_config import CONFIG, RunConfig
from .sizes import check_sizes
from .stages import ReachFirstSettings, ReachTeachingSettings, StageSettings, part_of_reach
from .table import check_dotted

PRESETS = ("default", "paper")
# Settings in metres that are meant as shares of the distance within which goals are reached.
_TOLERANCES = (
    ("curriculum", "min_distance"),
    ("replay_buffer_kwargs", "moved_distance"),
    ("replay_buffer_kwargs", "min_goal_distance"),
    ("replay_buffer_kwargs", "scene_distance"),
)
_HORIZON = 50  # steps of the episodes that presets give updates and tests for
# The package's task that one of one's own is set up as, by whether its object is pushed.
SIMILAR = {True: "FollowObject/PushSideGap-v0", False: "FollowObject/PnPSimpleV2-v0"}

WRAPPER = "sb3_follow_object.ImaginedGoalWrapper"
CALLBACK = "sb3_follow_object.CurriculumCallback"
OF_RUNS = "sb3-follow-object"  # an entry for all tasks that rl_zoo3 does not look at
REACH_WRAPPER = "sb3_follow_object.ReachFirstWrapper"
REACH_CALLBACK = "sb3_follow_object.ReachCallback"
_KNOWN = {"env_wrapper": (WRAPPER, REACH_WRAPPER), "callback": (CALLBACK, REACH_CALLBACK)}
# What makes an entry this or that method.
_MARKS = (
    f"fo has env_wrapper {WRAPPER}, shaped reward_type dense, cher a setting "
    "replay_buffer_kwargs.cher, the auxiliary reward gives its name, and rher has none of these "
    "but settings of reach"
)
# The callback's keyword arguments, and what FollowObject calls them.
_CALLBACK_NAMES = {"every": "test_every", "n_episodes": "n_test_episodes", "store": "store_tests"}

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
    if method in STOCK and preset == "default":
        return FOLDER / STOCK[method]
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

    Raises:
        ValueError: an invalid id, file, key or value, with the nearest valid one.
    """
    name = check_task(env_id)
    module = env_id.rpartition(":")[0] if name in IDS and name not in BUILT_IN else ""
    env_id = name if name in IDS else env_id
    if file is None:
        method = method or "fo"
        check_methods([method])
        path = preset_file(method, preset)
    else:
        path = Path(file)
    entries = read_yaml(path)
    entry = _entry(entries, env_id, path)
    imagine = WRAPPER in _named(entry, "env_wrapper", path)
    of_runs = _of_runs(entries, path)
    settings = of_runs | _flattened(entry, path)
    unknown = env_id not in IDS and not {env_id, env_id.rpartition(":")[2]} & entries.keys()
    has_object_stage = imagine or _auxiliary_name(settings) == "sldr"
    if has_object_stage and env_id not in IDS:
        if _auxiliary_name(settings) == "sldr":
            raise ValueError(
                f"{env_id!r} is not a task of this package, whose observations alone SLDR's reward "
                "can read the object's state from; train it with --method fo or her"
            )
        check_followable(env_id)
        if unknown:  # set up as the package's most similar task
            if surface_choices(env_id)[0]:
                settings = of_runs | _flattened(_entry(entries, SIMILAR[True], path), path)
            _scale_distances(settings, success_distance_of(env_id) / SUCCESS_DISTANCE)
    of_object = object_id(env_id if env_id in IDS else SIMILAR[False])
    if has_object_stage and _find(entries, of_object) is not None:
        settings |= _object_stage(_entry(entries, of_object, path), path)
    ours = file is None and preset == "default"  # the paper's cycles are the paper's
    if ours and unknown:
        _fit_to_horizon(settings, env_id)
    changes: dict[str, Any] = {}
    for name, value in (overrides or {}).items():
        _override(changes, name, value)
        _override(settings, name, value)
    check_dotted(changes, "--set")
    _checked(changes, "--set")
    settings = _checked(settings, str(path))
    if settings.get("auxiliary"):
        check_auxiliary(settings["auxiliary"])
    found = method_of(settings, imagine)
    if method is not None and method != found:
        raise ValueError(
            f"{path} trains {env_id} with method {found!r}{' after --set' * bool(changes)}, "
            f"not {method!r}: {_MARKS}"
        )

    of_run, of_class, of_algorithm = (
        {known[name].field: settings[name] for name in settings if name in known}
        for known in map(_known, _GROUPS)
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


def load_config(folder: str | os.PathLike[str]) -> RunConfig:
    """Return the configuration that a run folder was started with.

    Raises:
        ValueError: the folder holds no run, or its configuration is damaged.
    """
    path = Path(folder) / CONFIG
    try:
        saved = json.loads(path.read_text("utf-8"))
        config = RunConfig(**{**saved, "settings": saved["settings"]})  # without, it is none
        import_task(config.full_id)
        return config
    except FileNotFoundError as error:
        raise ValueError(f"{folder} holds no run: there is no {path}") from error
    except (OSError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not the configuration of a run ({error})") from error


def parse_override(text: str) -> tuple[str, Any]:
    """Split "key.sub=value", the value in YAML's notation, into name and value.

    Raises:
        ValueError: there is no "=", or the value is no YAML.
    """
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ValueError(f"{text!r} is no setting; write key=value or key.sub=value")
    try:
        return name, _plain(load_yaml(value))
    except ValueError as error:
        raise ValueError(f"the value of {text!r} is not YAML: {error}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Return a YAML file's mapping of env ids to settings.

    Raises:
        ValueError: the file is missing, is not YAML, or is not such a mapping.
    """
    try:
        entries = load_yaml(path.read_text("utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path} is not YAML: {error}") from error
    if not isinstance(entries, dict):
        raise ValueError(f"{path} is not a mapping from environment ids to settings")
    return entries


def _entry(entries: dict[str, Any], env_id: str, path: Path) -> dict[str, Any]:
    entry = _find(entries, env_id)
    if entry is None:
        entry = entries.get("default")
    if entry is None:
        raise ValueError(f"{path} has no settings for {env_id!r}{did_you_mean(env_id, entries)}")
    if not isinstance(entry, dict):
        raise ValueError(f"{path}: the settings of {env_id!r} are not a mapping")
    return entry


def _find(entries: dict[str, Any], env_id: str) -> Any:
    """Return an id's entry; for a task of one's own, otherwise that of the most similar one."""
    if env_id not in entries and env_id in IDS and env_id not in BUILT_IN:
        task, alone = IDS[env_id]
        env_id = SIMILAR[task.blocked_gripper]
        env_id = object_id(env_id) if alone else env_id
    return entries.get(env_id, entries.get(env_id.rpartition(":")[2]))


def _named(entry: dict[str, Any], key: str, path: Path) -> dict[str, dict[str, Any]]:
    """Return rl_zoo3's list of class names, each bare or with arguments, as one mapping."""
    given = entry.get(key) or []
    named: dict[str, dict[str, Any]] = {}
    for item in given if isinstance(given, list) else [given]:
        if isinstance(item, dict) and len(item) == 1:
            ((name, arguments),) = item.items()
            named[name] = arguments or {}
        elif isinstance(item, str):
            named[item] = {}
        else:
            raise ValueError(f"{path}: {key} must list class names with arguments, not {item!r}")
    for name, arguments in named.items():
        if name not in _KNOWN[key]:
            raise ValueError(f"{path}: {key} can hold {' and '.join(_KNOWN[key])}, not {name!r}")
        if not isinstance(arguments, dict):
            raise ValueError(f"{path}: the arguments of {name} are not a mapping")
    return named


def _of_runs(entries: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the settings of all tasks that are a run's or the three stages', not rl_zoo3's."""
    given = entries.get(OF_RUNS) or {}
    if not isinstance(given, dict):
        raise ValueError(f"{path}: the settings of {OF_RUNS!r} are not a mapping")
    check_names(given, {**_known(RunConfig), **_known(StageSettings)}, f"{path}: {OF_RUNS}")
    return dict(_plain(given))


def _flattened(entry: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return an entry with the arguments of its wrapper, callback and environments as settings."""
    settings = _plain(entry)
    wrappers = _named(settings, "env_wrapper", path)
    callbacks = _named(settings, "callback", path)
    if WRAPPER in wrappers:
        arguments = wrappers[WRAPPER]
        check_names(arguments, ("predictor", "curriculum"), f"{path}: {WRAPPER}")
        if arguments.get("predictor", "auto") != "auto":
            raise ValueError(f"{path}: a run makes its own predictor; leave it out or say auto")
        settings["curriculum"] = arguments.get("curriculum") or {}
    if CALLBACK in callbacks:
        arguments = callbacks[CALLBACK]
        check_names(arguments, _CALLBACK_NAMES, f"{path}: {CALLBACK}")
        settings |= {_CALLBACK_NAMES[name]: value for name, value in arguments.items()}
    reach = _reach(wrappers.get(REACH_WRAPPER), callbacks.get(REACH_CALLBACK), path)
    settings |= {} if reach is None else {"reach": reach}
    env_kwargs = settings.get("env_kwargs") or {}
    check_names(env_kwargs, ("reward_type",), f"{path}: env_kwargs")
    settings |= env_kwargs
    return {
        name: value
        for name, value in settings.items()
        if name not in ("env_wrapper", "callback", "env_kwargs")
    }


def _reach(
    first: dict[str, Any] | None, teaching: dict[str, Any] | None, path: Path
) -> dict[str, Any] | None:
    """Return the setting `reach` from the arguments of its wrapper and of its callback."""
    if first is None and teaching is None:
        return None
    if first is None or teaching is None:
        given, missing = REACH_CALLBACK, f"the env_wrapper {REACH_WRAPPER}"
        if teaching is None:
            given, missing = REACH_WRAPPER, f"the callback {REACH_CALLBACK}"
        raise ValueError(f"{path}: {given} does nothing without {missing}; give both or neither")
    return {
        **part_of_reach(ReachTeachingSettings, teaching, f"{path}: {REACH_CALLBACK}"),
        **part_of_reach(ReachFirstSettings, first, f"{path}: {REACH_WRAPPER}"),
    }


def _object_stage(entry: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the first stage's settings from the entry of the object's own environment."""
    algorithm = _plain(entry)
    algorithm.pop("policy", None)  # rl_zoo3 wants it; the first stage knows only one
    settings: dict[str, Any] = {"object_algorithm": algorithm}
    for name, ours in (("n_timesteps", "object_timesteps"), ("n_envs", "object_n_envs")):
        if name in algorithm:
            settings[ours] = algorithm.pop(name)
    env_kwargs = algorithm.pop("env_kwargs", {})
    check_names(env_kwargs, ("on_table",), f"{path}: env_kwargs of the object")
    return settings | {f"object_{name}": value for name, value in env_kwargs.items()}


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
    """Keep updates and tests per env step what they are in the presets' episodes."""
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


def _known(group: type[Group]) -> dict[str, Setting]:
    """Return what data can say of a group."""
    return {name: each for name, each in settings_of(group).items() if each.data}


def _checked(settings: dict[str, Any], where: str) -> dict[str, Any]:
    """Return an entry's settings as the groups have them."""
    known = {name: each for group in _GROUPS for name, each in _known(group).items()}
    check_names(settings, known, where)
    return {name: known[name].checked(value, where, data=True) for name, value in settings.items()}


def _plain(value: Any) -> Any:
    """Read 1e-3, a word in YAML 1.1, as a number, and !!float 1e6 as the whole one it is."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    if not isinstance(value, str | float):
        return value
    try:
        number = float(value)
    except ValueError:
        return value
    return int(number) if number.is_integer() else number
