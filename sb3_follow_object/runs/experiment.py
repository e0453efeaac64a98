"""A training run in a folder: started, interrupted, resumed, evaluated."""

from __future__ import annotations

import copy
import json
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.vec_env import VecEnv

from ..callbacks.eval_callback import OriginalGoalEvalCallback
from ..callbacks.rollout import Episodes, run_episodes
from ..common.files import atomic_write, lock, remove_half_written
from ..common.reports import Report, Trouble, reason
from ..common.seeds import stream_seed
from ..common.torch_helpers import threads_at
from ..ddpg.actor_files import load_actor
from ..envs.robot_copies import robot_vec_env
from ..follow_object.follow_object import FollowObject
from ..object_stage.policy import StopWhenSolved
from ..settings.run_config import RunConfig
from ..settings.sizes import check_sizes, idle_robot
from .checkpoints import Checkpoints, checkpoint_files, load_newest
from .object_stage_files import load_object_stage, save_object_stage
from .run_callbacks import CheckpointCallback, Progress, RunCallback, StopSignals
from .run_folder import (
    CROSS_TESTS,
    EVALUATIONS,
    POLICY,
    RESULT,
    check_empty,
    check_same_run,
    claim,
    finished_result,
    noted_command,
    take_steps,
)

# Evaluation copies: the paper's 380 episodes are ten from each.
_EVAL_COPIES = 38


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
    folder = Path(folder)
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
        # In a list that is emptied: it holds a replay buffer's worth of memory.
        loaded = [load_newest(folder, report) if resume else None]
        wall_before = load_object_stage(folder, run, loaded[0])
        try:
            if wall_before is None:
                wall_before = _object_stage(
                    config, folder, run, loaded, checkpoints, stop, shared=object_stage_only
                )
            if object_stage_only:
                return {}
            wall_s = _robot_stage(
                config, folder, run, loaded, wall_before, checkpoints, stop, progress
            )
            result = _final_test(config, folder, run, wall_s, stop, command)
            checkpoints.remove(keep_last=config.keep_last_checkpoint)
            return result
        except Exception as error:
            checkpoints.wait()
            raise _stopped(error, run, folder) from error


def _robot_stage(
    config: RunConfig,
    folder: Path,
    run: FollowObject,
    loaded: list[Any],
    wall_before: float,
    checkpoints: Checkpoints,
    stop: StopSignals,
    progress: Progress,
) -> float:
    """Run what is left of the robot's stage; return the seconds that all stages took."""
    saved = loaded.pop()
    if saved is not None and saved["stage"] != "robot":
        saved = None
    if saved is None:  # what was evaluated after the last checkpoint begins anew
        (folder / EVALUATIONS).unlink(missing_ok=True)

    run.report(f"the robot of {config.env_id} learns")
    model = run.prepare()
    model.update_threads = config.torch_threads
    asked = (config.settings.get("algorithm") or {}).get("device") or "auto"
    if asked != "auto" and th.device(asked).type != model.device.type:
        run.report(Trouble(f"there is no device {asked!r} here: the robot learns on the CPU"))
    eval_env = evaluation_env(config.env_id, n_threads=run.settings["n_threads"])
    evaluation = OriginalGoalEvalCallback(
        eval_env,
        config.n_eval_episodes,
        config.eval_every,
        csv_path=folder / EVALUATIONS,
        curriculum_callback=run.curriculum_callback,
        object_steps=run.object_steps,
        wall_before=wall_before,
        seed=stream_seed(config.seed, "validation"),
    )
    keeper = RunCallback(run, evaluation, folder, progress)
    if saved is not None:
        keeper.load_state_dict(saved)
        checkpoints.take_memory(keeper.state_dict())
        run.report(f"resumed at {run.env_steps} env steps")
    del saved
    # Those of the policy that is trained further from here on.
    (folder / RESULT).unlink(missing_ok=True)
    (folder / CROSS_TESTS).unlink(missing_ok=True)
    if model.num_timesteps == 0 and run.env_steps >= config.total_timesteps:
        run.report(
            Trouble(
                f"{run.env_steps} env steps are gone of {config.total_timesteps}: "
                "nothing is left for the robot to learn in"
            )
        )
    model.set_logger(_logger(folder, run.env_steps, run.report))
    writer = CheckpointCallback(
        checkpoints, keeper.state_dict, lambda: run.env_steps, config.checkpoint_minutes, stop
    )
    run.learn(config.total_timesteps, callback=CallbackList([evaluation, keeper, writer]))
    eval_env.close()
    return evaluation.wall_s


