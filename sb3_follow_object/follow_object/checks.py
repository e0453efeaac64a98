"""What is refused before a run begins rather than hours later."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from ..any_task.tasks import object_vec_env, steps_of_object
from ..common.torch_helpers import usable_device
from ..ddpg.her_ddpg import HerDDPG
from ..imagination.vec_env import imagination_of
from ..object_stage.networks import check_readable
from ..object_stage.sldr import task_of_package
from ..reach.approach import check_reachable, reach_first_settings
from ..replay.her_replay_buffer import IMAGINED_RATIO
from ..replay.steps import refuse_margin
from ..settings.fields import settings_of
from ..settings.learning import PredictorSettings
from ..settings.sizes import check_stages
from ..settings.stages import BEHIND, ReachFirstSettings, ReachTeachingSettings


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
    if settings.get("reach") is not None:
        reach = reach_first_settings(reach_parts(settings)[0], "reach", None)
        check_reachable(env.observation_space, env.action_space, reach)
    arguments = copy.deepcopy(settings["algorithm"])  # SB3 writes into policy_kwargs
    # What these two need is not there yet; their settings have been checked.
    if needs_networks:
        task_of_package(env)
        del arguments["auxiliary"]
    replay = arguments.get("replay_buffer_kwargs") or {}
    if settings["reward_type"] == "dense" and replay.get("goal_margin"):
        refuse_margin()
    if settings["imagine"] and replay:
        replay["imagined_ratio"] = 0.0
    elif replay.get("imagined_ratio"):
        imagination_of(env, IMAGINED_RATIO)
    _check_algorithm(env, horizon, arguments)
    if settings["imagine"] or needs_networks:
        check_object_stage(settings, horizon, needs_networks)


def check_object_stage(settings: Mapping[str, Any], horizon: int, needs_networks: bool) -> None:
    """Build the object's algorithm once, in small.

    Args:
        settings: `FollowObject`'s.
        horizon: T, steps of the robot's episodes.
        needs_networks: whether SLDR's reward will read the object's networks.

    Raises:
        ValueError: it cannot be built, or SLDR's reward could not read it.
    """
    usable_device(settings["predictor_fit"].get("device", PredictorSettings.device))
    env_id, arguments = settings["env_id"], copy.deepcopy(settings["object_algorithm"])
    env = object_vec_env(env_id, 1)
    try:
        model = _check_algorithm(env, steps_of_object(env_id, horizon), arguments)
        if needs_networks:
            check_readable(model.policy)
    finally:
        env.close()


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


def _check_algorithm(env: VecEnv, horizon: int, arguments: dict[str, Any]) -> HerDDPG:
    if (arguments.get("replay_buffer_kwargs") or {}).get("copy_info_dict"):
        raise ValueError("copy_info_dict cannot be set: checkpoints do not hold infos")
    small = {"policy": "MultiInputPolicy", "buffer_size": horizon * env.num_envs}
    try:
        return HerDDPG(env=env, **{**arguments, **small})
    except ValueError:
        raise
    except Exception as error:  # SB3 and torch raise anything; so do others' environments
        reason = str(error) or type(error).__name__
        raise ValueError(f"the algorithm cannot be built: {reason}") from error
