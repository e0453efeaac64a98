"""What a run in a folder does between rollouts: checkpoints, the best policy, stopping."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from ..callbacks.eval_callback import OriginalGoalEvalCallback
from ..common.copies import NoCopies
from ..common.files import atomic_write
from ..common.signals import stop_signals_to
from ..follow_object.follow_object import FollowObject
from .checkpoints import Checkpoints
from .run_folder import BEST_POLICY, POLICY

Progress = Callable[[dict[str, Any]], None]


class StopSignals(NoCopies):
    """Notes SIGINT and SIGTERM, so that a training can end where nothing is lost.

    A second signal raises KeyboardInterrupt at once. Off the main thread, where Python delivers no
    signals, nothing is noted and nothing is changed.
    """

    no_copies = "StopSignals hold this process's signal handlers and cannot be copied: make others"

    def __init__(self) -> None:
        self.requested = False
        self._heeding = ExitStack()

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come."""
        if self.requested:
            raise KeyboardInterrupt

    def __enter__(self) -> StopSignals:
        self._heeding.enter_context(stop_signals_to(self._note))
        return self

    def __exit__(self, *raised: object) -> None:
        self._heeding.close()

    def _note(self) -> None:
        self.check()
        self.requested = True


class CheckpointCallback(BaseCallback):
    """Writes a checkpoint between rollouts when it is time or a signal has come, and at the end.

    Args:
        checkpoints: writes them.
        state: returns what resuming needs.
        env_steps: returns the run's steps so far.
        minutes: wall time between checkpoints.
        stop: what a signal asks for.
    """

    def __init__(
        self,
        checkpoints: Checkpoints,
        state: Callable[[], dict[str, Any]],
        env_steps: Callable[[], int],
        minutes: float,
        stop: StopSignals,
    ):
        super().__init__()
        self.checkpoints = checkpoints
        self.state = state
        self.env_steps = env_steps
        self.minutes = minutes
        self.stop = stop
        self._last = time.monotonic()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.checkpoints.poll()
        if self.stop.requested or time.monotonic() - self._last > 60.0 * self.minutes:
            self.write()
        self.stop.check()

    def _on_training_end(self) -> None:
        self.write()

    def write(self) -> None:
        """Write a checkpoint, between two rollouts."""
        self.checkpoints.write(self.env_steps(), self.state())
        self._last = time.monotonic()


class Solved(Exception):
    """A robot's stage can end, between two rollouts: the task is solved and stays so."""


class RunCallback(BaseCallback):
    """Saves the policy at each validation, and the best one apart, and reports progress.

    Raises `Solved` once enough validations in a row have gone well enough.

    Args:
        run: what is trained.
        evaluation: its validation callback, which runs before this one.
        folder: of the run.
        progress: called with the current figures after each rollout.
        solved_at: success rate that is enough; 0, none is.
        solved_validations: how many must be in a row.
    """

    def __init__(
        self,
        run: FollowObject,
        evaluation: OriginalGoalEvalCallback,
        folder: Path,
        progress: Progress,
        solved_at: float,
        solved_validations: int,
    ):
        super().__init__()
        self.run = run
        self.evaluation = evaluation
        self.folder = folder
        self.progress = progress
        self.solved_at = solved_at
        self.solved_validations = solved_validations
        self.best = -1.0
        self._best_policy = b""  # its file, empty before the first validation
        self._n_solved = 0  # validations in a row
        self._n_validated = 0

    @property
    def solved(self) -> bool:
        """Whether enough validations in a row have gone well enough."""
        return self.solved_at > 0 and self._n_solved >= self.solved_validations

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        assert self.run.model is not None
        if not all(bool(th.isfinite(w).all()) for w in self.run.model.actor.parameters()):
            raise RuntimeError("diverged: the policy is not finite")
        n_validated = self.evaluation.n_evaluations
        if n_validated > self._n_validated:
            self._n_validated = n_validated
            rate = self.evaluation.success_rate
            assert rate is not None
            self._n_solved = self._n_solved + 1 if rate >= self.solved_at else 0
            self.run.save_policy(self.folder / POLICY)
            if rate >= self.best:
                self.best = rate
                self.run.save_policy(self.folder / BEST_POLICY)
                self._best_policy = (self.folder / BEST_POLICY).read_bytes()
            self.logger.dump(self.run.env_steps)
        self.progress(
            {
                "env_steps": self.run.env_steps,
                "k_max": self.run.curriculum.k_max if self.run.imagine else None,
                "success_rate": self.evaluation.success_rate,
            }
        )
        if self.solved:
            raise Solved

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming the third stage needs."""
        return {
            "stage": "robot",
            "run": self.run.state_dict(),
            "evaluation": self.evaluation.state_dict(),
            "best": self.best,
            "n_validated": self._n_validated,
            "n_solved": self._n_solved,
            "best_policy": np.frombuffer(self._best_policy, dtype=np.uint8),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`, the best policy's file included."""
        self.run.load_state_dict(state["run"])
        self.evaluation.load_state_dict(state["evaluation"])
        self.best = state["best"]
        self._n_validated = state["n_validated"]
        self._n_solved = int(state.get("n_solved", 0))
        path = self.folder / BEST_POLICY
        if "best_policy" not in state:  # a checkpoint of before: the file stays as it is
            self._best_policy = path.read_bytes() if path.exists() else b""
            return
        self._best_policy = state["best_policy"].tobytes()
        if self._best_policy:
            atomic_write(path, self._best_policy)
        else:
            path.unlink(missing_ok=True)
