"""A training run in a folder: started, interrupted, resumed."""

from __future__ import annotations

import copy
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ..common.files import lock, remove_half_written
from ..common.reports import Report, Trouble
from ..common.torch_helpers import threads_at
from ..follow_object.follow_object import FollowObject
from ..settings.run_config import RunConfig
from ..settings.sizes import check_sizes, idle_robot
from .checkpoints import Checkpoints, checkpoint_files
from .run_callbacks import Progress, StopSignals
from .run_folder import check_empty, check_same_run, claim, finished_result, take_steps
from .stages import RunStages


def train(
    config: RunConfig,
    folder: str | os.PathLike[str],
    *,
    resume: bool = False,
    report: Report = print,
    progress: Progress = lambda figures: None,
    command: str = "",
    object_stage_only: bool = False,
    wait: bool = False,
) -> dict[str, Any]:
    """Train in a folder and return its result, also written to result.json.

    Interrupting (Ctrl-C or SIGTERM) writes a checkpoint first; `resume=True` goes on from the last
    one and ends as the uninterrupted run would have, also with another `total_timesteps` than it
    began with.

    Args:
        config: what to train.
        folder: is created; must be empty or absent unless resuming.
        resume: whether to go on with what the folder holds.
        report: called with a sentence now and then.
        progress: called with env_steps, k_max and success_rate after each rollout.
        command: the command line to note in the result.
        object_stage_only: end where the robot's training would begin, and return nothing.
        wait: resume once another process that trains in the folder has ended.

    Raises:
        ValueError: the folder holds another run, none where one should be resumed, one that another
            process trains (without `wait`), or a finished one that kept no checkpoint for the steps
            asked for.
        RuntimeError: the training cannot go on; the last checkpoint is as it was.
        KeyboardInterrupt: after the checkpoint of an interrupted run.
    """
    folder = Path(folder).absolute()  # an environment or a callback may change the working folder
    with ExitStack() as stack:
        if resume:
            check_same_run(folder, config)
            result = finished_result(folder, config)
            if result is None:  # else nothing is written, also not a lock
                stack.enter_context(lock(folder, wait=wait))
                result = finished_result(folder, config)
            if result is not None:
                report(f"{folder} is finished already")
                return result
            take_steps(folder, config, command)
            remove_half_written(folder)
        else:
            check_empty(folder)
            check_sizes(config)
            if sentence := idle_robot(config):
                report(Trouble(sentence))
        stack.enter_context(threads_at(1))  # only the robot's gradient steps gain from more
        stop = stack.enter_context(StopSignals())
        run = FollowObject(
            config.env_id,
            preset=None,  # the settings are whole
            seed=config.seed,
            report=report,
            **copy.deepcopy(config.settings),  # SB3 writes into policy_kwargs
        )
        stack.callback(run.close)
        run.check()
        if not resume:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock(folder, wait=False))
            remove_half_written(folder)
            claim(folder, config, command)
        checkpoints = Checkpoints(folder, config.keep_checkpoints, report)
        stack.callback(checkpoints.wait)
        stages = RunStages(config, folder, run, checkpoints, stop)
        stages.load_newest_checkpoint()
        wall_before = stages.load_object_stage()
        try:
            if wall_before is None:
                wall_before = stages.learn_object_stage(shared=object_stage_only)
            if object_stage_only:
                return {}
            wall_s = stages.learn_robot_stage(wall_before, progress)
            result = stages.final_test(wall_s, command)
            checkpoints.remove(keep_last=config.keep_last_checkpoint)
            return result
        except Exception as error:
            checkpoints.wait()
            raise _stopped(error, run, folder) from error


def _stopped(error: Exception, run: FollowObject, folder: Path) -> RuntimeError:
    """Say in one sentence what happened, and from where the run can go on."""
    named = isinstance(error, (ValueError, RuntimeError, OSError)) and str(error)
    what = " ".join((str(error) if named else f"{type(error).__name__}: {error}").split())
    kept = checkpoint_files(folder)
    rest = f"from {kept[-1].name}" if kept else "from its beginning"
    return RuntimeError(
        f"training stopped at {run.env_steps} env steps: {what}; "
        f"the run in {folder} can be resumed {rest}"
    )
