"""YAML in rl_zoo3's layout: under each environment's id what trains it, read as settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..common.plain_yaml import load_yaml
from ..common.suggestions import did_you_mean
from ..envs import IDS, object_id
from ..envs.task_table import BUILT_IN
from .fields import Group, Setting, check_names, settings_of
from .run_config import RunConfig
from .stages import ReachFirstSettings, ReachTeachingSettings, StageSettings, part_of_reach
from .table import check_dotted

# The package's task that one of one's own is set up as, by whether its object is pushed.
SIMILAR = {True: "FollowObject/PushSideGap-v0", False: "FollowObject/PnPSimpleV2-v0"}

WRAPPER = "sb3_follow_object.ImaginedGoalWrapper"
CALLBACK = "sb3_follow_object.CurriculumCallback"
OF_RUNS = "sb3-follow-object"  # an entry for all tasks that rl_zoo3 does not look at
REACH_WRAPPER = "sb3_follow_object.ReachFirstWrapper"
REACH_CALLBACK = "sb3_follow_object.ReachCallback"
_KNOWN = {"env_wrapper": (WRAPPER, REACH_WRAPPER), "callback": (CALLBACK, REACH_CALLBACK)}
# The callback's keyword arguments, and what FollowObject calls them.
_CALLBACK_NAMES = {"every": "test_every", "n_episodes": "n_test_episodes", "store": "store_tests"}
# Settings of stock algorithms, and rl_zoo3's for them, that runs have not.
_OF_STOCK = ("normalize", "noise_type", "replay_buffer_class", "ent_coef", "use_sde")


class ZooFile:
    """One file.

    Args:
        path: of it.

    Raises:
        ValueError: the file is missing, is not YAML, or is no mapping of ids to settings; so do
            all methods where what they read is invalid.
    """

    def __init__(self, path: Path):
        self.path = path
        self._entries = read_yaml(path)

    def names(self, env_id: str) -> bool:
        """Whether it has an entry under an environment's id, with or without its module."""
        return not {env_id, env_id.rpartition(":")[2]}.isdisjoint(self._entries)

    def imagines(self, env_id: str) -> bool:
        """Whether an environment's entry shows imagined goals."""
        return WRAPPER in self._classes(self._entry(env_id), "env_wrapper")

    def settings(self, env_id: str) -> dict[str, Any]:
        """Return what is said of all tasks, and of an environment in its entry or in "default".

        The arguments of its wrappers, callbacks and environments are settings like the others.
        """
        settings = with_numbers(self._entry(env_id))
        if stock := [name for name in _OF_STOCK if name in settings]:
            raise ValueError(
                f"{self.path} has {stock[0]!r}, as a file for one of rl_zoo3's stock algorithms: "
                "train it by `python -m rl_zoo3.train` (docs/rl_zoo3.md)"
            )
        check_dotted(settings, str(self.path))
        wrappers = self._classes(settings, "env_wrapper")
        callbacks = self._classes(settings, "callback")
        if WRAPPER in wrappers:
            arguments = wrappers[WRAPPER]
            self._check_names(arguments, ("predictor", "curriculum"), WRAPPER)
            if arguments.get("predictor", "auto") != "auto":
                raise ValueError(
                    f"{self.path}: a run makes its own predictor; leave it out or say auto"
                )
            settings["curriculum"] = arguments.get("curriculum") or {}
        if CALLBACK in callbacks:
            arguments = callbacks[CALLBACK]
            self._check_names(arguments, _CALLBACK_NAMES, CALLBACK)
            settings |= {_CALLBACK_NAMES[name]: value for name, value in arguments.items()}
        if REACH_WRAPPER in wrappers or REACH_CALLBACK in callbacks:
            settings["reach"] = self._reach(wrappers, callbacks)
        env_kwargs = settings.get("env_kwargs") or {}
        self._check_names(env_kwargs, ("reward_type",), "env_kwargs")
        settings |= env_kwargs
        for name in ("env_wrapper", "callback", "env_kwargs"):
            settings.pop(name, None)
        return {**self._of_runs(), **settings}

    def object_settings(self, object_id: str) -> dict[str, Any]:
        """Return the first stage's settings from the entry of the object's own environment."""
        if self._find(object_id) is None:
            return {}
        algorithm = with_numbers(self._entry(object_id))
        algorithm.pop("policy", None)  # rl_zoo3 wants it; the first stage knows only one
        settings: dict[str, Any] = {"object_algorithm": algorithm}
        for name, ours in (("n_timesteps", "object_timesteps"), ("n_envs", "object_n_envs")):
            if name in algorithm:
                settings[ours] = algorithm.pop(name)
        env_kwargs = algorithm.pop("env_kwargs", {})
        self._check_names(env_kwargs, ("on_table",), "env_kwargs of the object")
        return settings | {f"object_{name}": value for name, value in env_kwargs.items()}

    def _find(self, env_id: str) -> Any:
        """Return an id's entry; for a task of one's own, otherwise the most similar one's."""
        if env_id not in self._entries and env_id in IDS and env_id not in BUILT_IN:
            task, alone = IDS[env_id]
            env_id = SIMILAR[task.blocked_gripper]
            env_id = object_id(env_id) if alone else env_id
        return self._entries.get(env_id, self._entries.get(env_id.rpartition(":")[2]))

    def _entry(self, env_id: str) -> dict[str, Any]:
        entry = self._find(env_id)
        if entry is None:
            entry = self._entries.get("default")
        if entry is None:
            meant = did_you_mean(env_id, self._entries)
            raise ValueError(f"{self.path} has no settings for {env_id!r}{meant}")
        if not isinstance(entry, dict):
            raise ValueError(f"{self.path}: the settings of {env_id!r} are not a mapping")
        return entry

    def _of_runs(self) -> dict[str, Any]:
        """Return the settings of all tasks that are a run's or the three stages', not rl_zoo3's."""
        given = self._entries.get(OF_RUNS) or {}
        if not isinstance(given, dict):
            raise ValueError(f"{self.path}: the settings of {OF_RUNS!r} are not a mapping")
        self._check_names(given, {**of_data(RunConfig), **of_data(StageSettings)}, OF_RUNS)
        return dict(with_numbers(given))

    def _classes(self, entry: dict[str, Any], key: str) -> dict[str, dict[str, Any]]:
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
                raise ValueError(
                    f"{self.path}: {key} must list class names with arguments, not {item!r}"
                )
        for name, arguments in named.items():
            if name not in _KNOWN[key]:
                can = " and ".join(_KNOWN[key])
                raise ValueError(f"{self.path}: {key} can hold {can}, not {name!r}")
            if not isinstance(arguments, dict):
                raise ValueError(f"{self.path}: the arguments of {name} are not a mapping")
        return named

    def _reach(self, wrappers: dict[str, Any], callbacks: dict[str, Any]) -> dict[str, Any]:
        """Return the setting `reach` from the arguments of its wrapper and of its callback."""
        if REACH_WRAPPER not in wrappers or REACH_CALLBACK not in callbacks:
            given, missing = REACH_CALLBACK, f"the env_wrapper {REACH_WRAPPER}"
            if REACH_WRAPPER in wrappers:
                given, missing = REACH_WRAPPER, f"the callback {REACH_CALLBACK}"
            raise ValueError(
                f"{self.path}: {given} does nothing without {missing}; give both or neither"
            )
        first, teaching = wrappers[REACH_WRAPPER], callbacks[REACH_CALLBACK]
        return {
            **part_of_reach(ReachTeachingSettings, teaching, f"{self.path}: {REACH_CALLBACK}"),
            **part_of_reach(ReachFirstSettings, first, f"{self.path}: {REACH_WRAPPER}"),
        }

    def _check_names(self, given: Any, known: Any, whose: str) -> None:
        check_names(given, known, f"{self.path}: {whose}")


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


def with_numbers(value: Any) -> Any:
    """Read 1e-3, a word in YAML 1.1, as a number, and !!float 1e6 as the whole one it is."""
    if isinstance(value, dict):
        return {name: with_numbers(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [with_numbers(inner) for inner in value]
    if not isinstance(value, str | float):
        return value
    try:
        number = float(value)
    except ValueError:
        return value
    return int(number) if number.is_integer() else number


def of_data(group: type[Group]) -> dict[str, Setting]:
    """Return what data can say of a group."""
    return {name: each for name, each in settings_of(group).items() if each.data}
