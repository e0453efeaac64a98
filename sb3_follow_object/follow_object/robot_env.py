"""The robot's environment, as the settings of a run want it; nothing is imagined in it yet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from ..common.seeds import stream_seed
from ..envs import IDS
from ..envs.robot_copies import robot_vec_env


def robot_env(settings: Mapping[str, Any], purpose: str) -> VecEnv:
    """Make the copies of the robot's environment.

    Args:
        settings: `FollowObject`'s, with env_id and seed.
        purpose: name of the random stream that their episodes are drawn from.
    """
    reward_type = settings["reward_type"]
    # Environments of others need not know the word; theirs are sparse unless asked.
    ours = settings["env_id"] in IDS
    options = {"reward_type": reward_type} if ours or reward_type != "sparse" else {}
    env = robot_vec_env(settings["env_id"], settings["n_envs"], settings["n_threads"], **options)
    env.seed(stream_seed(settings["seed"], purpose))
    return env
