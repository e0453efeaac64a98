"""Stage one: the object learns to move by itself (section 4.1 of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from ..callbacks.copyable import CopyableCallback
from ..callbacks.rollout import run_episodes
from ..common.resuming import env_state, global_generators, set_env_state, set_global_generators
from ..ddpg.her_ddpg import HerDDPG
from ..envs.object_locomotion import ObjectSimulation
from ..settings.stages import StageSettings


@dataclass(frozen=True)
class ObjectPaths:
    """Noise-free paths of the object policy.

    Attributes:
        positions: (n, T + 1, 3) o_1 .. o_{T+1} in metres.
        goals: (n, 3) the goal of each path in metres.
        contexts: (n, c) what else the object saw as each path began.
        success_rate: share of the paths that end on their goal.
        env_steps: steps simulated for them.
    """

    positions: np.ndarray
    goals: np.ndarray
    contexts: np.ndarray
    success_rate: float
    env_steps: int


@dataclass(frozen=True)
class ObjectProgress:
    """What of the object's stage lies before, or decides about, the training that runs.

    Attributes:
        trial: number of the surface choice that is tried, from 0.
        spent: env steps of earlier trials.
        paths: env steps of paths that showed its ways to be too rough.
        until: env steps up to which it then learns on; None, it does not.
    """

    trial: int = 0
    spent: int = 0
    paths: int = 0
    until: int | None = None

    @property
    def earlier_steps(self) -> int:
        """Env steps besides those of the training that runs."""
        return self.spent + self.paths


class StopWhenSolved(CopyableCallback):
    """Tests the policy without noise now and then and stops once it succeeds often enough.

    Args:
        test_env: fresh copies of the training environment.
        n_episodes: episodes a test.
        every_episodes: rollouts between two tests, of an episode of each copy unless
            `train_freq` says otherwise.
        success_rate: in [0, 1]; two tests in a row must reach it, so that luck does not stop early.
        report: called with (env_steps, success rate) after each test.
        progress: of the stage so far; is kept with the training's state.
    """

    def __init__(
        self,
        test_env: VecEnv,
        n_episodes: int = StageSettings.object_test_episodes,
        every_episodes: int = StageSettings.object_test_every,
        success_rate: float = StageSettings.object_success,
        report: Callable[[int, float], None] | None = None,
        progress: ObjectProgress | None = None,
    ):
        super().__init__()
        self.test_env = test_env
        self.n_episodes = n_episodes
        self.every_episodes = every_episodes
        self.success_rate = success_rate
        self.report = report
        self.rates: list[float] = []
        self.test_steps = 0
        self.stopped = False
        self._rollouts = 0
        self.progress = progress or ObjectProgress()

    def _on_rollout_end(self) -> None:
        self._rollouts += 1
        if self._rollouts % self.every_episodes:
            return
        episodes = run_episodes(
            lambda obs: self.model.predict(obs, deterministic=True)[0],
            self.test_env,
            self.n_episodes,
        )
        self.test_steps += episodes.env_steps
        self.model.num_timesteps += episodes.env_steps
        self.rates.append(episodes.success_rate)
        self.logger.record("object/success_rate", episodes.success_rate)
        self.logger.dump(self.model.num_timesteps)
        if self.report is not None:
            self.report(self.model.num_timesteps, episodes.success_rate)

    @property
    def solved(self) -> bool:
        """Whether the last two tests reached the success rate."""
        return len(self.rates) >= 2 and min(self.rates[-2:]) >= self.success_rate

    @property
    def learns_on(self) -> bool:
        """Whether it was told to go on once though the task was solved."""
        return self.progress.until is not None

    def learn_on(self, until: int) -> None:
        """Go on for so many env steps in all, and to the next two tests that reach the rate."""
        self.progress = replace(self.progress, until=until)
        self.stopped = False

    def _on_step(self) -> bool:
        self.stopped = self.solved and self.model.num_timesteps >= (self.progress.until or 0)
        return not self.stopped

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the rest of the training depends on, between rollouts."""
        model = self.model
        assert isinstance(model, HerDDPG) and model.replay_buffer is not None
        return {
            "model": model.training_state(),
            "replay_buffer": model.replay_buffer.state_dict(),
            "env": env_state(self.training_env),
            "test_env": env_state(self.test_env),
            "generators": global_generators(),
            "rates": self.rates,
            "test_steps": self.test_steps,
            "stopped": self.stopped,
            "rollouts": self._rollouts,
            "notes": {name: note for name, note in asdict(self.progress).items() if note},
        }

    def load_state_dict(self, state: dict[str, Any], model: HerDDPG, env: VecEnv) -> None:
        """Continue from `state_dict` with an algorithm and an environment like those it had."""
        assert model.replay_buffer is not None
        model.load_training_state(state["model"])
        model.replay_buffer.load_state_dict(state["replay_buffer"])
        set_env_state(env, state["env"])
        set_env_state(self.test_env, state["test_env"])
        set_global_generators(state["generators"])
        self.rates = list(state["rates"])
        self.test_steps, self.stopped = state["test_steps"], state["stopped"]
        self._rollouts = state["rollouts"]
        self.progress = ObjectProgress(**state.get("notes", {}))


