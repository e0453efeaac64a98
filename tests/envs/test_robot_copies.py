"""Copies in processes do what copies in one process do, to the bit."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import arm_and_wall
import gymnasium as gym
import numpy as np
import pytest
import toy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_follow_object.envs import copies_worker, robot_copies
from sb3_follow_object.envs.robot_copies import (
    ProcessVecEnv,
    robot_maker,
    robot_vec_env,
    with_face,
)


def test_processes_say_nothing_of_other_environments_versions(
    capfd: pytest.CaptureFixture[str],
) -> None:
    ProcessVecEnv(robot_maker("FetchReach-v4"), 1, 1).close()
    assert capfd.readouterr() == ("", "")


class Lost(Exception):
    """An error of somebody's own."""


class Breaks(toy.PointEnv):
    """Raises an error in the first copy's third step."""

    error: Exception = ZeroDivisionError("the gripper left the table")

    def step(self, action: np.ndarray) -> Any:
        if self.steps == 2 and action[0] > 0.0:
            raise self.error
        return super().step(action)


class Loses(Breaks):
    error = Lost()


class Misreads(Breaks):
    error = UnicodeDecodeError("utf-8", b"a", 0, 1, "no start")


class Tuned(toy.PointEnv):
    """Judges by a tolerance that a reset makes and a method changes; notes when it is closed."""

    def __init__(self, closed: Path) -> None:
        super().__init__()
        self.closed = closed

    def reset(self, **options: Any) -> Any:
        self.tolerance = 0.05
        return super().reset(**options)

    def set_tolerance(self, tolerance: float) -> None:
        self.tolerance = tolerance

    def is_success(self, achieved: np.ndarray, desired: np.ndarray) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1) < self.tolerance

    def close(self) -> None:
        with self.closed.open("a") as file:
            file.write("closed\n")


