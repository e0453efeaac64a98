"""What goes wrong is named in one sentence, and what was good before is still there."""

from __future__ import annotations

import errno
import multiprocessing
import os
import resource
import shutil
import subprocess
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bad_envs
import gymnasium as gym
import mujoco
import numpy as np
import pytest
import tiny_runs as runs
import toy

from sb3_follow_object.callbacks.rollout import run_episodes
from sb3_follow_object.command.cli import main
from sb3_follow_object.common.array_trees import load_tree
from sb3_follow_object.common.files import lock
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec
from sb3_follow_object.follow_object.robot_stage import RobotStage
from sb3_follow_object.object_stage.policy import collect_paths
from sb3_follow_object.runs import evaluation, stages
from sb3_follow_object.runs.checkpoints import checkpoint_files
from sb3_follow_object.runs.evaluation import evaluate
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.runs.run_folder import noted_command, task_label
from sb3_follow_object.settings.run_config import RunConfig

TASK = "FollowObject/PnPSimpleV1-v0"


def config(env_id: str, **changes: Any) -> RunConfig:
    """A run of DDPG + HER on one of the toys, with a checkpoint at each rollout."""
    # In this process, where the tests count steps.
    settings: dict[str, Any] = {"imagine": False, "n_envs": 2, "n_threads": 1}
    settings |= {"algorithm": runs.SMALL_NET}
    defaults: dict[str, Any] = {"eval_every": 10**6, "n_final_episodes": 2, "settings": settings}
    defaults |= {"total_timesteps": 200, "checkpoint_minutes": 1e-9, "method": "her"}
    return RunConfig(env_id, **{**defaults, **changes})


# Environments


@pytest.mark.parametrize(
    ("env_id", "sentence"),
    [
        ("RaisesInStep-v0", r"ZeroDivisionError: the gripper left the table"),
        ("ReturnsNan-v0", r"next observation 'achieved_goal' of environment [01] holds NaN"),
    ],
)
def test_environment_that_fails_in_mid_episode(env_id: str, sentence: str, tmp_path: Path) -> None:
    bad_envs.AFTER_STEPS[0] = 105  # in the sixth rollout of two copies of ten steps
    with pytest.raises(RuntimeError, match=sentence) as error:
        train(config(env_id), tmp_path / "run", report=runs.quiet)
    assert "\n" not in str(error.value)
    assert "training stopped at 1" in str(error.value)
    assert "resumed from checkpoint-000000000100.safetensors" in str(error.value)
    bad_envs.AFTER_STEPS[0] = 10**6
    result = train(config(env_id), tmp_path / "run", resume=True, report=runs.quiet)
    assert result["env_steps"] == 200
    train(config("Good-v0"), tmp_path / "good", report=runs.quiet)
    kept = [(tmp_path / name / "policy.safetensors") for name in ("run", "good")]
    first, second = (load_tree(path)["actor"] for path in kept)
    assert all((first[name] == second[name]).all() for name in first)


def test_environment_that_cannot_begin_is_refused_before_there_is_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot be made and begun: ZeroDivisionError: no start"):
        train(config("RaisesInReset-v0"), tmp_path / "run", report=runs.quiet)
    assert not (tmp_path / "run").exists()


# Physics


class Blown:
    """Gives one copy a velocity that mujoco refuses, at a step of its first episode."""

    def __init__(self, env: Any, copy: int = 1, at: int = 20) -> None:
        self.env, self.copy, self.at = env, copy, at
        self.simulation = env.simulation
        self.control = self.simulation.control
        self.steps = 0
        self.simulation.control = self

    def __call__(self, actions: np.ndarray) -> None:
        self.control(actions)
        self.steps += 1
        if self.steps == self.at:
            self.simulation.data[self.copy].qvel[:] = np.inf


def test_diverged_copy_rests_until_its_episode_ends(caplog: pytest.LogCaptureFixture) -> None:
    env = make_vec(TASK, 3, 1, seed=0)
    Blown(env)
    env.reset()
    seen = []
    for step in range(1, 51):
        obs, _, dones, infos = env.step(np.full((3, 4), 0.1))
        assert all(np.isfinite(value).all() for value in obs.values())
        assert dones.all() == (step == 50) and dones.any() == (step == 50)
        seen.append(obs["observation"].copy())
    assert (seen[18][1] == seen[48][1]).all(), "the last good observation"
    assert (seen[18][0] != seen[48][0]).any(), "the others go on"
    assert [info.get("diverged") for info in infos] == [None, "BADQVEL at step 20", None]
    assert (infos[1]["terminal_observation"]["observation"] == seen[18][1]).all()
    (record,) = caplog.records
    assert record.getMessage() == (
        "the physics of environment 1 (PnPSimpleV1) diverged: BADQVEL at step 20; "
        "its episode is dropped"
    )
    env.step(np.zeros((3, 4)))
    assert not np.array(env.simulation.data[1].warning.number).any()
    assert env.simulation.faults == [None, None, None]
    env.close()


