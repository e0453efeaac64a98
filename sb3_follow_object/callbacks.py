"""Callbacks that test h_max and advance k_max, and that evaluate on original goals."""

from __future__ import annotations

import csv
import io
import os
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from .curriculum import Curriculum
from .envs import IDS, make_vec
from .files import atomic_write
from .her_ddpg import HerDDPG
from .rollout import Observation, OnStep, Policy, run_episodes
from .seeds import stream_seed
from .wrappers import ImaginedGoalVecEnv, imagination_of


class CurriculumCallback(BaseCallback):
    """Test the policy on h_max without noise and advance k_max (paper, Algorithm 1).

    A test is due after every ``every`` cycles. A cycle is a rollout that has finished at least one
    episode; rollouts of a few steps add up to one. Nothing is tested once the curriculum is
    finished. Records curriculum/k_max, curriculum/test_success and curriculum/test_steps.

    The model carries the curriculum's state as ``model.curriculum_state``, which SB3 saves with it:
    training that goes on from a loaded model, without a test_env, goes on at its k_max.

    Args:
        test_env: ImaginedGoalVecEnv with mode="test", sharing the training's curriculum; None
            makes as many copies of the training's environment when training starts.
        n_episodes: episodes of a test, >= 1.
        every: cycles between tests, >= 1.
        store: whether to put the tests' transitions into the model's replay buffer. It is done
            where that keeps the buffer's episodes whole: with as many copies as the training has,
            and when no training episode is half-way.

    Attributes:
        test_steps: environment steps spent in tests so far, all copies counted; they are part of
            the model's num_timesteps.

    Raises:
        ValueError: an argument is outside its range, test_env does not show h_max, or training
            starts without one in an environment that imagines no goals or cannot be copied.
    """

    def __init__(
        self,
        test_env: ImaginedGoalVecEnv | None = None,
        n_episodes: int = 16,
        every: int = 1,
        store: bool = True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        is_test = isinstance(test_env, ImaginedGoalVecEnv) and test_env.mode == "test"
        if test_env is not None and not is_test:
            raise ValueError("test_env must be an ImaginedGoalVecEnv with mode='test'.")
        _check_positive(n_episodes=n_episodes, every=every)
        self._test_env = test_env
        self.n_episodes = n_episodes
        self.every = every
        self.store = store
        self.test_steps = 0
        self._cycles = 0
        self._episode_ended = False

    @property
    def test_env(self) -> ImaginedGoalVecEnv:
        """The environment that tests run in; one of the callback's own exists once training has."""
        if self._test_env is None:
            raise RuntimeError("the test environment is made when training starts")
        return self._test_env

    @property
    def curriculum(self) -> Curriculum:
        """The curriculum that the tests advance."""
        return self.test_env.curriculum

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training needs (JSON types); the curriculum has its own state."""
        return {
            "test_steps": self.test_steps,
            "cycles": self._cycles,
            "episode_ended": self._episode_ended,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self.test_steps = int(state["test_steps"])
        self._cycles = int(state["cycles"])
        self._episode_ended = bool(state["episode_ended"])

    def _on_training_start(self) -> None:
        if self._test_env is None:
            self._test_env = _test_copies(self.training_env)
            if hasattr(self.model, "curriculum_state"):
                self.curriculum.load_state_dict(self.model.curriculum_state)
        self._share_curriculum()

    def _on_step(self) -> bool:
        self._episode_ended |= bool(np.any(self.locals["dones"]))
        return True

    def _on_rollout_end(self) -> None:
        self._cycles += self._episode_ended
        self._episode_ended = False
        if self._cycles >= self.every and not self.curriculum.finished:
            self._cycles = 0
            self._test()
        self.logger.record("curriculum/k_max", self.curriculum.k_max)
        self.logger.record("curriculum/test_steps", self.test_steps)

    def _test(self) -> None:
        buffer = self._open_buffer()
        episodes = run_episodes(
            noise_free(self.model, learning=True),
            self.test_env,
            self.n_episodes,
            on_step=None if buffer is None else self._storing(buffer),
        )
        if isinstance(buffer, HerReplayBuffer):
            _close_episodes(buffer)
        self.test_steps += episodes.env_steps
        self.model.num_timesteps += episodes.env_steps  # tests cost steps like any others
        self.logger.record("curriculum/test_success", episodes.success_rate)
        if self.curriculum.report(episodes.success_rate):
            self._share_curriculum()
            if self.verbose:
                print(
                    f"k_max {self.curriculum.k_max} of {self.curriculum.n_levels} "
                    f"after {self.num_timesteps} steps"
                )

    def _share_curriculum(self) -> None:
        """Tell the model and the copies of the curriculum inside the training's environments."""
        state = self.curriculum.state_dict()
        self.model.curriculum_state = state  # type: ignore[attr-defined]
        if self.training_env.has_attr("load_curriculum"):
            self.training_env.env_method("load_curriculum", state)

    def _open_buffer(self) -> Any:
        """Return the replay buffer if test episodes can go into it now, else None."""
        buffer = getattr(self.model, "replay_buffer", None)
        if not self.store or buffer is None or self.test_env.num_envs != buffer.n_envs:
            return None
        if isinstance(buffer, HerReplayBuffer) and (buffer._current_ep_start != buffer.pos).any():
            return None
        return buffer

    def _storing(self, buffer: Any) -> OnStep:
        continuous = isinstance(self.model.action_space, spaces.Box)

        def store(
            obs: Observation,
            actions: np.ndarray,
            rewards: np.ndarray,
            dones: np.ndarray,
            infos: list[dict[str, Any]],
            next_obs: Observation,
        ) -> None:
            # Buffers of SB3 hold actions scaled to [-1, 1].
            stored = self.model.policy.scale_action(actions) if continuous else actions
            buffer.add(obs, next_obs, stored, rewards, dones, infos)

        return store


class OriginalGoalEvalCallback(BaseCallback):
    """Evaluate the policy without noise on fresh episodes with original goals.

    Runs at the first end of a rollout after each ``every_steps`` environment steps. Records
    eval/success_rate, eval/mean_return and eval/env_steps, and appends a row to a CSV file.

    Args:
        eval_env: vectorised environment that shows the original goals.
        n_episodes: episodes of an evaluation, >= 1.
        every_steps: the model's num_timesteps, tests included, between evaluations, >= 1.
        csv_path: file for the rows; None writes none. A file that holds rows from after the
            loaded state loses those, so that a resumed run repeats none.
        curriculum_callback: its tests are counted in env_steps and its k_max is noted.
        object_steps: steps that the object policy took, counted in env_steps, >= 0.
        wall_before: seconds that the object stage took, counted in wall_s.
        seed: of the evaluations' episodes, so that a resumed run is tested on the same; None
            leaves the environment's own generators running.

    Attributes:
        success_rate: of the last evaluation, None before the first.
        n_evaluations: evaluations so far.

    Raises:
        ValueError: an argument is outside its range, or the CSV file belongs to another run.
    """

    COLUMNS = (
        "env_steps",
        "train_steps",
        "test_steps",
        "object_steps",
        "wall_s",
        "success_rate",
        "mean_return",
        "episodes",
        "k_max",
    )

    def __init__(
        self,
        eval_env: VecEnv,
        n_episodes: int,
        every_steps: int,
        csv_path: str | os.PathLike[str] | None = None,
        curriculum_callback: CurriculumCallback | None = None,
        object_steps: int = 0,
        wall_before: float = 0.0,
        seed: int | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        _check_positive(n_episodes=n_episodes, every_steps=every_steps)
        if object_steps < 0:
            raise ValueError(f"object_steps must be >= 0, got {object_steps!r}.")
        self.eval_env = eval_env
        self.n_episodes = n_episodes
        self.every_steps = every_steps
        self.csv_path = None if csv_path is None else Path(csv_path)
        self.curriculum_callback = curriculum_callback
        self.object_steps = object_steps
        self.success_rate: float | None = None
        self._rows: list[dict[str, Any]] = []
        self._last_steps = 0
        self.n_evaluations = 0
        self.seed = seed
        self._resumed = False
        self._wall_before = wall_before
        self._started = time.monotonic()

    @property
    def env_steps(self) -> int:
        """Environment steps so far: training, tests of the curriculum, object policy."""
        return self.model.num_timesteps + self.object_steps

    @property
    def _test_steps(self) -> int:
        callback = self.curriculum_callback
        return 0 if callback is None else callback.test_steps

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training needs (JSON types)."""
        return {
            "last_steps": self._last_steps,
            "success_rate": self.success_rate,
            "n_evaluations": self.n_evaluations,
            "wall_s": self.wall_s,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self._last_steps = int(state["last_steps"])
        self.success_rate = state["success_rate"]
        self.n_evaluations = int(state["n_evaluations"])
        self._resumed = True
        self._wall_before = float(state["wall_s"])
        self._started = time.monotonic()

    @property
    def wall_s(self) -> float:
        """Seconds of training so far, those before an interruption included."""
        return self._wall_before + time.monotonic() - self._started

    def _on_training_start(self) -> None:
        if self.csv_path is not None:
            self._rows = self._earlier_rows(self.csv_path)
            self._write_csv(self.csv_path)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        num_timesteps = self.model.num_timesteps
        if num_timesteps - self._last_steps < self.every_steps:
            return
        self._last_steps = num_timesteps
        self.n_evaluations += 1
        if self.seed is not None:
            self.eval_env.seed(stream_seed(self.seed, f"evaluation {self.n_evaluations}"))
        episodes = run_episodes(noise_free(self.model), self.eval_env, self.n_episodes)
        self.success_rate = episodes.success_rate
        mean_return = float(episodes.returns.mean())
        self.logger.record("eval/success_rate", self.success_rate)
        self.logger.record("eval/mean_return", mean_return)
        self.logger.record("eval/env_steps", self.env_steps)
        if self.csv_path is None:
            return
        callback = self.curriculum_callback
        values = (
            self.env_steps,
            num_timesteps - self._test_steps,
            self._test_steps,
            self.object_steps,
            round(self.wall_s, 1),
            round(self.success_rate, 4),
            round(mean_return, 4),
            self.n_episodes,
            "" if callback is None else callback.curriculum.k_max,
        )
        self._rows.append(dict(zip(self.COLUMNS, values, strict=True)))
        self._write_csv(self.csv_path)

    def _earlier_rows(self, path: Path) -> list[dict[str, Any]]:
        """Return the file's rows up to the state that training starts from."""
        if not path.exists():
            return []
        with open(path, newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
        if tuple(reader.fieldnames or ()) != self.COLUMNS:
            raise ValueError(f"{path} exists and is not a file of evaluations.")
        if rows and not (self._resumed or self._last_steps):
            raise ValueError(
                f"{path} holds another run's evaluations: give another file, or load the state "
                "that they belong to."
            )

        def steps(row: dict[str, Any]) -> int:
            return int(row["train_steps"]) + int(row["test_steps"])

        return [row for row in rows if steps(row) <= self._last_steps]

    def _write_csv(self, path: Path) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, self.COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        atomic_write(path, text.getvalue().encode())


def noise_free(model: BaseAlgorithm, learning: bool = False) -> Policy:
    """Return the model's deterministic policy on observations as the environments give them.

    Args:
        model: any algorithm of SB3.
        learning: of a HerDDPG that averages its actor, the actor that learns instead.
    """
    player = model.actor if learning and isinstance(model, HerDDPG) else model
    normaliser = model.get_vec_normalize_env()

    def policy(obs: Observation) -> np.ndarray:
        seen = obs if normaliser is None else normaliser.normalize_obs(obs)
        return player.predict(seen, deterministic=True)[0]

    return policy


def _test_copies(training_env: VecEnv) -> ImaginedGoalVecEnv:
    """Make as many copies of the training's environment, which show h_max of its curriculum."""
    predictor, curriculum = imagination_of(training_env, "CurriculumCallback without a test_env")
    spec = training_env.get_attr("spec", indices=[0])[0]
    if spec is None:
        raise ValueError(
            "CurriculumCallback cannot copy an environment that gymnasium.make did not make; "
            "give it a test_env."
        )
    options = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    if spec.id in IDS:
        options.pop("task", None)  # the id says it
        options["reward_type"] = training_env.get_attr("reward_type", indices=[0])[0]
    venv = make_vec(spec.id, training_env.num_envs, **options)
    test_env = ImaginedGoalVecEnv(venv, predictor, curriculum, mode="test")
    if _shapes(test_env) != _shapes(training_env):
        raise ValueError(
            f"The training's observations {_shapes(training_env)} are not those of {spec.id}, "
            f"{_shapes(test_env)}: give CurriculumCallback a test_env with the same wrappers."
        )
    # NumPy's global stream is the one that SB3 seeds.
    test_env.seed(int(np.random.randint(2**31 - 1000)))
    return test_env


def _shapes(env: VecEnv) -> dict[str, tuple[int, ...] | None]:
    entries = getattr(env.observation_space, "spaces", {})
    return {key: space.shape for key, space in entries.items()}


def _close_episodes(buffer: HerReplayBuffer) -> None:
    """End test episodes that were still running, so that training starts its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of just what is wanted here
        buffer.truncate_last_trajectory()


def _check_positive(**values: int) -> None:
    for name, value in values.items():
        if value < 1:
            raise ValueError(f"{name} must be >= 1, got {value!r}.")