def test_results_do_not_depend_on_the_number_of_processes() -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (55, 5, 3)).astype(np.float32)
    outcomes = []
    for n_threads in (1, 2):
        env = robot_vec_env(arm_and_wall.ARM, 5, n_threads)
        assert isinstance(env, DummyVecEnv if n_threads == 1 else ProcessVecEnv)
        env.seed(7)
        seen = [env.reset()]
        ends = []
        for action in actions:
            obs, rewards, dones, infos = env.step(action)
            seen.append({key: values.copy() for key, values in obs.items()})
            ends.append((rewards.copy(), dones.copy(), infos))
        goal = seen[-1]["desired_goal"]
        assert env.env_method("compute_reward", goal, goal, None, indices=[0])[0].shape == (5,)
        assert env.get_attr("spec", indices=[0])[0].max_episode_steps == 50
        assert env.has_attr("compute_reward") and not env.has_attr("no such thing")
        outcomes.append((seen, ends))
        env.close()
    (seen, ends), (other_seen, other_ends) = outcomes
    for one, other in zip(seen, other_seen, strict=True):
        for key, values in one.items():
            assert values.dtype == other[key].dtype
            np.testing.assert_array_equal(values, other[key])
    for one, other in zip(ends, other_ends, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
        for info, other_info in zip(one[2], other[2], strict=True):
            assert info["TimeLimit.truncated"] == other_info["TimeLimit.truncated"]
            last, other_last = (i.get("terminal_observation") for i in (info, other_info))
            assert (last is None) == (other_last is None)
            if last is not None:
                np.testing.assert_array_equal(last["observation"], other_last["observation"])
    assert ends[49][1].all() and not ends[48][1].any()


@pytest.mark.parametrize(
    ("kind", "error", "sentence"),
    [
        (Breaks, ZeroDivisionError, "^the gripper left the table$"),
        (Loses, RuntimeError, "^Lost$"),
        (Misreads, RuntimeError, "^UnicodeDecodeError: .*no start"),
    ],
)
def test_what_goes_wrong_in_a_process_is_raised_here(
    kind: type[Breaks], error: type[Exception], sentence: str
) -> None:
    env = ProcessVecEnv(kind, 4, 2)
    env.reset()
    forward = np.array([[1.0, 0.0, 0.0]] + [[-1.0, 0.0, 0.0]] * 3)
    with pytest.raises(error, match=sentence) as caught:
        for _ in range(3):
            env.step(forward)
    assert "raise self.error" in str(caught.value.__cause__), "where it was raised"
    # What the other process had to say is not taken for an answer to the next question.
    obs = env.reset()
    assert obs["observation"].shape == (4, 3)
    env.step(-np.abs(forward))
    with pytest.raises(ValueError, match="in processes cannot be copied"):
        pickle.dumps(env)
    env.close()
    env.close()


class Counts(toy.PointEnv):
    """Its object tells the steps of its episode."""

    def _observe(self) -> dict[str, np.ndarray]:
        return {**super()._observe(), "achieved_goal": np.full(3, float(self.steps))}

    def unreadable(self, what: Any) -> None:
        pass


class Unreadable:
    def __reduce__(self) -> Any:
        return _not_here, ()


def _not_here() -> None:
    raise LookupError("not in this process")


def _steps(obs: Any) -> list[float]:
    return obs["achieved_goal"][:, 0].tolist()


def test_answers_that_nobody_waited_for_are_not_taken_for_others() -> None:
    env = ProcessVecEnv(Counts, 4, 2)
    still = np.zeros((4, 3), np.float32)
    assert _steps(env.reset()) == [0.0] * 4
    env.step_async(still)  # and then an exception, such as Ctrl-C, comes between
    assert _steps(env.step(still)[0]) == [2.0] * 4
    env.step_async(still)
    assert _steps(env.reset()) == [0.0] * 4
    with pytest.raises(ValueError, match="3 actions were given for 4 environments"):
        env.step(still[:3])
    with pytest.raises(LookupError, match="not in this process"):
        env.env_method("unreadable", Unreadable(), indices=[0])
    assert env.get_attr("steps") == [0] * 4
    env.close()
    with pytest.raises(RuntimeError, match="the robot's environment is closed"):
        env.step(still)


def test_a_process_that_has_ended_is_one_sentence_whenever_it_is_asked() -> None:
    env = ProcessVecEnv(Counts, 4, 2)
    env.reset()
    process = env._workers[1]._process
    process.kill()
    process.wait()
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"has ended by itself \(status -9\)"):
            env.step(np.zeros((4, 3), np.float32))
    assert env.get_attr("steps", 0) == [2], "its neighbour answers what it is asked"
    env.close()


def test_a_fork_of_this_process_does_not_keep_the_processes_alive() -> None:
    env = ProcessVecEnv(Counts, 4, 2)
    env.reset()
    fork = os.fork()  # which has this process's end of every line
    if fork == 0:
        time.sleep(60.0)
        os._exit(0)
    try:
        started = time.monotonic()
        env.close()
        assert time.monotonic() - started < robot_copies._CLOSING_S / 2
        assert [worker._process.poll() for worker in env._workers] == [0, 0]
    finally:
        os.kill(fork, signal.SIGKILL)
        os.waitpid(fork, 0)


class Stuck(toy.PointEnv):
    """Takes a minute to close, but in the process that judges."""

    def __init__(self, judge: int) -> None:
        super().__init__()
        self.judge = judge

    def close(self) -> None:
        if os.getpid() != self.judge:
            time.sleep(60.0)


def test_a_process_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_copies, "_CLOSING_S", 0.2)
    env = ProcessVecEnv(partial(Stuck, os.getpid()), 2, 1)
    env.reset()
    env.close()
    assert env._workers[0]._process.poll() == -signal.SIGKILL


def test_what_cannot_be_sent_is_one_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    held = threading.Lock()

    def make() -> gym.Env:
        with held:
            return toy.PointEnv()

    with pytest.raises(ValueError) as refusal:
        ProcessVecEnv(make, 4, 2)
    assert str(refusal.value) == (
        "the environment cannot be sent to processes (TypeError: cannot pickle '_thread.lock' "
        "object); take n_threads=1"
    )
    assert capfd.readouterr() == ("", ""), "no process has begun"


