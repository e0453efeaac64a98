"""Callback that evaluates on original goals and keeps the curve."""

from __future__ import annotations

import csv
import io
import os
import time
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecNormalize, is_vecenv_wrapped

from ..common.files import atomic_write
from ..common.numbers import checked_number, checked_whole
from ..common.seeds import stream_seed
from ..imagination.vec_env import curriculum_of
from .copyable import CopyableCallback
from .curriculum_callback import CurriculumCallback
from .rollout import check_hears_rollouts, noise_free, run_episodes

_RECORDED = "eval/success_rate"


class OriginalGoalEvalCallback(CopyableCallback):
    """Evaluate the policy without noise on fresh episodes with original goals.

    Runs at the first end of a rollout after each ``every_steps`` environment steps. Records
    eval/success_rate, eval/mean_return and eval/env_steps, and appends a row to a CSV file. What
    is recorded is written to the logger's outputs before the next rollout at the latest.

    Args:
        eval_env: vectorised environment that shows the original goals, so without
            ImaginedGoalWrapper, and not in VecNormalize: a model that was trained in one normalises
            what it sees here too.
        n_episodes: episodes of an evaluation, >= 1.
        every_steps: the model's num_timesteps, tests included, between evaluations, >= 1.
        csv_path: file for the rows; None writes none. A file that holds rows from after the
            loaded state loses those, so that a resumed run repeats none.
        curriculum_callback: its tests are counted in env_steps and its k_max is noted.
        object_steps: steps that the object policy took, counted in env_steps, >= 0.
        wall_before: seconds that the object stage took, counted in wall_s.
        seed: of the evaluations' episodes, so that a resumed run is tested on the same; None
            leaves the environment's own generators running.
        verbose: 1 or more prints a line an evaluation.

    Attributes:
        success_rate: of the last evaluation, None before the first.
        n_evaluations: evaluations so far.

    Raises:
        ValueError: an argument is outside its range, eval_env is in VecNormalize or imagines goals,
            or the CSV file belongs to another run.
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
        if not isinstance(eval_env, VecEnv):
            raise ValueError(
                f"eval_env is a {type(eval_env).__name__}; give a VecEnv, such as make_vec makes"
            )
        if is_vecenv_wrapped(eval_env, VecNormalize):
            raise ValueError(
                "eval_env is in VecNormalize; the model's own normalises already: leave it out."
            )
        if curriculum_of(eval_env) is not None:
            raise ValueError(
                "eval_env imagines goals; an evaluation shows the original ones: make one without "
                "ImaginedGoalVecEnv and ImaginedGoalWrapper."
            )
        self.eval_env = eval_env
        self.n_episodes = checked_whole("n_episodes", n_episodes, 1)
        self.every_steps = checked_whole("every_steps", every_steps, 1)
        self.csv_path = None if csv_path is None else Path(csv_path)
        self.curriculum_callback = curriculum_callback
        self.object_steps = checked_whole("object_steps", object_steps, 0)
        self.success_rate: float | None = None
        self._rows: list[dict[str, Any]] = []
        self._last_steps = 0
        self.n_evaluations = 0
        self.seed = None if seed is None else checked_whole("seed", seed, 0)
        self._resumed = False
        self._wall_before = checked_number("wall_before", wall_before)
        self._started: float | None = None  # while it trains

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
        self._started = None

    def __getstate__(self) -> dict[str, Any]:
        if self.csv_path is not None:
            raise ValueError(
                f"an evaluation that writes {self.csv_path} cannot be copied, as two would write "
                "one file: make another with a csv_path of its own"
            )
        return {**super().__getstate__(), "_wall_before": self.wall_s}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._started = None  # another process may count from another moment

    @property
    def wall_s(self) -> float:
        """Seconds of training so far, those before an interruption included."""
        return self._wall_before + (
            0.0 if self._started is None else time.monotonic() - self._started
        )

    def _on_training_end(self) -> None:
        self._dump()
        self._wall_before, self._started = self.wall_s, None
        self._resumed = False  # what `learn` begins next may count anew

    def _on_training_start(self) -> None:
        check_hears_rollouts(self)
        self._wall_before, self._started = self.wall_s, time.monotonic()
        if not self._resumed and self.model.num_timesteps < self._last_steps:
            self._last_steps = 0  # of another model, or SB3 counts its steps anew
        if self.csv_path is not None:
            self._rows = self._earlier_rows(self.csv_path)
            self._write_csv(self.csv_path)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._dump()

    def _dump(self) -> None:
        """Write what an evaluation recorded, unless another has since, as a run's folder does."""
        if self._started is not None and _RECORDED in self.logger.name_to_value:
            self.logger.record("time/total_timesteps", self._last_steps, exclude="tensorboard")
            self.logger.dump(self._last_steps)

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
        if self.verbose >= 1:
            print(
                f"evaluation after {num_timesteps} steps: success rate {self.success_rate:.2f}, "
                f"mean return {mean_return:.2f}"
            )
        self.logger.record(_RECORDED, self.success_rate)
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
        with open(path, newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
        if tuple(reader.fieldnames or ()) != self.COLUMNS:
            raise ValueError(f"{path} exists and is not a file of evaluations.")
        if rows and self._rows and not self._last_steps:
            raise ValueError(
                f"{path} holds this callback's earlier evaluations, and `learn` counts anew: pass "
                "reset_num_timesteps=False, or make another callback with another file."
            )
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
