"""Tests of a policy on fresh copies of its task."""

from __future__ import annotations

import os
from collections.abc import Callable

from stable_baselines3.common.vec_env import VecEnv

from ..callbacks.rollout import Episodes, run_episodes
from ..common.seeds import stream_seed
from ..ddpg.actor_files import load_actor
from ..envs.robot_copies import robot_vec_env

_COPIES = 38  # the paper's 380 episodes are ten from each


def evaluation_env(env_id: str, seed: int | None = None, n_threads: int | None = None) -> VecEnv:
    """Return fresh copies of a task with its own goals and its sparse reward."""
    env = robot_vec_env(env_id, _COPIES, n_threads)
    env.seed(seed)
    return env


def evaluate(
    policy_file: str | os.PathLike[str],
    env_id: str,
    n_episodes: int = 380,
    seed: int = 0,
    between_steps: Callable[[], None] = lambda: None,
    n_threads: int | None = None,
) -> Episodes:
    """Test a saved policy: original goals, no noise, fresh episodes (section 5.2).

    The episodes' seeds are of a stream that neither training nor validation draws from.

    Args:
        policy_file: written by `save_actor`.
        env_id: the task.
        n_episodes: at least 1.
        seed: of the run.
        between_steps: called after each step; may raise to stop.
        n_threads: threads or processes that step the copies; None takes one a core.

    Raises:
        ValueError: the file is missing, damaged or for other observations or actions, or
            `n_episodes` below 1.
    """
    env = evaluation_env(env_id, stream_seed(seed, "final test"), n_threads)
    try:
        space = env.observation_space
        actor, _ = load_actor(policy_file, space, env.action_space)  # type: ignore[arg-type]
        return run_episodes(
            lambda obs: actor.predict(obs, deterministic=True)[0],
            env,
            n_episodes,
            lambda *step: between_steps(),
        )
    finally:
        env.close()
