"""Noise-free episodes in a vectorised environment, for evaluation, curriculum tests and paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from ..common.answers import check_shape, one_each, one_number
from ..common.numbers import checked_whole
from ..ddpg.her_ddpg import HerDDPG
from ..imagination.goal_env import with_terminal_observations

Observation = dict[str, np.ndarray]
Policy = Callable[[Observation], np.ndarray]
OnStep = Callable[
    [Observation, np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]], Observation], None
]


def check_hears_rollouts(callback: BaseCallback) -> None:
    """Raise a ValueError where another callback stands between a callback and the rollouts' ends.

    SB3's event callbacks, such as EveryNTimesteps, pass on steps and nothing else.
    """
    if callback.parent is not None:
        raise ValueError(
            f"{type(callback).__name__} works at the end of rollouts, of which "
            f"{type(callback.parent).__name__} tells it nothing: put it beside that, in a list"
        )


@dataclass(frozen=True)
class Episodes:
    """What a batch of finished episodes came to.

    Attributes:
        success: (n,) bool, `is_success` at the last step of each episode, for the goal shown.
        reached: (n,) bool, whether any of its steps said so.
        returns: (n,) float, undiscounted sum of the rewards.
        env_steps: steps simulated, all copies counted, episodes that were not needed included.
    """

    success: np.ndarray
    reached: np.ndarray
    returns: np.ndarray
    env_steps: int

    @property
    def success_rate(self) -> float:
        """Share of the episodes that ended on the goal shown."""
        return float(self.success.mean())


def run_episodes(
    policy: Policy, venv: VecEnv, n_episodes: int, on_step: OnStep | None = None
) -> Episodes:
    """Run `n_episodes` fresh episodes and say how they ended.

    Each copy contributes the same number of episodes (to within one), so that quick failures are
    not over-represented. Episodes whose info says "diverged" at the end are not counted.

    Args:
        policy: maps observations, arrays of (n_envs, ...), to actions (n_envs, action_dim).
        venv: is reset first; its copies reset by themselves afterwards.
        n_episodes: at least 1.
        on_step: called after every step with (obs, actions, rewards, dones, infos, next_obs), where
            next_obs holds the terminal observation of the copies that are done.

    Raises:
        ValueError: if `n_episodes` is below 1, an episode ends without saying `is_success`, or an
            array has another shape than that of the environment's copies.
        RuntimeError: more than `n_episodes` episodes diverged.
    """
    n_episodes = checked_whole("n_episodes", n_episodes, 1)
    n_envs = venv.num_envs
    wanted = np.array([(n_episodes + i) // n_envs for i in range(n_envs)])
    finished = np.zeros(n_envs, dtype=int)
    returns_so_far, reached_so_far = np.zeros(n_envs), np.zeros(n_envs, dtype=bool)
    success, reached, returns = [], [], []
    env_steps = n_diverged = 0

    obs = venv.reset()
    while (finished < wanted).any():
        actions = policy(obs)  # type: ignore[arg-type]
        check_shape(actions, (n_envs, *venv.action_space.shape), "the policy's actions")  # type: ignore[misc]
        new_obs, rewards, dones, infos = venv.step(actions)
        env_steps += n_envs
        returns_so_far += one_each(rewards, n_envs, "the environment's step")
        reached_so_far |= [_is_on_goal(info) for info in infos]
        if on_step is not None:
            next_obs = with_terminal_observations(new_obs, dones, infos)  # type: ignore[arg-type]
            on_step(obs, actions, rewards, dones, infos, next_obs)  # type: ignore[arg-type]
        for i in np.flatnonzero(dones):
            if "diverged" in infos[i]:
                n_diverged += 1
                if n_diverged > n_episodes:
                    raise RuntimeError(
                        f"the physics diverged in {n_diverged} episodes of {n_episodes} wanted "
                        f"(the last: {infos[i]['diverged']})"
                    )
            elif finished[i] < wanted[i]:
                if "is_success" not in infos[i]:
                    raise ValueError(
                        "the environment's info has no 'is_success' at the end of an episode; "
                        "success rates need an environment that reports it"
                    )
                success.append(bool(one_number(infos[i]["is_success"], "is_success in the info")))
                reached.append(reached_so_far[i])
                returns.append(returns_so_far[i])
                finished[i] += 1
            returns_so_far[i], reached_so_far[i] = 0.0, False
        obs = new_obs

    return Episodes(np.array(success), np.array(reached), np.array(returns), env_steps)


def _is_on_goal(info: dict[str, Any]) -> bool:
    """Whether a step says that its goal is reached; only an episode's last one has to say."""
    said = info.get("is_success", False)
    return isinstance(said, bool | int | float | np.generic) and said == 1


def noise_free(model: BaseAlgorithm, learning: bool = False) -> Policy:
    """Return the model's deterministic policy on observations as the environments give them.

    Args:
        model: any algorithm of SB3 whose policy needs to remember nothing.
        learning: of a HerDDPG that averages its actor, the actor that learns instead.

    Raises:
        ValueError: by the policy returned, if the model's is recurrent.
    """
    player = model.actor if learning and isinstance(model, HerDDPG) else model
    normaliser = model.get_vec_normalize_env()

    def policy(obs: Observation) -> np.ndarray:
        seen = obs if normaliser is None else normaliser.normalize_obs(obs)
        actions, memory = player.predict(seen, deterministic=True)
        if memory is not None:
            raise ValueError(
                f"the policy of this {type(model).__name__} is recurrent, and here each step would "
                "begin with an empty memory; play it by SB3's evaluate_policy"
            )
        return actions

    return policy
