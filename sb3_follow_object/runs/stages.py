"""The stages of a run in a folder, each begun anew or from a checkpoint."""

from __future__ import annotations

import gc
import json
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.vec_env import VecEnv

from ..callbacks.eval_callback import OriginalGoalEvalCallback
from ..common.files import atomic_write
from ..common.reports import Report, Trouble, reason
from ..common.seeds import stream_seed
from ..ddpg.her_ddpg import HerDDPG
from ..follow_object.follow_object import FollowObject
from ..object_stage.policy import StopWhenSolved
from ..settings.run_config import RunConfig
from .checkpoints import Checkpoints, load_newest
from .evaluation import evaluate, evaluation_env
from .object_stage_files import load_object_stage, save_object_stage
from .run_callbacks import CheckpointCallback, Progress, RunCallback, Solved, StopSignals
from .run_folder import (
    CROSS_TESTS,
    EVALUATIONS,
    POLICY,
    RESULT,
    drop_later_rows,
    noted_command,
    task_label,
)
from .tensorboard_page import describe_curves


class RunStages:
    """What a run does in its folder, in this order.

    Args:
        config: of the run.
        folder: that holds it.
        run: what is trained.
        checkpoints: of the folder.
        stop: what a signal asks for.

    Attributes:
        solved: whether the robot's stage ended early, because validations said so.
    """

    def __init__(
        self,
        config: RunConfig,
        folder: Path,
        run: FollowObject,
        checkpoints: Checkpoints,
        stop: StopSignals,
    ):
        self.config = config
        self.folder = folder
        self.run = run
        self.checkpoints = checkpoints
        self.stop = stop
        self.solved = False
        self._checkpoint: Any = None

    def load_newest_checkpoint(self) -> None:
        """Let the stage that was interrupted go on from the last checkpoint, if there is one."""
        self._checkpoint = load_newest(self.folder, self.run.report)

    def _take_checkpoint(self) -> Any:
        """Return it and keep it no longer: it holds a replay buffer's worth of memory."""
        checkpoint, self._checkpoint = self._checkpoint, None
        return checkpoint

    def load_object_stage(self) -> float | None:
        """Load what the folder has of the object's stage; return its seconds, None before its end.

        Raises:
            ValueError: a file of it is missing, damaged or for another task.
        """
        return load_object_stage(self.folder, self.run, self._checkpoint)

    def learn_object_stage(self, shared: bool) -> float:
        """Run what is left of the stages before the robot's; return the seconds that they took.

        One that runs share makes what any of them may need.
        """
        saved = self._take_checkpoint()
        wall_before = 0.0 if saved is None else saved["wall_s"]
        started = time.monotonic()

        def wall_s() -> float:
            return wall_before + time.monotonic() - started

        def writer(solved: StopWhenSolved) -> CheckpointCallback:
            return CheckpointCallback(
                self.checkpoints,
                lambda: {"stage": "object", "object": solved.state_dict(), "wall_s": wall_s()},
                lambda: solved.model.num_timesteps,
                self.config.checkpoint_minutes,
                self.stop,
            )

        stage = self.run.object_stage
        learn = stage.learn_predictor if self.run.imagine else stage.learn_policy
        state = None if saved is None else saved["object"]
        learn(writer, state, between_epochs=self.stop.check, networks=shared)
        save_object_stage(self.folder, self.run, wall_s())
        if shared:
            self.checkpoints.remove()
        return wall_s()

    def learn_robot_stage(self, wall_before: float, progress: Progress) -> float:
        """Run what is left of the robot's stage; return the seconds that all stages took."""
        model = self._prepare_robot()
        n_threads = self.run.settings["n_threads"]
        with closing(evaluation_env(self.config.env_id, n_threads=n_threads)) as copies:
            evaluation = self._train(model, copies, wall_before, progress)
        return evaluation.wall_s

    def _train(
        self, model: HerDDPG, copies: VecEnv, wall_before: float, progress: Progress
    ) -> OriginalGoalEvalCallback:
        """Train the robot, validated in these copies of its task; return what validated it."""
        saved = self._take_checkpoint()
        if saved is not None and saved["stage"] != "robot":
            saved = None
        if saved is None:  # what was evaluated after the last checkpoint begins anew
            (self.folder / EVALUATIONS).unlink(missing_ok=True)

        evaluation = self._validation(copies, wall_before)
        keeper = RunCallback(
            self.run,
            evaluation,
            self.folder,
            progress,
            self.config.solved_at,
            self.config.solved_validations,
        )
        if saved is not None:
            keeper.load_state_dict(saved)
            drop_later_rows(self.folder, self.run.env_steps)
            self.checkpoints.take_memory(keeper.state_dict())
            self.run.report(f"resumed at {self.run.env_steps} env steps")
        del saved
        # Those of the policy that is trained further from here on.
        (self.folder / RESULT).unlink(missing_ok=True)
        (self.folder / CROSS_TESTS).unlink(missing_ok=True)
        if model.num_timesteps == 0 and self.run.env_steps >= self.config.total_timesteps:
            self.run.report(
                Trouble(
                    f"{self.run.env_steps} env steps are gone of {self.config.total_timesteps}: "
                    "nothing is left for the robot to learn in"
                )
            )
        model.set_logger(_logger(self.folder, self.run.env_steps, self.run.report))
        writer = CheckpointCallback(
            self.checkpoints,
            keeper.state_dict,
            lambda: self.run.env_steps,
            self.config.checkpoint_minutes,
            self.stop,
        )
        total = self.config.total_timesteps
        if not keeper.solved:  # as one is that was stopped in its final test
            try:
                self.run.learn(total, callback=CallbackList([evaluation, keeper, writer]))
            except Solved:
                writer.write()
        self.solved = keeper.solved
        if self.solved:
            self.run.report(
                f"solved after {self.run.env_steps} env steps of {total}: "
                f"{keeper.solved_validations} validations in a row of {keeper.solved_at:g} or more"
            )
        return evaluation

    def _prepare_robot(self) -> HerDDPG:
        """Return the robot's algorithm, on the threads and the device that the run is given."""
        self.run.report(f"the robot of {self.config.env_id} learns")
        model = self.run.prepare()
        model.update_threads = self.config.torch_threads
        asked = (self.config.settings.get("algorithm") or {}).get("device") or "auto"
        if asked != "auto" and th.device(asked).type != model.device.type:
            sentence = f"there is no device {asked!r} here: the robot learns on the CPU"
            self.run.report(Trouble(sentence))
        return model

    def _validation(self, copies: VecEnv, wall_before: float) -> OriginalGoalEvalCallback:
        """Return what tests the robot while it learns, and keeps the curve."""
        return OriginalGoalEvalCallback(
            copies,
            self.config.n_eval_episodes,
            self.config.eval_every,
            csv_path=self.folder / EVALUATIONS,
            curriculum_callback=self.run.curriculum_callback,
            object_steps=self.run.object_steps,
            wall_before=wall_before,
            seed=stream_seed(self.config.seed, "validation"),
        )

    def final_test(self, wall_s: float, command: str) -> dict[str, Any]:
        """Test the last policy on fresh episodes; write the run's result and return it."""
        self.run.save_policy(self.folder / POLICY)
        gc.collect()  # callbacks hold themselves, and with them the validation's copies
        self.run.report(f"final test: {self.config.n_final_episodes} episodes")
        episodes = evaluate(
            self.folder / POLICY,
            self.config.env_id,
            self.config.n_final_episodes,
            self.config.seed,
            self.stop.check,
            self.run.settings["n_threads"],
        )
        result = {
            "task": task_label(self.config.env_id),
            "method": self.config.method,
            "seed": self.config.seed,
            "env_steps": self.run.env_steps,
            "object_steps": self.run.object_steps,
            "test_steps": self.run.test_steps,
            "wall_s": round(wall_s, 1),
            "success_rate": episodes.success_rate,
            "episodes": self.config.n_final_episodes,
            "command": noted_command(self.folder, command),
            "k_max": self.run.curriculum.k_max if self.run.imagine else None,
            **({"solved": True} if self.solved else {}),  # before its steps were gone
        }
        (self.folder / CROSS_TESTS).unlink(missing_ok=True)  # of an earlier policy
        atomic_write(self.folder / RESULT, json.dumps(result, indent=2).encode())
        return result


def _logger(folder: Path, env_steps: int, report: Report) -> Logger:
    """CSV and TensorBoard; a resumed run begins another CSV rather than overwrite the first."""
    suffix = f"_{env_steps}"
    formats = [make_output_format("csv", str(folder), suffix)]
    try:
        import tensorboard  # noqa: F401

        formats.append(make_output_format("tensorboard", str(folder), suffix))
        describe_curves(formats[-1].writer)  # type: ignore[attr-defined]
    except ModuleNotFoundError:
        pass
    except Exception as error:  # it drags in much that may not fit together
        report(Trouble(f"left out the log for TensorBoard: {reason(error)}"))
    return Logger(str(folder), formats)