def test_a_process_that_nobody_tells_what_to_make_ends_quietly() -> None:
    ours, theirs = Pipe()
    ours.close()
    copies_worker.serve(theirs)


class OfOneProcess(toy.PointEnv):
    """Can be made in the process that judges alone."""

    def __init__(self, judge: int) -> None:
        super().__init__()
        if os.getpid() != judge:
            raise LookupError("only one may be open")


def test_processes_end_where_one_cannot_make_its_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Any] = []
    begin = robot_copies._Worker.__init__

    def noting(worker: Any, *arguments: Any) -> None:
        begin(worker, *arguments)
        begun.append(worker)

    monkeypatch.setattr(robot_copies._Worker, "__init__", noting)
    with pytest.raises(LookupError, match="only one may be open"):
        ProcessVecEnv(partial(OfOneProcess, os.getpid()), 4, 2)
    assert [worker._process.poll() is None for worker in begun] == [False, False]


_OF_A_SCRIPT = """
import gymnasium as gym
from sb3_follow_object.envs.robot_copies import ProcessVecEnv, robot_vec_env
from test_robot_copies import Counts
from toy import HORIZON

class Mine(Counts):
    ...

gym.register("Mine-v0", "__main__:Mine", max_episode_steps=HORIZON)
env = robot_vec_env("Mine-v0", 4, 2)
assert isinstance(env, ProcessVecEnv)
print(env.reset()["achieved_goal"].shape, env.get_attr("spec")[0].id)
env.close()
"""


def _run(code: str) -> subprocess.CompletedProcess[str]:
    """Run a program that may import this module, in a session of its own."""
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent / "support")])
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path},
        start_new_session=True,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_an_environment_of_the_script_that_runs_is_known_in_processes() -> None:
    ended = _run(_OF_A_SCRIPT)
    assert (ended.returncode, ended.stdout) == (0, "(4, 3) Mine-v0\n"), ended.stderr


_INTERRUPTED = """
import os, signal
import numpy as np
from sb3_follow_object.common.signals import stop_signals_to
from sb3_follow_object.envs.robot_copies import ProcessVecEnv
from test_robot_copies import Counts

env, asked = ProcessVecEnv(Counts, 4, 2), []
env.reset()
with stop_signals_to(lambda: asked.append(1)):
    os.killpg(0, signal.SIGINT)  # what a terminal does on Ctrl-C
    for _ in range(20):
        obs = env.step(np.zeros((4, 3), np.float32))[0]
env.close()
print(len(asked), obs["achieved_goal"][0, 0])
"""


def test_ctrl_c_in_a_terminal_leaves_the_processes_to_the_training() -> None:
    ended = _run(_INTERRUPTED)
    assert (ended.returncode, ended.stdout) == (0, "1 0.0\n"), ended.stderr


def test_copies_and_what_judges_goals_are_tuned_and_closed_alike(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    env = ProcessVecEnv(partial(Tuned, closed), 4, 2)
    env.reset()
    goal = np.zeros((1, 3))
    near = goal + 0.05
    assert not env.env_method("is_success", near, goal, indices=[0])[0]
    env.env_method("set_tolerance", 0.2)
    assert env.env_method("is_success", near, goal, indices=[0])[0]
    assert env.get_attr("tolerance") == [0.2] * 4
    env.close()
    assert closed.read_text().count("closed") == 5, "four copies and the judge"


class Own(gym.Wrapper):
    """A wrapper that gymnasium cannot make anew."""


def test_a_wrapper_of_ones_own_may_be_around_an_environment() -> None:
    spec = gym.spec(arm_and_wall.ARM)
    for env in (Own(gym.make(spec)), gym.make(spec), Own(gym.make(spec))):
        assert with_face(env) is env, "it lacks nothing"
        env.close()