def test_diverged_single_environment_is_truncated() -> None:
    env = gym.make(TASK)
    env.reset(seed=0)
    last, *_ = env.step(np.zeros(4, dtype=np.float32))
    env.unwrapped.simulation.data[0].qvel[:] = np.inf  # type: ignore[attr-defined]
    obs, _, terminated, truncated, info = env.step(np.zeros(4, dtype=np.float32))
    assert (terminated, truncated) == (False, True)
    assert info["diverged"] == "BADQVEL at step 2"
    assert (obs["observation"] == last["observation"]).all()
    env.reset()
    *_, truncated, info = env.step(np.zeros(4, dtype=np.float32))
    assert not truncated and "diverged" not in info
    env.close()


def test_diverged_episode_never_enters_the_buffer() -> None:
    env = make_vec(TASK, 3, 1, seed=0)
    Blown(env)
    options = {**runs.SMALL_NET, "buffer_size": 3000}
    model = HerDDPG("MultiInputPolicy", env, seed=0, **options)
    model.learn(2 * 3 * 50)
    buffer: Any = model.replay_buffer
    assert buffer.table.n_transitions() == 5 * 50
    rows = np.flatnonzero(buffer.table.length)
    assert (1, 0) not in set(zip(buffer.table.env[rows], buffer.table.start[rows], strict=True))
    assert (buffer.ep_length[:50, 1] == 0).all()
    assert all(np.isfinite(store).all() for store in buffer._stores().values())
    env.close()


def test_diverged_episodes_are_not_counted() -> None:
    env = make_vec(TASK, 2, 1, seed=0)
    Blown(env)
    episodes = run_episodes(lambda obs: np.zeros((2, 4)), env, 2)
    assert len(episodes.success) == 2
    assert episodes.env_steps == 2 * 2 * 50
    env.close()

    class Still:
        def predict(self, obs: Any, deterministic: bool) -> tuple[np.ndarray, None]:
            return np.zeros((2, 7)), None

    alone = make_vec(TASK.replace("-v0", "Object-v0"), 2, 1, seed=0)
    Blown(alone)
    paths = collect_paths(Still(), alone, 2)
    assert len(paths.positions) == len(paths.goals) == 3
    assert np.abs(np.diff(paths.positions, axis=1)).max() < 0.1
    alone.close()


def test_physics_that_always_diverge_end_in_a_sentence() -> None:
    env = make_vec(TASK, 2, 1, seed=0)
    env.simulation.after_substeps = lambda index: env.simulation.data[index].warning.number.fill(1)
    with pytest.raises(RuntimeError, match=r"diverged in 3 episodes of 2 wanted"):
        run_episodes(lambda obs: np.zeros((2, 4)), env, 2)
    env.close()


def test_every_warning_of_mujoco_counts() -> None:
    env = make_vec(TASK, 1, 1, seed=0)
    env.reset()
    for kind in mujoco.mjtWarning.__members__.values():
        if kind == mujoco.mjtWarning.mjNWARNING:
            continue
        number = env.simulation.data[0].warning.number
        number[int(kind)] = 1
        env.step(np.zeros((1, 4)))
        assert env.simulation.faults[0] is not None
        env.reset()
    env.close()


# Files


