"""What an environment must be so that HerDDPG can learn in it."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from ..envs.goal_envs import episode_steps, missing_goal_keys
from ..imagination.goal_env import check_unstacked


def check_goals(space: spaces.Space) -> None:
    """Raise a ValueError for observations without goals, or which are not vectors of numbers."""
    missing = missing_goal_keys(space)
    if missing:
        raise ValueError(
            f"the environment's observations lack {', '.join(missing)}; HerDDPG needs "
            "a goal environment with observation, achieved_goal and desired_goal"
        )
    assert isinstance(space, spaces.Dict)
    for key in ("observation", "desired_goal"):
        part = space[key]
        if not isinstance(part, spaces.Box) or is_image_space(part):
            raise ValueError(
                f"the observation's {key} is {part}; HerDDPG standardises numbers, and needs a Box "
                "of them: encode choices and images outside of it"
            )


def check_wrappers(env: Any) -> None:
    """Raise a ValueError for an environment in VecNormalize or VecFrameStack."""
    if unwrap_vec_normalize(env) is not None:
        raise ValueError(
            "HerDDPG standardises its inputs itself and knows the range of its rewards; leave "
            "VecNormalize (rl_zoo3's normalize) out"
        )
    check_unstacked(env)


def horizon_of(env: Any) -> int:
    """Return T, steps of an episode.

    Raises:
        ValueError: the environment does not tell it.
    """
    steps = episode_steps(env)
    if steps is None:
        raise ValueError(
            "the environment does not say how long its episodes are (spec.max_episode_steps); "
            "give gamma and train_freq in steps"
        )
    return steps


def check_rewards(rewards: th.Tensor, clipped: bool, hindsight_bound: bool) -> None:
    """Raise a ValueError for rewards whose targets would be bounded wrongly.

    Args:
        rewards: of a batch.
        clipped: whether targets have the bounds of `target_clip` "auto".
        hindsight_bound: whether they are raised to what episodes of -1 a step prove.
    """
    outside = rewards[(rewards > 0.0) | (rewards < -1.0)]
    if clipped and len(outside):
        raise ValueError(
            f"a reward is {float(outside[0]):g}; target_clip 'auto' is for rewards from -1 "
            "to 0: give (low, high), the bounds of the returns, or None"
        )
    if hindsight_bound and not bool(((rewards == 0.0) | (rewards == -1.0)).all()):
        raise ValueError(
            "hindsight_bound is for rewards of -1 and 0, and one is another; set it to false"
        )
