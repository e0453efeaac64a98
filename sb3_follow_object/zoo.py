"""rl_zoo3 with HerDDPG among its algorithms: ``python -m sb3_follow_object.zoo train ...``.

rl_zoo3 reads --algo before it imports --gym-packages, so an algorithm cannot come in as an
environment does: it has to be in the tables before rl_zoo3's own commands begin.
"""

from __future__ import annotations

import argparse
import inspect
import runpy
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .common.extras import need
from .ddpg.her_ddpg import HerDDPG
from .envs.registration import import_task
from .settings.fields import check_names
from .settings.presets import preset_file
from .settings.zoo_yaml import read_yaml

ALGORITHM = "her_ddpg"
COMMANDS = ("train", "enjoy", "record_video", "load_from_hub", "push_to_hub")
PROGRAM = "python -m sb3_follow_object.zoo"
USER_ERROR = 2

_USAGE = f"""usage: {PROGRAM} COMMAND ...

rl_zoo3 with {ALGORITHM} among its algorithms. COMMAND is one of {", ".join(COMMANDS)};
COMMAND --help lists its options. See docs/rl_zoo3.md."""
_NO_RECORD_TRAINING = (
    "record_training starts rl_zoo3.record_video, which does not know her_ddpg: give record_video "
    "with --load-checkpoint for each model"
)
_OF_LOAD = "_init_setup_model"  # an argument that SB3's load() gives
_NO_SETTINGS = ("self", "env", _OF_LOAD)
_PARTS = {
    "policy_kwargs": ("net_arch", "critic_layer_norm"),
    "replay_buffer_kwargs": ("n_sampled_goal", "moved_ratio"),
}
_NET_ARCHS = {"small": [256, 256], "medium": [256, 256, 256], "big": [512, 512, 512]}


class ZooHerDDPG(HerDDPG):
    """HerDDPG as rl_zoo3 uses it: settings of trials in one level.

    Args:
        policy: as in HerDDPG.
        env: as in HerDDPG.
        settings: HerDDPG's keyword arguments, and those of its policy and replay buffer that
            `sample_settings` draws, which take precedence over policy_kwargs and
            replay_buffer_kwargs. rl_zoo3 replaces nested settings as a whole, so a trial's would
            take the rest of the file's with them.

    Raises:
        ValueError: HerDDPG has no such setting, or refuses its value.
    """

    def __init__(self, policy: Any, env: Any, **settings: Any):
        settings = _nested(settings)
        known = [n for n in inspect.signature(HerDDPG.__init__).parameters if n not in _NO_SETTINGS]
        check_names({n: v for n, v in settings.items() if n != _OF_LOAD}, known, "HerDDPG")
        super().__init__(policy, env, **settings)

    def learn(
        self, total_timesteps: int, callback: Any = None, *args: Any, **kwargs: Any
    ) -> ZooHerDDPG:
        """Learn; arguments as in SB3.

        Raises:
            ValueError: this was a trial of -optimize, which ended before rl_zoo3 evaluated it.
        """
        super().learn(total_timesteps, callback, *args, **kwargs)
        last = callback[-1] if isinstance(callback, list) and callback else None
        if getattr(last, "eval_idx", None) == 0:
            raise ValueError(
                "the trial ended before its first evaluation, because a curriculum's tests are "
                "among its steps: give --n-evaluations 4 or more"
            )
        return self

    @classmethod
    def load(cls, path: Any, env: Any = None, *args: Any, **kwargs: Any) -> ZooHerDDPG:
        """Load a model; arguments as in SB3. Without an environment it can act, not learn."""
        for name in _PARTS["policy_kwargs"]:  # a loaded policy keeps its networks
            kwargs.pop(name, None)
        return super().load(path, env, *args, **_nested(kwargs))


def _nested(settings: dict[str, Any]) -> dict[str, Any]:
    """Put the settings of policy and replay buffer where HerDDPG takes them."""
    settings = dict(settings)
    for part, names in _PARTS.items():
        given = {name: settings.pop(name) for name in names if name in settings}
        if given:
            settings[part] = {**(settings.get(part) or {}), **given}
    return settings