def test_full_disk_leaves_the_last_good_checkpoint(tmp_path: Path) -> None:
    told: list[str] = []
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(figures: dict[str, Any]) -> None:
        """From the fifth rollout on no file may grow beyond a few kilobytes."""
        if figures["env_steps"] == 100:
            resource.setrlimit(resource.RLIMIT_FSIZE, (8192, hard))
        if figures["env_steps"] == 160:
            raise InterruptedError("pulled the plug")

    try:
        with pytest.raises(RuntimeError, match="pulled the plug"):
            train(config("Good-v0"), tmp_path / "run", report=told.append, progress=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    failed = [sentence for sentence in told if "could not be written" in sentence]
    assert failed and os.strerror(errno.EFBIG) in failed[0]
    newest = checkpoint_files(tmp_path / "run")[-1]
    assert newest.name in failed[-1]
    load_tree(newest)
    assert not list((tmp_path / "run").glob(".*.tmp"))
    train(config("Good-v0"), tmp_path / "run", resume=True, report=runs.quiet)


class Wandering(toy.PointEnv):
    """Changes the working folder when it is made."""

    def __init__(self) -> None:
        os.chdir("/")
        super().__init__()


gym.register("Wandering-v0", entry_point=Wandering, max_episode_steps=toy.HORIZON)


class Counted(toy.PointEnv):
    """Knows how many of it there are."""

    alive: weakref.WeakSet[Any] = weakref.WeakSet()

    def __init__(self) -> None:
        super().__init__()
        self.alive.add(self)


gym.register("Counted-v0", Counted, max_episode_steps=toy.HORIZON)


def test_the_final_test_does_not_keep_the_validations_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of some robots take hundreds of megabytes each."""
    alive = []

    def counting(*arguments: Any) -> Any:
        alive.append(len(Counted.alive))
        return evaluate(*arguments)

    monkeypatch.setattr(stages, "evaluate", counting)
    train(config("Counted-v0"), tmp_path / "run", report=runs.quiet)
    assert alive[0] < 2 + evaluation._COPIES, "the training's and none of the validation's"


def test_an_interrupted_run_closes_the_validations_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []

    def interrupt(*arguments: Any) -> None:
        raise KeyboardInterrupt

    def noting(*arguments: Any, **options: Any) -> Any:
        env = evaluation.evaluation_env(*arguments, **options)
        monkeypatch.setattr(env, "close", lambda: closed.append(env))
        return env

    monkeypatch.setattr(stages, "evaluation_env", noting)
    monkeypatch.setattr(RobotStage, "learn", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train(config("Counted-v0"), tmp_path / "run", report=runs.quiet)
    assert len(closed) == 1


def test_a_relative_folder_is_the_one_of_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # and back at the end
    result = train(
        config("Good-v0"), "by-callback", report=runs.quiet, progress=lambda _: os.chdir("/")
    )
    assert result["task"] == "Good-v0"
    os.chdir(tmp_path)
    words = ["train", "--env", "Wandering-v0", "--method", "her", "--steps", "200"]
    words += ["--n-envs", "2", "--threads", "1", "--quiet", "--run", "by-env", "--set"]
    words += ["policy_kwargs.net_arch=[8]", "batch_size=16", "gradient_steps=2"]
    words += ["buffer_size=2000", "n_final_episodes=2"]
    assert refuse(*words) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"by-callback", "by-env"}
    assert all((path / "result.json").exists() for path in tmp_path.iterdir())


def test_the_packages_tasks_alone_have_short_names() -> None:
    assert task_label("FollowObject/PnPShelf-v0") == "PnPShelf"
    for other in ("my_module:My-Space/Point-v0", "FetchPush-v4", "FollowObject/PnPShelfObject-v0"):
        assert task_label(other) == other


def test_a_command_that_is_no_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "command.txt").write_bytes(b"train --run \xff\n")
    with pytest.raises(ValueError, match=r"command.txt is not what started a run"):
        noted_command(tmp_path)


def refuse(*argv: object) -> int:
    return main([str(word) for word in argv])


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own with room for 3 MB."""
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(tmp_path)]
    try:
        allowed = subprocess.run(mount, capture_output=True).returncode == 0
    except OSError:
        allowed = False
    if not allowed:
        pytest.skip("a file system cannot be mounted here")
    yield tmp_path
    subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)  # logs are open


def test_run_on_a_full_disk_ends_in_a_sentence_and_resumes(small_disk: Path) -> None:
    folder, filler = small_disk / "run", small_disk / "filler"
    told = []

    def fill_at_3000(sentence: str) -> None:
        told.append(sentence)
        if sentence.startswith("checkpoint at 3000"):
            filler.write_bytes(bytes(shutil.disk_usage(small_disk).free))

    with pytest.raises(RuntimeError, match=r"No space left.* resumed from checkpoint-0*3000\."):
        train(runs.config(), folder, report=fill_at_3000)
    assert any("3400 env steps could not be written (No space left" in line for line in told)
    filler.unlink()
    assert runs.run(folder, resume=True)["env_steps"] == 3600


def test_output_that_cannot_be_written_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    words = ["train", "--env", runs.TASK, "--method", "her", "--n-envs", "2"]
    assert refuse(*words, "--run", tmp_path / "file" / "run") == 2
    assert "Not a directory" in capsys.readouterr().err
    if os.geteuid() != 0:
        tmp_path.chmod(0o555)
    else:  # root may write anywhere: be somebody else for a moment
        tmp_path.chmod(0o755)
        os.seteuid(65534)
    try:
        assert refuse(*words, "--run", tmp_path / "run") == 2
    finally:
        os.seteuid(os.getuid())
        tmp_path.chmod(0o755)
    err = capsys.readouterr().err
    assert "Permission denied" in err and err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"file"}


def hold(folder: str, ready: Any, done: Any) -> None:
    with lock(folder, wait=False):
        ready.set()
        done.wait(60)


def test_two_processes_cannot_train_in_one_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RuntimeError):
        bad_envs.AFTER_STEPS[0] = 45
        train(config("RaisesInStep-v0"), tmp_path / "run", report=runs.quiet)
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    other = spawn.Process(target=hold, args=(str(tmp_path / "run"), ready, done))
    other.start()
    assert ready.wait(60)
    assert refuse("train", "--resume", "--run", tmp_path / "run") == 2
    err = capsys.readouterr().err
    assert "another process works in" in err and err.count("\n") == 1
    assert {path: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
    done.set()
    other.join()
    bad_envs.AFTER_STEPS[0] = 10**6
    train(config("RaisesInStep-v0"), tmp_path / "run", resume=True, report=runs.quiet)
