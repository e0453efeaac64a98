"""What the process has set globally is neither assumed nor left changed."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_runs
import torch as th
import toy
from numbered import learner, numbered
from stable_baselines3.common.vec_env import DummyVecEnv
from tree import ROOT, run

from sb3_follow_object import HerPolicy, load_actor, save_actor
from sb3_follow_object.ddpg.layer_norm import LayerNorm
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.object_stage.networks import ObjectNetworks
from sb3_follow_object.runs.run_callbacks import StopSignals


@contextmanager
def dtype(wanted: th.dtype) -> Iterator[None]:
    th.set_default_dtype(wanted)
    try:
        yield
        assert th.get_default_dtype() == wanted  # left as it was
    finally:
        th.set_default_dtype(th.float32)


@contextmanager
def device(wanted: str) -> Iterator[None]:
    """A default device that holds no numbers: whatever is put there is noticed."""
    th.set_default_device(wanted)
    try:
        yield
        assert th.get_default_device().type == wanted
    finally:
        th.set_default_device(None)


@contextmanager
def deterministic() -> Iterator[None]:
    th.use_deterministic_algorithms(True)
    try:
        yield
        assert th.are_deterministic_algorithms_enabled()
    finally:
        th.use_deterministic_algorithms(False)


@contextmanager
def warnings_as_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


SETTINGS: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "usual": nullcontext,
    "float64": lambda: dtype(th.float64),
    "float16": lambda: dtype(th.float16),
    "default device": lambda: device("meta"),
    "deterministic": deterministic,
    "numpy raises": lambda: np.errstate(all="raise"),
    "warnings are errors": warnings_as_errors,
}

MIRRORS = [{"axis": 0, "at": 0.15, "positions": [0], "actions": [0]}]  # of a point that is moved


def predictor() -> np.ndarray:
    paths, goals = toy.paths(20)
    made = GoalPredictor.fit(paths, goals, env_id="x", physics="y", hidden=(8,), epochs=2)
    return np.concatenate([made.paths(paths[:3, 0], goals[:3]).ravel(), made.error_mm])


def her_ddpg(**options: Any) -> np.ndarray:
    model = learner("HerDDPG", numbered(2), hindsight_bound=True, **options)
    model.learn(5 * 2 * toy.HORIZON)
    assert {p.dtype for p in model.policy.parameters()} == {th.float32}
    return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])


def with_everything() -> np.ndarray:
    return her_ddpg(
        auxiliary={"name": "rnd", "hidden": [8], "n_outputs": 4},
        policy_kwargs={"net_arch": [8], "critic_layer_norm": True, "mirrors": MIRRORS},
        replay_buffer_kwargs={"cher": {}, "moved_ratio": 0.5, "min_goal_distance": 0.05},
        average_decay=0.9,
        update_threads=2,
        matmul_precision="medium",
    )


def on_device() -> np.ndarray:
    return her_ddpg(replay_on_device=True)


def actor_file(folder: Path) -> np.ndarray:
    model = learner("HerDDPG", numbered(2), policy_kwargs={"net_arch": [8], "mirrors": MIRRORS})
    save_actor(folder / "actor", model.policy.actor_average, "x")
    actor, _ = load_actor(folder / "actor", model.observation_space, model.action_space)
    model.policy.save(str(folder / "policy"))
    policy = HerPolicy.load(str(folder / "policy"))
    model.save(folder / "model")
    loaded = type(model).load(folder / "model")
    seen = {key: np.full((2, 3), 0.1) for key in ("observation", "achieved_goal", "desired_goal")}
    return np.stack([each.predict(seen, deterministic=True)[0] for each in (actor, policy, loaded)])


def object_networks(folder: Path) -> np.ndarray:
    networks = ObjectNetworks("x", "y", pi=[8], qf=[8], inverse=[8], layer_norm=True)
    with th.no_grad():
        for parameter in networks.parameters():
            parameter.fill_(0.1)
    networks.save(folder / "networks")
    loaded = ObjectNetworks.load(folder / "networks")
    cpu = {"dtype": th.float32, "device": "cpu"}
    state, goal = th.full((2, 12), 0.1, **cpu), th.full((2, 3), 0.2, **cpu)
    return loaded.value(state, goal, loaded.infer(state, state + 0.1, goal)).numpy()


def imagined_goals() -> np.ndarray:
    paths, goals = toy.paths(20)
    made = GoalPredictor.fit(paths, goals, env_id="x", physics="y", hidden=(8,), epochs=1)
    env = ImaginedGoalVecEnv(DummyVecEnv([toy.PointEnv] * 2), made, toy.curriculum(p=0.0))
    env.seed(0)
    env.reset()
    steps = [env.step(np.zeros((2, 3), np.float32)) for _ in range(25)]
    return np.stack([obs["desired_goal"] for obs, *_ in steps])  # type: ignore[call-overload, index]


PIECES: dict[str, Callable[..., np.ndarray]] = {
    "predictor": predictor,
    "HerDDPG": her_ddpg,
    "HerDDPG with everything": with_everything,
    "replay on the device": on_device,
    "actor file": actor_file,
    "object networks": object_networks,
    "imagined goals": imagined_goals,
}


def made(piece: str, folder: Path) -> np.ndarray:
    make = PIECES[piece]
    th.manual_seed(0)
    np.random.seed(0)
    return make(folder) if make in (actor_file, object_networks) else make()


@pytest.mark.parametrize("piece", PIECES)
def test_the_process_settings_change_nothing(piece: str, tmp_path: Path) -> None:
    (tmp_path / "usual").mkdir()
    expected = made(piece, tmp_path / "usual")
    assert np.isfinite(expected).all()
    threads = th.get_num_threads()
    for name, setting in SETTINGS.items():
        (tmp_path / f"in {name}").mkdir()
        with setting():
            got = made(piece, tmp_path / f"in {name}")
        np.testing.assert_array_equal(got, expected, err_msg=name)
        assert th.get_num_threads() == threads


def test_layer_norm_works_in_doubles_and_deterministically() -> None:
    layer = LayerNorm(4, dtype=th.float64)
    x = th.arange(12.0, dtype=th.float64).reshape(3, 4)
    with dtype(th.float64), deterministic():
        layer(x).square().sum().backward()
    assert layer.weight.grad.dtype == th.float64


def run_in_thread(work: Callable[[], Any]) -> Any:
    done: list[Any] = []

    def body() -> None:
        try:
            done.append(work())
        except BaseException as error:
            done.append(error)

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    if isinstance(done[0], BaseException):
        raise done[0]
    return done[0]


def test_a_run_off_the_main_thread_is_that_of_the_main_thread(tmp_path: Path) -> None:
    settings = {**tiny_runs.TINY, "imagine": False}
    config = tiny_runs.config(total_timesteps=1200, settings=settings, method="her")
    threads, handlers = th.get_num_threads(), signal.getsignal(signal.SIGINT)
    th.set_num_threads(2)
    try:
        tiny_runs.run(tmp_path / "main", config=config)
        assert th.get_num_threads() == 2
    finally:
        th.set_num_threads(threads)
    run_in_thread(lambda: tiny_runs.run(tmp_path / "thread", config=config))
    assert tiny_runs.outcome(tmp_path / "thread") == tiny_runs.outcome(tmp_path / "main")
    assert signal.getsignal(signal.SIGINT) is handlers


def test_stop_signals_leave_the_handlers_as_they_were() -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with StopSignals() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before
    run_in_thread(lambda: StopSignals().__enter__().__exit__())


SCRIPT = """
import sys
sys.path.insert(0, {support!r})
import numpy as np, torch as th, toy
from stable_baselines3.common.vec_env import SubprocVecEnv
from sb3_follow_object import GoalPredictor, ImaginedGoalWrapper

if __name__ == "__main__":
    th.set_num_threads(2)
    th.randn(1000, 1000) @ th.randn(1000, 1000)  # the parent's threads have worked
    paths, goals = toy.paths(20)
    made = GoalPredictor.fit(
        paths, goals, env_id="x", physics="y", hidden=(512, 512, 512), epochs=1
    )
    levels = toy.curriculum(p=0.0, levels="path")
    wrapped = lambda: ImaginedGoalWrapper(toy.PointEnv(), made, levels)
    env = SubprocVecEnv([wrapped] * 2, start_method={method!r})
    env.seed(0)
    env.reset()
    for _ in range(25):
        obs = env.step(np.zeros((2, 3), np.float32))[0]
    assert np.isfinite(obs["desired_goal"]).all()
    env.close()
"""


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_goals_are_imagined_in_processes_of_every_start_method(method: str) -> None:
    script = SCRIPT.format(support=str(ROOT / "tests" / "support"), method=method)
    threads = {**os.environ, "OMP_NUM_THREADS": "2"}
    run([sys.executable, "-c", script], timeout=120, env=threads)
