"""Episodes that a resumed training sees again, in environments that cannot tell their state."""

from __future__ import annotations

from collections.abc import Callable

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from ..replay.following import end_running_episodes, episodes_are_whole


class FreshEpisodes(BaseCallback):
    """Start each rollout with episodes of a seed of its own.

    For environments that cannot tell their state: what they do in a rollout then depends on the
    steps taken so far and on nothing else, so that a resumed training sees the same episodes.
    Rollouts that begin in the middle of an episode are left alone.

    Args:
        seed: gives the seed for a number of steps; tests have the seeds of numbers below 0.
        test_env: that the training's tests run in, if there is one.
    """

    def __init__(self, seed: Callable[[int], int], test_env: VecEnv | None = None):
        super().__init__()
        self.seed = seed
        self.test_env = test_env

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        assert isinstance(self.model, OffPolicyAlgorithm)
        if self.test_env is not None:
            self.test_env.seed(self.seed(-1 - self.model.num_timesteps))
        if episodes_are_whole(self.model.replay_buffer):
            self.training_env.seed(self.seed(self.model.num_timesteps))
            self.model._last_obs = self.training_env.reset()  # type: ignore[assignment]


def begin_new_episodes(model: OffPolicyAlgorithm) -> None:
    """Drop the episodes that were running; `learn` then resets the environment."""
    model._last_obs = None
    end_running_episodes(model.replay_buffer)