def sample_settings(
    trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Draw settings of HerDDPG for a trial of rl_zoo3's -optimize.

    Args:
        trial: Optuna's.
        n_actions: of the environment; no setting depends on it.
        n_envs: copies of the environment; updates are drawn per episode of one copy, from the
            paper's one (40 for 38 episodes) to HerDDPG's 40.
        additional_args: rl_zoo3's for its own replay buffer; not read.
    """
    trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True)
    trial.suggest_categorical("batch_size", [128, 256, 512, 1024])
    trial.suggest_float("tau", 0.002, 0.1, log=True)
    trial.suggest_int("gradient_steps", n_envs, 40 * n_envs, log=True)
    trial.suggest_float("noise_std", 0.05, 0.4)
    trial.suggest_float("random_action_prob", 0.0, 0.5)
    trial.suggest_int("n_sampled_goal", 1, 8)
    trial.suggest_float("moved_ratio", 0.0, 0.75)
    trial.suggest_categorical("net_arch", list(_NET_ARCHS))
    trial.suggest_categorical("critic_layer_norm", [False, True])
    trial.suggest_categorical("hindsight_bound", [False, True])
    trial.suggest_categorical("average_decay", [0.0, 0.999, 0.9996])
    return convert_settings(trial.params)


def convert_settings(params: dict[str, Any]) -> dict[str, Any]:
    """Return a trial's parameters as settings of `ZooHerDDPG`."""
    return {**params, "net_arch": _NET_ARCHS[params["net_arch"]]}


def register() -> None:
    """Make rl_zoo3 know HerDDPG as "her_ddpg", and how to search for its settings.

    Raises:
        ValueError: rl_zoo3 is not installed.
    """
    need("rl_zoo3", "zoo").ALGOS[ALGORITHM] = ZooHerDDPG
    search = need("rl_zoo3.hyperparams_opt", "zoo")
    search.HYPERPARAMS_SAMPLER[ALGORITHM] = sample_settings
    search.HYPERPARAMS_CONVERTER[ALGORITHM] = convert_settings


def _check(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the options that rl_zoo3 would pass over or answer with a traceback.

    Raises:
        ValueError: one of them is invalid.
    """
    store_dict = need("rl_zoo3.utils", "zoo").StoreDict
    parser = argparse.ArgumentParser(PROGRAM, add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default=ALGORITHM)
    parser.add_argument("--env")
    for names in (["-params", "--hyperparams"], ["--env-kwargs"], ["--eval-env-kwargs"]):
        parser.add_argument(*names, nargs="+", action=store_dict)
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    parser.add_argument("-i", "--trained-agent", default="")
    parser.add_argument("--truncate-last-trajectory", default="True")
    parser.add_argument("--log-interval", type=int)
    for name in ("--storage", "--study-name"):
        parser.add_argument(name)
    parser.add_argument("--trial-id", type=int)
    parser.add_argument("-conf", "--conf-file", type=Path)
    try:
        given, _ = parser.parse_known_args(arguments)
    except Exception as error:  # rl_zoo3 evaluates what is given
        raise ValueError(
            f"-params and --env-kwargs take name:value, where the value is Python: {error}"
        ) from error
    if given.optimize_hyperparameters and given.trained_agent:
        raise ValueError("-optimize begins each trial anew: leave -i (--trained-agent) out")
    if given.truncate_last_trajectory not in ("True", ""):
        raise ValueError(
            "rl_zoo3 takes every text after --truncate-last-trajectory for true: give '' for false"
        )
    if given.log_interval == 0:
        raise ValueError("--log-interval is 0; give episodes, or -2 for no log")
    if given.trial_id is not None:
        _check_trial(given)
    if given.conf_file is not None and given.conf_file.suffix in (".yml", ".yaml"):
        for env_id, entry in read_yaml(given.conf_file).items():
            if not isinstance(entry, dict):
                raise ValueError(f"{given.conf_file}: the settings of {env_id!r} are not a mapping")
    n_envs = (given.hyperparams or {}).get("n_envs", 1)
    if not isinstance(n_envs, int) or n_envs < 1:
        raise ValueError(f"n_envs is {n_envs!r}; give a whole number of 1 or more")
    return given


def _check_trial(given: argparse.Namespace) -> None:
    """Refuse a --trial-id whose settings rl_zoo3 would not take."""
    if given.storage is None or given.study_name is None:
        raise ValueError("--trial-id needs the --storage and the --study-name of its study")
    if given.trial_id == 0:
        raise ValueError("rl_zoo3 takes --trial-id 0 for none: give its settings with -params")
    manager = need("rl_zoo3.exp_manager", "zoo").ExperimentManager
    try:
        manager.load_trial(given, given.storage, given.study_name, given.trial_id)
    except LookupError as error:
        raise ValueError(
            f"{given.storage} has no settings of a trial {given.trial_id} of a study "
            f"{given.study_name!r}"
        ) from error


def _tell_missing_files() -> None:
    """Let rl_zoo3 see which files a model on the hub does without.

    It waits for the error of requests, with which huggingface_hub made its own until its first
    version.
    """
    sb3 = need("huggingface_sb3", "zoo")
    missing = need("huggingface_hub.errors", "zoo").EntryNotFoundError
    http_error = need("requests.exceptions", "zoo").HTTPError
    download = need("huggingface_sb3.load_from_hub", "zoo").load_from_hub

    def load_from_hub(repo_id: str, filename: str) -> str:
        try:
            return str(download(repo_id, filename))
        except missing as error:
            if isinstance(error, FileNotFoundError):  # the hub was not reached
                raise
            raise http_error(str(error)) from error

    sb3.load_from_hub = load_from_hub


def _run(command: str, arguments: Sequence[str]) -> None:
    """Run a script of rl_zoo3 with the defaults of this package before its arguments."""
    register()
    given = _check(arguments)
    defaults = ["--algo", ALGORITHM]
    if command == "train" and given.algo == ALGORITHM:
        defaults += ["--conf-file", str(preset_file("fo"))]
    if command in ("enjoy", "load_from_hub"):
        _tell_missing_files()
    # rl_zoo3 knows ids that are registered by now, without a module's name.
    env = [] if given.env is None else ["--env", import_task(given.env)]
    sys.argv = [f"{PROGRAM} {command}", *defaults, *arguments, *env]
    runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")


def _sentence(error: Exception) -> str:
    """Say in one line what went wrong."""
    if isinstance(error, EOFError) and not str(error):
        return "the process of an environment ended; what it wrote is above"
    return " ".join(str(error).split()) or type(error).__name__


def _is_of_training(error: Exception) -> bool:
    """Whether it was raised while an algorithm learned, so that what was asked for was sound."""
    calls = traceback.walk_tb(error.__traceback__)
    return any(frame.f_code.co_name == "learn" for frame, _ in calls)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command of rl_zoo3; return the exit status, 2 on bad input.

    The defaults are --algo her_ddpg and, for train, --conf-file with this package's fo.yml.

    Args:
        argv: the command and rl_zoo3's arguments; by default the process's.
    """
    command, *arguments = (sys.argv[1:] if argv is None else argv) or [""]
    if command in ("-h", "--help"):
        print(_USAGE)
        return 0
    try:
        if command == "record_training":
            raise ValueError(_NO_RECORD_TRAINING)
        if command not in COMMANDS:
            known = f"{', '.join(COMMANDS[:-1])} or {COMMANDS[-1]}"
            raise ValueError(f"give {known} first, not {command!r}")
        _run(command, arguments)
    except (ValueError, OSError, RuntimeError, AssertionError, ImportError, EOFError) as error:
        if isinstance(error, RuntimeError | AssertionError) and _is_of_training(error):
            raise
        print(f"{PROGRAM}: {_sentence(error)}", file=sys.stderr)
        return USER_ERROR
    except TypeError as error:
        if "environment creator" not in str(error):  # gym.make's word for --env-kwargs
            raise
        print(f"{PROGRAM}: {_sentence(error)}", file=sys.stderr)
        return USER_ERROR
    return 0


if __name__ == "__main__":
    sys.exit(main())