def _final_test(
    config: RunConfig,
    folder: Path,
    run: FollowObject,
    wall_s: float,
    stop: StopSignals,
    command: str,
) -> dict[str, Any]:
    """Test the last policy on fresh episodes; write the run's result and return it."""
    run.save_policy(folder / POLICY)
    run.report(f"final test: {config.n_final_episodes} episodes")
    episodes = evaluate(
        folder / POLICY, config.env_id, config.n_final_episodes, config.seed, stop.check
    )
    result = {
        "task": config.env_id.removeprefix("FollowObject/").removesuffix("-v0"),
        "method": config.method,
        "seed": config.seed,
        "env_steps": run.env_steps,
        "object_steps": run.object_steps,
        "test_steps": run.test_steps,
        "wall_s": round(wall_s, 1),
        "success_rate": episodes.success_rate,
        "episodes": config.n_final_episodes,
        "command": noted_command(folder, command),
        "k_max": run.curriculum.k_max if run.imagine else None,
    }
    (folder / CROSS_TESTS).unlink(missing_ok=True)  # of an earlier policy
    atomic_write(folder / RESULT, json.dumps(result, indent=2).encode())
    return result


def _object_stage(
    config: RunConfig,
    folder: Path,
    run: FollowObject,
    loaded: list[Any],
    checkpoints: Checkpoints,
    stop: StopSignals,
    shared: bool,
) -> float:
    """Run what is left of the stages before the robot's; return the seconds that they took.

    One that runs share makes what any of them may need.
    """
    saved, loaded[0] = loaded[0], None
    wall_before = 0.0 if saved is None else saved["wall_s"]
    started = time.monotonic()

    def wall_s() -> float:
        return wall_before + time.monotonic() - started

    def writer(solved: StopWhenSolved) -> CheckpointCallback:
        return CheckpointCallback(
            checkpoints,
            lambda: {"stage": "object", "object": solved.state_dict(), "wall_s": wall_s()},
            lambda: solved.model.num_timesteps,
            config.checkpoint_minutes,
            stop,
        )

    stage = run.object_stage
    learn = stage.learn_predictor if run.imagine else stage.learn_policy
    state = None if saved is None else saved["object"]
    learn(writer, state, between_epochs=stop.check, networks=shared)
    save_object_stage(folder, run, wall_s())
    if shared:
        checkpoints.remove()
    return wall_s()


def evaluation_env(env_id: str, seed: int | None = None, n_threads: int | None = None) -> VecEnv:
    """Return fresh copies of a task with its own goals and its sparse reward."""
    env = robot_vec_env(env_id, _EVAL_COPIES, n_threads)
    env.seed(seed)
    return env


def evaluate(
    policy_file: str | os.PathLike[str],
    env_id: str,
    n_episodes: int = 380,
    seed: int = 0,
    between_steps: Callable[[], None] = lambda: None,
) -> Episodes:
    """Test a saved policy: original goals, no noise, fresh episodes (section 5.2).

    The episodes' seeds are of a stream that neither training nor validation draws from.

    Args:
        policy_file: written by `save_actor`.
        env_id: the task.
        n_episodes: at least 1.
        seed: of the run.
        between_steps: called after each step; may raise to stop.

    Raises:
        ValueError: the file is missing, damaged or for other observations or actions, or
            `n_episodes` below 1.
    """
    env = evaluation_env(env_id, stream_seed(seed, "final test"))
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


def _logger(folder: Path, env_steps: int, report: Report) -> Logger:
    """CSV and TensorBoard; a resumed run begins another CSV rather than overwrite the first."""
    suffix = f"_{env_steps}"
    formats = [make_output_format("csv", str(folder), suffix)]
    try:
        import tensorboard  # noqa: F401

        formats.append(make_output_format("tensorboard", str(folder), suffix))
    except ModuleNotFoundError:
        pass
    except Exception as error:  # it drags in much that may not fit together
        report(Trouble(f"left out the log for TensorBoard: {reason(error)}"))
    return Logger(str(folder), formats)
