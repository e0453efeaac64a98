"""Settings of a run: from YAML files in rl_zoo3's layout and from single overrides."""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.td3.policies import TD3Policy

from .. import zoo_configs
from ..common.plain_yaml import load_yaml
from ..common.providers import provided
from ..common.suggestions import did_you_mean
from ..ddpg.auxiliary import KIND, check_auxiliary, reward_class
from ..ddpg.her_ddpg import HerDDPG
from ..ddpg.policies import HerPolicy
from ..envs import IDS, object_id
from ..envs.goal_envs import check_task
from ..envs.registration import import_task
from ..envs.task_table import BUILT_IN
from ..follow_object.follow_object import FollowObject
from ..imagination.curriculum import Curriculum
from ..imagination.goal_predictor import GoalPredictor
from ..object_stage.networks import ObjectNetworks
from ..replay.cher import GoalSelection
from ..replay.her_replay_buffer import FollowObjectReplayBuffer
from ..runs.run_folder import CONFIG
from .keywords import with_tuples
from .methods import METHODS as METHODS
from .ranges import check_value
from .run_config import RunConfig

PRESETS = ("default", "paper")

WRAPPER = "sb3_follow_object.ImaginedGoalWrapper"
CALLBACK = "sb3_follow_object.CurriculumCallback"
# What makes an entry this or that method.
_MARKS = (
    f"fo has env_wrapper {WRAPPER}, shaped reward_type dense, cher a setting "
    "replay_buffer_kwargs.cher, and the auxiliary reward gives its name"
)
# The callback's keyword arguments, and what FollowObject calls them.
_CALLBACK_NAMES = {"every": "test_every", "n_episodes": "n_test_episodes", "store": "store_tests"}

# What the run itself decides, or what YAML cannot hold.
_NOT_SETTINGS = {"self", "env", "env_id", "seed", "settings", "method", "imagine", "algorithm"}
_NOT_SETTINGS |= {"module", "update_threads"}
_NOT_SETTINGS |= {
    "model",
    "object_networks",
    "predictor",
    "report",
    "_init_setup_model",
    "tensorboard_log",
    "action_noise",
}
_NOT_SETTINGS |= {"replay_buffer_class", "total_timesteps", "horizon", "args", "kwargs"}
_NOT_SETTINGS |= {"observation_space", "action_space", "lr_schedule", "reward_function"}
_NOT_SETTINGS |= {"paths", "goals", "physics", "progress", "n_features"}


