"""What keeps a replay buffer true to the environment that its algorithm has."""

from __future__ import annotations

import warnings
from typing import Any

from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from .her_replay_buffer import FollowObjectReplayBuffer
from .steps import check_copies


def follow_env(buffer: Any, env: VecEnv) -> None:
    """Let a hindsight buffer ask this environment; others ask none.

    Raises:
        ValueError: it has another number of copies, or lacks what the buffer asks for.
    """
    check_copies(buffer.n_envs, env.num_envs)
    if not isinstance(buffer, HerReplayBuffer) or buffer.env is env:
        return
    if isinstance(buffer, FollowObjectReplayBuffer):
        buffer.set_env(env)
    else:
        if buffer.env is not None:
            end_running_episodes(buffer)
        buffer.env = env


def episodes_are_whole(buffer: Any) -> bool:
    """Whether no episode in a replay buffer waits for its end."""
    return not isinstance(buffer, HerReplayBuffer) or bool(
        (buffer._current_ep_start == buffer.pos).all()
    )


def end_running_episodes(buffer: Any) -> None:
    """End the episodes of a hindsight buffer that their environment will not go on with."""
    if episodes_are_whole(buffer):
        return
    if isinstance(buffer, FollowObjectReplayBuffer):
        buffer.end_episodes()
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of just what is wanted here
        buffer.truncate_last_trajectory()
