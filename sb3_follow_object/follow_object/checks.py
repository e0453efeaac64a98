"""What is refused before a run begins rather than hours later."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from ..any_task.tasks import (
    effector_of,
    effector_seen_in,
    object_vec_env,
    steps_of_object,
    steps_to_reach,
)
from ..common.numbers import checked_whole
from ..common.torch_helpers import usable_device
from ..ddpg.folding import AUTO
from ..ddpg.her_ddpg import HerDDPG
from ..envs import IDS
from ..object_stage.networks import SAY_NO_MIRRORS
from ..object_stage.sldr import task_of_package
from ..reach.approach import BEHIND, check_reachable, reach_first_settings
from ..settings.fields import checked, settings_of
from ..settings.learning import PredictorSettings
from ..settings.run_config import RunConfig, check_plain
from ..settings.sizes import check_stages
from ..settings.stages import ReachFirstSettings, ReachTeachingSettings, StageSettings


def checked_settings(env_id: str, given: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return the settings of a `FollowObject`; warn of one that a save could not hold.

    Raises:
        ValueError: one is unknown or out of range.
    """
    settings = {
        "env_id": env_id,
        **checked(StageSettings, given, "FollowObject"),
        "seed": checked_whole("seed", seed, 0),
    }
    try:
        check_plain(settings, "save()")
    except ValueError as error:
        warnings.warn(f"{error}; all else can be done", stacklevel=3)  # of who makes one
    return settings


def check_algorithms(
    settings: Mapping[str, Any], env: VecEnv, horizon: int, needs_networks: bool
) -> None:
    """Build a run's algorithms once, in small.

    Args:
        settings: `FollowObject`'s.
        env: the robot's, without imagined goals.
        horizon: T, steps of an episode.
        needs_networks: whether SLDR's reward will read the object's networks.

    Raises:
        ValueError: one cannot be built.
    """
    check_stages(settings["env_id"], settings, horizon)
    usable_device(settings["predictor_fit"].get("device", PredictorSettings.device))
    if settings.get("reach") is not None:
        reach = reach_first_settings(reach_parts(settings)[0], "reach", None)
        check_reachable(env.observation_space, env.action_space, reach)
    arguments = copy.deepcopy(settings["algorithm"])  # SB3 writes into policy_kwargs
    # What these two need is not there yet; their settings have been checked.
    if needs_networks:
        task_of_package(env)
        mirrors = (settings["object_algorithm"].get("policy_kwargs") or {}).get("mirrors")
        if mirrors not in (None, [], AUTO):
            raise ValueError(SAY_NO_MIRRORS)
        del arguments["auxiliary"]
    if settings["imagine"] and arguments.get("replay_buffer_kwargs"):
        arguments["replay_buffer_kwargs"]["imagined_ratio"] = 0.0
    _check_algorithm(env, horizon, arguments)
    if settings["imagine"] or needs_networks:
        env_id = settings["env_id"]
        object_env, horizon = object_vec_env(env_id, 1), steps_of_object(env_id, horizon)
        _check_algorithm(object_env, horizon, copy.deepcopy(settings["object_algorithm"]))
        object_env.close()


def reach_parts(
    settings: Mapping[str, Any], on_table: bool | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of reaching first, those of its wrapper and those of its callback.

    Args:
        settings: `FollowObject`'s.
        on_table: whether the object's stage has kept it on its surface; None asks the settings.
    """
    reach = settings["reach"]
    # Where objects are kept on the table for the sake of pushing, the standoff is that of pushing.
    on_table = settings["object_on_table"] if on_table is None else on_table
    if on_table and reach.get("standoff", "auto") == "auto":
        reach = {**reach, "standoff": BEHIND}
    first, teaching = (
        {name: value for name, value in reach.items() if name in settings_of(part)}
        for part in (ReachFirstSettings, ReachTeachingSettings)
    )
    return first, teaching


def reach_in(reach: Any, env_id: str, imagine: bool) -> Any:
    """Return the setting `reach` with what a task of others says of it: effector and steps.

    Args:
        reach: as given.
        env_id: a task; the physics of one of others says where the observation tells the effector.
        imagine: whether goals are imagined.

    Raises:
        ValueError: no part of the robot is told in the observation.
    """
    if not isinstance(reach, Mapping) or env_id in IDS:
        return reach
    found: dict[str, Any] = {"max_steps": steps_to_reach(env_id)}
    if "effector" not in reach:
        effector = effector_of(env_id) if imagine else effector_seen_in(env_id)
        if effector is not None:
            found["effector"] = effector
    return {**found, **reach}


def on_table_for(lift: object, on_table: bool | None) -> bool:
    """Return the setting object_on_table that a setting `lift` other than "auto" means.

    Raises:
        ValueError: it is neither True nor False, or both are given.
    """
    if not isinstance(lift, bool):
        raise ValueError(f'lift must be True, False or "auto", not {lift!r}')
    if on_table is not None:
        raise ValueError("lift and object_on_table say the same; give one of them")
    return not lift


def _check_algorithm(env: VecEnv, horizon: int, arguments: dict[str, Any]) -> None:
    if (arguments.get("replay_buffer_kwargs") or {}).get("copy_info_dict"):
        raise ValueError("copy_info_dict cannot be set: checkpoints do not hold infos")
    small = {"policy": "MultiInputPolicy", "buffer_size": horizon * env.num_envs}
    try:
        HerDDPG(env=env, **{**arguments, **small})
    except ValueError:
        raise
    except Exception as error:  # SB3 and torch raise anything; so do others' environments
        reason = str(error) or type(error).__name__
        raise ValueError(f"the algorithm cannot be built: {reason}") from error


def check_places(arguments: Mapping[str, Any], overrides: Mapping[str, Any]) -> None:
    """Raise a ValueError for what `from_preset` takes elsewhere or not at all.

    Args:
        arguments: those of the class.
        overrides: settings by their dotted names.
    """
    for name in settings_of(StageSettings).keys() & arguments.keys():
        raise ValueError(f"{name} is a setting: give overrides={{{name!r}: ...}}")
    for name in settings_of(RunConfig).keys() & overrides.keys():
        raise ValueError(f"{name} is of a run folder, which train() makes; learn() takes env steps")