def preset_file(method: str, preset: str = "default") -> Path:
    """Return the YAML file of a method that comes with the package."""
    name = method if preset == "default" else f"{method}-{preset}"
    return Path(str(zoo_configs.__file__)).with_name(f"{name}.yml")


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
        ValueError: an id, a file, a key or a value that cannot be meant, with the nearest that can.
    """
    name = check_task(env_id)
    module = env_id.rpartition(":")[0] if name in IDS and name not in BUILT_IN else ""
    env_id = name if name in IDS else env_id
    if file is None:
        method = method or "fo"
        path = preset_file(method, preset)
    else:
        path = Path(file)
    entries = read_yaml(path)
    entry = _entry(entries, env_id, path)
    imagine = WRAPPER in _named(entry, "env_wrapper", path)
    settings = _flattened(entry, path)
    has_object_stage = imagine or _auxiliary_name(settings) == "sldr"
    if has_object_stage and env_id not in IDS:
        raise ValueError(
            f"{env_id!r} has no environment of its object alone, which imagined goals and SLDR's "
            f"reward come from; train it with --method her, or one of {', '.join(sorted(IDS))}"
        )
    if has_object_stage and _find(entries, object_id(env_id)) is not None:
        settings |= _object_stage(_entry(entries, object_id(env_id), path), path)
    schema = _schema()
    changes: dict[str, Any] = {}
    for name, value in (overrides or {}).items():
        _override(changes, name, value)
        _override(settings, name, value)
    _check(changes, schema, "--set")
    _check(settings, schema, str(path))
    if settings.get("auxiliary"):
        check_auxiliary(settings["auxiliary"])
    found = method_of(settings, imagine)
    if method is not None and method != found:
        raise ValueError(
            f"{path} trains {env_id} with method {found!r}{' after --set' * bool(changes)}, "
            f"not {method!r}: {_MARKS}"
        )

    total_timesteps = settings.pop("n_timesteps", RunConfig.total_timesteps)
    of_run = {name: settings.pop(name) for name in list(settings) if name in schema["run"]}
    of_class: dict[str, Any] = {"imagine": imagine}
    of_class |= {name: settings.pop(name) for name in list(settings) if name in schema["class"]}
    if settings:
        of_class["algorithm"] = settings
    return RunConfig(
        env_id,
        found,
        seed=seed,
        total_timesteps=total_timesteps,
        settings=with_tuples(of_class),
        module=module or None,
        **of_run,
    )


def method_of(settings: Mapping[str, Any], imagine: bool) -> str:
    """Return the name of the method that settings describe: its marks joined, "her" with none."""
    auxiliary = _auxiliary_name(settings)
    marks = {
        "fo": imagine,
        "shaped": settings.get("reward_type") == "dense",
        auxiliary: bool(auxiliary),
        "cher": (settings.get("replay_buffer_kwargs") or {}).get("cher") is not None,
    }
    return "-".join(name for name, marked in marks.items() if marked) or "her"


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
        saved = json.loads(path.read_text())
        config = RunConfig(**{**saved, "settings": with_tuples(saved["settings"])})
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
        entries = load_yaml(path.read_text())
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
        env_id = f"FollowObject/{'PushSideGap' if task.blocked_gripper else 'PnPSimpleV2'}-v0"
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
    known = {"env_wrapper": WRAPPER, "callback": CALLBACK}[key]
    for name, arguments in named.items():
        if name != known:
            raise ValueError(f"{path}: {key} can hold {known} here, not {name!r}")
        if not isinstance(arguments, dict):
            raise ValueError(f"{path}: the arguments of {name} are not a mapping")
    return named


def _flattened(entry: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return an entry with the arguments of its wrapper, callback and environments as settings."""
    settings = _plain(entry)
    for arguments in _named(settings, "env_wrapper", path).values():
        _check_names(arguments, ("predictor", "curriculum"), f"{path}: {WRAPPER}")
        if arguments.get("predictor", "auto") != "auto":
            raise ValueError(f"{path}: a run makes its own predictor; leave it out or say auto")
        settings["curriculum"] = arguments.get("curriculum") or {}
    for arguments in _named(settings, "callback", path).values():
        _check_names(arguments, _CALLBACK_NAMES, f"{path}: {CALLBACK}")
        settings |= {_CALLBACK_NAMES[name]: value for name, value in arguments.items()}
    env_kwargs = settings.get("env_kwargs") or {}
    _check_names(env_kwargs, ("reward_type",), f"{path}: env_kwargs")
    settings |= env_kwargs
    return {
        name: value
        for name, value in settings.items()
        if name not in ("env_wrapper", "callback", "env_kwargs")
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
    _check_names(env_kwargs, ("on_table",), f"{path}: env_kwargs of the object")
    return settings | {f"object_{name}": value for name, value in env_kwargs.items()}


def _override(settings: dict[str, Any], name: str, value: Any) -> None:
    *outer, last = name.split(".")
    for part in outer:
        inner = settings.get(part)
        settings[part] = dict(inner) if isinstance(inner, dict) else {}
        settings = settings[part]
    settings[last] = value


def _parameters(*functions: Callable[..., Any]) -> dict[str, Any]:
    """Return names and defaults of what can be set; the later function's default wins."""
    return {
        name: parameter.default
        for function in functions
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in _NOT_SETTINGS
    }


def _schema() -> dict[str, dict[str, Any]]:
    """Return everything that can be set and its default; a dict has settings of its own."""
    algorithm = _parameters(HerDDPG.__init__)
    algorithm["target_clip"] = None  # a pair, a word or nothing: the algorithm judges
    buffer = _parameters(FollowObjectReplayBuffer.__init__)
    for name in ("buffer_size", "device", "n_envs", "optimize_memory_usage"):
        del buffer[name]  # the algorithm's
    buffer["cher"] = _parameters(GoalSelection.__init__)
    algorithm["replay_buffer_kwargs"] = buffer
    algorithm["auxiliary"] = {"name": "rnd", "weight": 1.0}
    for name in provided(KIND):  # which settings belong to which reward is the algorithm's to check
        algorithm["auxiliary"] |= _parameters(reward_class(name).__init__)
    algorithm["policy_kwargs"] = _parameters(TD3Policy.__init__, HerPolicy.__init__)
    of_class = _parameters(FollowObject.__init__)
    of_class["curriculum"] = _parameters(Curriculum.__init__)
    of_class["object_algorithm"] = {n: v for n, v in algorithm.items() if n != "policy"}
    of_class["predictor_fit"] = _parameters(GoalPredictor.fit)
    del of_class["predictor_fit"]["object_on_table"]  # the class's
    of_class["inverse_fit"] = _parameters(ObjectNetworks.check_fit)
    return {"algorithm": algorithm, "class": of_class, "run": _parameters(RunConfig)}


def _check(settings: dict[str, Any], schema: dict[str, dict[str, Any]], where: str) -> None:
    known = {name: default for part in schema.values() for name, default in part.items()}
    _check_tree(settings, {"n_timesteps": RunConfig.total_timesteps, **known}, where)


def _check_tree(settings: dict[str, Any], known: dict[str, Any], where: str) -> None:
    _check_names(settings, known, where)
    for name, value in settings.items():
        default = known[name]
        if isinstance(default, dict):
            if value is not None and not isinstance(value, dict):
                raise ValueError(f"{where}: {name} must be a mapping, not {value!r}")
            _check_tree(value or {}, default, f"{where}: {name}")
        elif not _fits(value, default):
            kind = "true or false" if isinstance(default, bool) else f"like {default!r}"
            raise ValueError(f"{where}: {name} must be {kind}, not {value!r}")
        elif value is not None or default not in (None, inspect.Parameter.empty):
            check_value(name, value, where)


def _check_names(settings: Any, known: Any, where: str) -> None:
    if not isinstance(settings, dict):
        raise ValueError(f"{where} must be a mapping, not {settings!r}")
    for name in settings:
        if name not in known:
            raise ValueError(f"{where} has no setting {name!r}{did_you_mean(name, known)}")


def _fits(value: Any, default: Any) -> bool:
    """Whether a value can stand where a default of a plain type does; others are not judged."""
    if isinstance(default, bool):
        return isinstance(value, bool)
    if isinstance(default, int | float):
        kinds = (int,) if isinstance(default, int) else (int, float)
        return isinstance(value, kinds) and not isinstance(value, bool)
    return not isinstance(default, str) or isinstance(value, str)


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
