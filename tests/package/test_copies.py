"""A copy goes on exactly as the original, and neither disturbs the other.

Whatever the way: copy, pickle, a fork or a spawned process. What cannot be copied says so.
"""

from __future__ import annotations

import copy
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import copied_things
import copies_elsewhere
import numpy as np
import pytest
import toy
from copied_things import THINGS, seeded
from small_models import TINY
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor
from tree import ROOT

from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.comparison.executors import LocalExecutor
from sb3_follow_object.comparison.grid_display import GridDisplay
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec
from sb3_follow_object.runs.checkpoints import Checkpoints
from sb3_follow_object.runs.progress import ProgressBar
from sb3_follow_object.runs.run_callbacks import StopSignals

WAYS: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "cloudpickle": lambda thing: pickle.loads(cloudpickle.dumps(thing)),
}
# Python's copy of a wrapper or a tuple is one around the same things.
SHALLOW = ("wrapped FetchEnv", "DummyVecEnv", "VecMonitor", "VecFrameStack")
SHALLOW += ("CurriculumCallback", "OriginalGoalEvalCallback", "ReachCallback", "FollowObject")


@pytest.mark.parametrize("name", THINGS)
def test_a_copy_goes_on_as_the_original_and_neither_disturbs_the_other(name: str) -> None:
    make, use = THINGS[name]
    reference = seeded(make)
    expected = [seeded(use, reference), seeded(use, reference)]
    thing = seeded(make)
    ways = {way: WAYS[way] for way in WAYS if way != "copy" or name not in SHALLOW}
    copies = {way: do(thing) for way, do in ways.items()}
    copies["deepcopy of a copy"] = copy.deepcopy(copies["pickle"])
    for way, twin in {**copies, "original": thing}.items():
        np.testing.assert_equal([seeded(use, twin), seeded(use, twin)], expected, err_msg=way)


@pytest.fixture(scope="module", params=["fork", "spawn"])
def verdicts(request: pytest.FixtureRequest) -> dict[str, str]:
    """How each thing compares with what another process has of it."""
    done = subprocess.run(
        [sys.executable, copies_elsewhere.__file__, request.param],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / "tests" / "support")},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.mark.parametrize("name", THINGS)
def test_another_process_goes_on_as_this_one(name: str, verdicts: dict[str, str]) -> None:
    assert verdicts[name] == "equal"


def in_processes() -> Any:
    return SubprocVecEnv([toy.PointEnv], start_method="spawn")


REFUSED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "evaluations": (
        lambda folder: OriginalGoalEvalCallback(
            DummyVecEnv([toy.PointEnv]), 1, 10, folder / "evaluations.csv"
        ),
        r"evaluations.csv cannot be copied.*make another with a csv_path of its own",
    ),
    "monitor": (
        lambda folder: VecMonitor(make_vec(copied_things.PUSH, 1, 1), str(folder / "log")),
        "two would write into one file: leave the filename out",
    ),
    "Checkpoints": (lambda folder: Checkpoints(folder, 1, print), "make others for another run"),
    "LocalExecutor": (lambda folder: LocalExecutor(1, folder), "make another"),
    "ProgressBar": (lambda folder: ProgressBar(10), "make another"),
    "GridDisplay": (lambda folder: GridDisplay(), "make another"),
    "StopSignals": (lambda folder: StopSignals(), "make others"),
    "SubprocVecEnv": (
        lambda folder: HerDDPG("MultiInputPolicy", in_processes(), **{**TINY, "buffer_size": 100}),
        "runs processes, which cannot be copied: copy with a DummyVecEnv, or save the model",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_process_holds_is_not_copied(name: str, tmp_path: Path) -> None:
    make, sentence = REFUSED[name]
    thing = make(tmp_path)
    try:
        for way in WAYS.values():
            with pytest.raises(ValueError, match=sentence):
                way(thing)
    finally:
        if isinstance(thing, HerDDPG):
            assert thing.env is not None
            thing.env.close()


def test_pictures_are_drawn_anew_in_a_copy(can_draw: None) -> None:
    env = make_vec(copied_things.PUSH, 1, 1, seed=0, render_mode="rgb_array")
    env.reset()
    env.set_markers(np.full((1, 3), 0.7))
    picture = env.get_images()[0]
    for way in WAYS.values():
        twin = way(env)
        np.testing.assert_array_equal(twin.get_images()[0], picture)
        twin.close()
    np.testing.assert_array_equal(env.get_images()[0], picture)
    env.close()


def test_a_fork_of_a_process_that_draws_says_that_it_cannot(can_draw: None) -> None:
    script = """
import os, sys
from sb3_follow_object.envs import make_vec
env = make_vec(sys.argv[1], 1, 1, render_mode="rgb_array")
env.reset()
env.get_images()
if os.fork() == 0:
    try:
        env.get_images()
    except RuntimeError as error:
        print(error, flush=True)
    env.close()
    os._exit(0)
os.wait()
env.get_images()
env.close()
"""
    command = [sys.executable, "-c", script, copied_things.PUSH]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert "start it by spawn or forkserver" in done.stdout


def test_threads_are_let_go_and_come_back() -> None:
    env = make_vec(copied_things.PUSH, 2, 2, seed=0)
    twin = make_vec(copied_things.PUSH, 2, 1, seed=0)
    actions = np.full((2, 4), 0.3)
    for each in (env, twin):
        each.reset()
        each.step(actions)
        each.close()
        each.close()
    np.testing.assert_equal(env.step(actions)[0], twin.step(actions)[0])
