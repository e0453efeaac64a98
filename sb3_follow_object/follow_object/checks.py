"""What is refused before a run begins rather than hours later."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from ..ddpg.her_ddpg import HerDDPG
from ..envs import make_vec, object_id
from ..imagination.curriculum import Curriculum
from ..imagination.goal_predictor import GoalPredictor
from ..object_stage.networks import ObjectNetworks
from ..settings.keywords import check_keywords
from ..settings.ranges import check_positive

_COUNTS = ("n_envs", "object_n_envs", "object_timesteps", "test_every", "n_test_episodes")
_OF_RUN = {"env", "seed", "_init_setup_model"}  # what the run itself gives its algorithms


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raise a ValueError for a keyword that nothing takes or a number out of its range.

    Args:
        settings: `FollowObject`'s.
    """
    check_positive(**{name: settings[name] for name in _COUNTS})
    if settings["n_paths"] < 2:
        raise ValueError(f"n_paths is {settings['n_paths']}; it must be at least 2")
    for name, function, hidden in (
        ("algorithm", HerDDPG.__init__, _OF_RUN),
        ("curriculum", Curriculum.__init__, {"horizon"}),
        ("object_algorithm", HerDDPG.__init__, {*_OF_RUN, "policy"}),
        ("predictor_fit", GoalPredictor.check_fit, ()),
        ("inverse_fit", ObjectNetworks.check_fit, ()),
    ):
        check_keywords(name, settings[name], function, hidden)
    GoalPredictor.check_fit(**settings["predictor_fit"])
    ObjectNetworks.check_fit(**settings["inverse_fit"])


def check_algorithms(settings: Mapping[str, Any], env: VecEnv, needs_networks: bool) -> None:
    """Build a run's algorithms once, in small.

    Args:
        settings: `FollowObject`'s.
        env: the robot's, without imagined goals.
        needs_networks: whether SLDR's reward will read the object's networks.

    Raises:
        ValueError: one cannot be built.
    """
    arguments = copy.deepcopy(settings["algorithm"])  # SB3 writes into policy_kwargs
    # What these two need is not there yet; their settings have been checked.
    if needs_networks:
        del arguments["auxiliary"]
    if settings["imagine"] and arguments.get("replay_buffer_kwargs"):
        arguments["replay_buffer_kwargs"]["imagined_ratio"] = 0.0
    _check_algorithm(env, arguments)
    if settings["imagine"] or needs_networks:
        object_env = make_vec(object_id(settings["env_id"]), 1)
        _check_algorithm(object_env, copy.deepcopy(settings["object_algorithm"]))
        object_env.close()


def _check_algorithm(env: VecEnv, arguments: dict[str, Any]) -> None:
    if (arguments.get("replay_buffer_kwargs") or {}).get("copy_info_dict"):
        raise ValueError("copy_info_dict cannot be set: checkpoints do not hold infos")
    small = {"policy": "MultiInputPolicy", "buffer_size": 10 * env.num_envs}
    try:
        HerDDPG(env=env, **{**arguments, **small})
    except ValueError:
        raise
    except Exception as error:  # SB3 and torch raise anything; so do others' environments
        reason = str(error) or type(error).__name__
        raise ValueError(f"the algorithm cannot be built: {reason}") from error