def train_object_policy(
    env: VecEnv,
    test_env: VecEnv,
    total_timesteps: int = StageSettings.object_timesteps,
    *,
    give_up_after: int | None = None,
    n_test_episodes: int = StageSettings.object_test_episodes,
    test_every: int = StageSettings.object_test_every,
    success_rate: float = StageSettings.object_success,
    seed: int | None = None,
    report: Callable[[int, float], None] | None = None,
    callback: Callable[[StopWhenSolved], BaseCallback] | None = None,
    progress: ObjectProgress | None = None,
    state: dict[str, Any] | None = None,
    too_rough: Callable[[HerDDPG, StopWhenSolved], bool] | None = None,
    **algorithm_kwargs: Any,
) -> tuple[HerDDPG, StopWhenSolved]:
    """Learn the object policy nu by DDPG + HER and stop as soon as it solves the task.

    Args:
        env: vectorised object-only environment, e.g. of FollowObject/PnPShelfObject-v0.
        test_env: fresh copies of it.
        total_timesteps: env steps after which training ends unsolved; tests are counted.
        give_up_after: the same for a task that has never been solved until then, if sooner.
        n_test_episodes: episodes a test, >= 1.
        test_every: training episodes of each copy between two tests, >= 1.
        success_rate: noise-free success that counts as solved, in two tests in a row.
        seed: of networks, noise and replay.
        report: called with (env_steps, success rate) after each test.
        callback: makes another callback from the one that tests.
        progress: of the stage before this training.
        state: of `StopWhenSolved.state_dict`, progress among it; it goes on exactly from there.
        too_rough: asked once, when the task is solved, whether to learn for as many steps again.
        algorithm_kwargs: of HerDDPG.

    Returns:
        The algorithm and the callback that knows the test results.
    """
    solved = StopWhenSolved(test_env, n_test_episodes, test_every, success_rate, report, progress)
    model = HerDDPG("MultiInputPolicy", env, seed=seed, **algorithm_kwargs)
    if state is not None:
        solved.load_state_dict(state, model, env)
    callbacks = CallbackList([solved, *([callback(solved)] if callback else [])])

    def learn(begins: bool) -> None:
        limits = [total_timesteps]
        if give_up_after is not None and not solved.learns_on:
            limits.append(give_up_after)
        model.learn(
            min(limits) - model.num_timesteps,
            callback=callbacks,
            log_interval=None,  # type: ignore[arg-type]
            reset_num_timesteps=begins,
        )

    if not solved.stopped:
        learn(begins=state is None)
    if (
        solved.solved
        and not solved.learns_on
        and too_rough is not None
        and too_rough(model, solved)
    ):
        solved.learn_on(2 * model.num_timesteps)
        learn(begins=False)
    return model, solved


def collect_paths(model: Any, env: VecEnv, n_episodes: int) -> ObjectPaths:
    """Roll the object policy out without noise (section 4.2 of the paper).

    Args:
        model: anything with SB3's `predict`.
        env: vectorised object-only environment whose episodes all have the same length.
        n_episodes: a multiple of `env.num_envs` wastes no steps.
    """
    current: list[np.ndarray] = []
    paths: list[np.ndarray] = []
    goals: list[np.ndarray] = []
    contexts: list[np.ndarray] = []
    begun: list[np.ndarray] = []  # contexts of running episodes

    def keep(obs: Any, actions: Any, rewards: Any, dones: Any, infos: Any, next_obs: Any) -> None:
        if not current:
            current.append(obs["achieved_goal"].copy())
            begun.append(obs["observation"][:, ObjectSimulation.observation_size :].copy())
        current.append(next_obs["achieved_goal"].copy())
        if dones.all():
            good = ["diverged" not in info for info in infos]
            paths.append(np.stack(current, axis=1)[good])
            goals.append(obs["desired_goal"][good])
            contexts.append(begun.pop()[good])
            current.clear()
        elif dones.any():
            raise ValueError("the object's episodes differ in length; F_phi needs a fixed horizon")

    episodes = run_episodes(
        lambda obs: model.predict(obs, deterministic=True)[0],
        env,
        -(-n_episodes // env.num_envs) * env.num_envs,
        keep,
    )
    return ObjectPaths(
        np.concatenate(paths),
        np.concatenate(goals),
        np.concatenate(contexts),
        episodes.success_rate,
        episodes.env_steps,
    )
