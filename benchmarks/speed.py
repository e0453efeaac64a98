"""Measure speed against what people use today, and print one table.

    python benchmarks/speed.py            # or: make bench
    python benchmarks/speed.py --only learner --rounds 3
    python benchmarks/speed.py --only gpu --out benchmarks/gpu.json

Each figure is measured in turn with its baseline, round after round, in this one process, and the
medians are compared: on a shared machine the ratio holds where the rates drift. Nothing else should
run meanwhile. Writes benchmarks/speed.json and benchmarks/throughput.png; a part alone is written
where --out says. "gpu", the learner on CUDA, is measured only when it is asked for.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import sb3_follow_object
from sb3_follow_object.common.files import atomic_write
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec
from sb3_follow_object.envs.registration import import_task
from sb3_follow_object.envs.robot_copies import robot_vec_env
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer
from sb3_follow_object.settings.presets import preset_file
from sb3_follow_object.settings.zoo_yaml import read_yaml

HERE = Path(__file__).parent
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
ROBOT, OBJECT, ORIGINAL = (
    "FollowObject/PnPSimpleV1-v0",
    "FollowObject/PnPSimpleV1Object-v0",
    "FetchPickAndPlace-v4",
)
OF_ROBOTICS = f"gymnasium_robotics:{ORIGINAL}"
ARM = "arm_and_wall:ArmAndWall-v0"
OF_OTHERS = 16  # copies of an environment that is not this package's
HIDDEN = [256, 256, 256]
PACKAGES = ("sb3-follow-object", "stable-baselines3", "gymnasium", "gymnasium-robotics", "mujoco")
PACKAGES += ("torch", "numpy", "envpool")

Measure = Callable[[], float]
Figure = tuple[str, str, Measure, dict[str, Measure]]


# ---- simulation: env steps a second, random actions, resets included -----------------------------


def vec_env_rate(env: VecEnv, n_steps: int) -> Measure:
    """Return a measure of a vectorised environment over `n_steps` calls of step."""
    rng = np.random.default_rng(0)
    env.reset()

    def measure() -> float:
        actions = rng.uniform(-1, 1, (n_steps, env.num_envs, *env.action_space.shape))  # type: ignore[misc]
        started = time.perf_counter()
        for action in actions.astype(np.float32):
            env.step(action)
        return n_steps * env.num_envs / (time.perf_counter() - started)

    return measure


def envpool_rate(n_envs: int, n_steps: int) -> Measure:
    """Return the same measure of EnvPool's FetchPickAndPlace-v4, which resets by itself too."""
    import envpool

    env = envpool.make(ORIGINAL, env_type="gymnasium", num_envs=n_envs, num_threads=CORES)
    rng = np.random.default_rng(0)
    env.reset()

    def measure() -> float:
        actions = rng.uniform(-1, 1, (n_steps, n_envs, 4))
        started = time.perf_counter()
        for action in actions:
            env.step(action)
        return n_steps * n_envs / (time.perf_counter() - started)

    return measure


@contextmanager
def tutorial_module() -> Iterator[None]:
    """Have the listing of docs/tutorials/own_robot.md as a module, here and in new processes."""
    text = (HERE.parent / "docs" / "tutorials" / "own_robot.md").read_text()
    (code,) = (part for part in text.split("```") if "class ArmAndWall" in part)
    with TemporaryDirectory() as folder:
        (Path(folder) / "arm_and_wall.py").write_text(code.removeprefix("python\n"))
        sys.path.append(folder)
        try:
            yield
        finally:
            sys.path.remove(folder)


def simulation() -> Iterator[Figure]:
    """Robot and object environments, all cores."""
    n_steps = 100  # two episodes: every copy resets twice
    subproc = SubprocVecEnv([partial(gym.make, OF_ROBOTICS)] * (2 * CORES))
    baselines = {
        "EnvPool FetchPickAndPlace-v4": envpool_rate(32, n_steps),
        "SubprocVecEnv FetchPickAndPlace-v4": vec_env_rate(subproc, n_steps),
    }
    ours = vec_env_rate(make_vec(ROBOT, 32, CORES), n_steps)
    yield "robot simulation", "env steps/s", ours, baselines
    subproc.close()
    with tutorial_module():
        for env_id, name in ((OF_ROBOTICS, f"{ORIGINAL} itself"), (ARM, "the tutorial's arm")):
            copies = robot_vec_env(import_task(env_id), OF_OTHERS, CORES)
            subproc = SubprocVecEnv([partial(gym.make, env_id)] * OF_OTHERS)
            yield (
                f"{OF_OTHERS} copies of {name}",
                "env steps/s",
                vec_env_rate(copies, n_steps),
                {"SubprocVecEnv": vec_env_rate(subproc, n_steps)},
            )
            copies.close()
            subproc.close()
    yield (
        "object simulation",
        "env steps/s",
        vec_env_rate(make_vec(OBJECT, 32, CORES), 200),
        {},
    )


def throughput(out: Path) -> list[dict[str, float]]:
    """Rate against the number of copies and threads; draws it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = []
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for n_threads in sorted({1, 2, CORES // 2 or 1, CORES}):
        rates = []
        copies = [1, 2, 4, 8, 16, 32, 64, 128]
        for n_envs in copies:
            env = make_vec(ROBOT, n_envs, n_threads)
            measure = vec_env_rate(env, max(50, 400 // n_envs))
            rates.append(median(measure() for _ in range(3)))
            env.close()
            rows.append({"n_envs": n_envs, "n_threads": n_threads, "steps_per_s": rates[-1]})
        axes.plot(copies, rates, marker="o", label=f"{n_threads} thread{'s' * (n_threads > 1)}")
    axes.set(xscale="log", xlabel="copies (n_envs)", ylabel="env steps/s", ylim=(0, None))
    axes.set_xticks(copies, [str(n) for n in copies])
    axes.legend()
    figure.savefig(out, dpi=120)
    return rows


# ---- replay --------------------------------------------------------------------------------------


def _fill(buffer: HerReplayBuffer, env: VecEnv, n_slots: int, horizon: int = 50) -> None:
    """Fill `n_slots` slots of every environment with random episodes."""
    rng = np.random.default_rng(0)
    shapes = {key: space.shape for key, space in env.observation_space.spaces.items()}  # type: ignore[attr-defined]
    obs = {key: rng.normal(size=(env.num_envs, *shape)) for key, shape in shapes.items()}
    action = rng.uniform(-1, 1, (env.num_envs, *env.action_space.shape))  # type: ignore[misc]
    reward, infos = -np.ones(env.num_envs), [{} for _ in range(env.num_envs)]
    for step in range(n_slots):
        done = np.full(env.num_envs, (step + 1) % horizon == 0)
        buffer.add(obs, obs, action, reward, done, infos)


def replay() -> Iterator[Figure]:
    """Drawing a batch of 4864 from 1e6 slots, relabelled."""
    n_envs, size, batch = 16, 1_000_000, 4864
    env = make_vec(ROBOT, n_envs, 1)
    buffers = []
    for buffer_class in (FollowObjectReplayBuffer, HerReplayBuffer):
        buffer = buffer_class(
            size,
            env.observation_space,
            env.action_space,
            env,
            "cpu",
            n_envs,  # type: ignore[arg-type]
        )
        _fill(buffer, env, size // n_envs)
        buffers.append(buffer)

    def draws(buffer: HerReplayBuffer, n: int) -> Measure:
        def measure() -> float:
            started = time.perf_counter()
            for _ in range(n):
                buffer.sample(batch)
            return n / (time.perf_counter() - started)

        return measure

    ours, theirs = buffers
    name = "replay sample, batch 4864 of 1e6"
    yield name, "batches/s", draws(ours, 50), {"HerReplayBuffer": draws(theirs, 10)}


def replay_bytes() -> dict[str, float]:
    """Bytes that a stored transition takes, in NumPy arrays."""
    env = make_vec(ROBOT, 1, 1)
    arguments = (1000, env.observation_space, env.action_space, env, "cpu", 1)
    ours = FollowObjectReplayBuffer(*arguments)  # type: ignore[arg-type]
    theirs = HerReplayBuffer(*arguments)  # type: ignore[arg-type]
    arrays = [v for v in vars(theirs).values() if isinstance(v, np.ndarray)]
    arrays += [*theirs.observations.values(), *theirs.next_observations.values()]
    return {
        "FollowObjectReplayBuffer": ours.bytes_per_transition(),
        "HerReplayBuffer": sum(array.nbytes for array in arrays) / 1000,
    }


# ---- learner -------------------------------------------------------------------------------------


def update_flops(batch: int, inputs: int, actions: int) -> float:
    """Multiply-add operations, times two, of one DDPG update with networks of HIDDEN."""

    def network(n_in: int, n_out: int) -> float:
        sizes = [n_in, *HIDDEN, n_out]
        return 2.0 * batch * sum(a * b for a, b in pairwise(sizes))

    actor, critic = network(inputs, actions), network(inputs + actions, 1)
    # Targets: one pass of each. Critic: forward, and backward for weights and for activations.
    # Actor: its own three, and the critic's forward and backward for activations.
    return (actor + critic) + 3.0 * critic + 3.0 * actor + 2.0 * critic


def matmul_rate(precision: str, device: str) -> float:
    """Floating-point operations a second of PyTorch's product of (rows, 256) with (256, 256)."""
    earlier = th.get_float32_matmul_precision()
    th.set_float32_matmul_precision(precision)
    n_rows = 1024 if device == "cpu" else 4864
    a, b = th.randn(n_rows, 256, device=device), th.randn(256, 256, device=device)
    rates = []
    for _ in range(20):
        started = time.perf_counter()
        for _ in range(20):
            th.mm(a, b)
        _synchronise(device)
        rates.append(20 * 2.0 * n_rows * 256 * 256 / (time.perf_counter() - started))
    th.set_float32_matmul_precision(earlier)
    return median(rates)


def _synchronise(device: str) -> None:
    """Wait for what a GPU was told to do."""
    if device != "cpu":
        th.cuda.synchronize()


def _learner(model: Any, batch: int, n: int) -> Measure:
    """Return a measure of gradient steps, `n` in a call as after a rollout."""
    model.set_logger(Logger(None, []))
    calls = 5 if model.device.type == "cuda" and isinstance(model, HerDDPG) else 1

    def measure() -> float:
        started = time.perf_counter()
        for _ in range(calls):
            model.train(n, batch)
        _synchronise(model.device.type)
        return calls * n / (time.perf_counter() - started)

    return measure


def _learners(device: str, n_stored: int) -> dict[str, Any]:
    """Stock DDPG + HER, the default preset, and that in bfloat16, with so much in their replay."""
    env = make_vec(ROBOT, 4 if device == "cpu" else 80, 1)
    entry = read_yaml(preset_file("her"))[ROBOT]
    kwargs = {
        key: value
        for key, value in entry.items()
        if key not in ("n_timesteps", "policy", "n_envs", "batch_size", "gradient_steps")
    }
    common = {"learning_starts": 10**9, "seed": 0, "device": device}
    plain = {"policy_kwargs": {"net_arch": HIDDEN}, "replay_buffer_class": HerReplayBuffer}
    models: dict[str, Any] = {
        "stock": DDPG("MultiInputPolicy", env, **plain, **common),  # type: ignore[arg-type]
        "default": HerDDPG("MultiInputPolicy", env, **{**kwargs, **common}),
        "bfloat16": HerDDPG(
            "MultiInputPolicy", env, **{**kwargs, **common, "matmul_precision": "medium"}
        ),
    }
    for model in models.values():
        model.learn(8_000, log_interval=None)
    for name in ("stock", "default"):
        _fill(models[name].replay_buffer, env, (n_stored - 8_000) // env.num_envs)
    if n_stored > 8_000:
        models["bfloat16"].replay_buffer = models["default"].replay_buffer
    return models


def learner(device: str = "cpu", n_stored: int = 8_000) -> Iterator[Figure]:
    """Whole updates, sampling included: default preset, its bfloat16 twin, against stock DDPG."""
    models = _learners(device, n_stored)
    for batch in (128, 256, 1024, 4864):
        n = max(3, 12_000 // batch) if device == "cpu" else 40  # the paper's in a cycle
        for variant in ("default", "bfloat16"):
            yield (
                f"update, batch {batch}, {variant}",
                "updates/s",
                _learner(models[variant], batch, n),
                {"stock SB3 DDPG": _learner(models["stock"], batch, n)},
            )


def gpu() -> Iterator[Figure]:
    """The same on CUDA, from replay as full as the paper's."""
    yield from learner("cuda", 1_000_000)


def arithmetic_share(figures: list[dict[str, Any]], device: str) -> None:
    """Add to each update the share of the time that its matrix products need by themselves."""
    env = make_vec(ROBOT, 1, 1)
    inputs = sum(env.observation_space[key].shape[0] for key in ("observation", "desired_goal"))
    variants = {"default": "highest", "bfloat16": "medium"}
    rates = {name: matmul_rate(precision, device) for name, precision in variants.items()}
    for figure in figures:
        if figure["name"].startswith("update"):
            variant = figure["name"].rsplit(" ", 1)[1]
            batch = int(figure["name"].split()[2].rstrip(","))
            seconds = update_flops(batch, inputs, 4) / rates[variant]
            figure["arithmetic_share"] = round(seconds * figure["ours"], 3)


# ---- running -------------------------------------------------------------------------------------


def compare(figure: Figure, rounds: int) -> list[dict[str, Any]]:
    """Alternate between ours and the baselines; one row for each baseline."""
    name, unit, ours, baselines = figure
    measures = {"ours": ours, **baselines}
    for measure in measures.values():
        measure()  # caches and threads warm up
    seen: dict[str, list[float]] = {key: [] for key in measures}
    for _ in range(rounds):
        for key, measure in measures.items():
            seen[key].append(measure())
    mine = median(seen["ours"])
    rows = []
    for key in baselines or {"": None}:
        theirs = median(seen[key]) if key else None
        rows.append(
            {
                "name": name,
                "unit": unit,
                "ours": round(mine, 1),
                "baseline": theirs and round(theirs, 1),
                "baseline_name": key or None,
                "ratio": theirs and round(mine / theirs, 2),
                "rounds": rounds,
            }
        )
    return rows


def _line(row: dict[str, Any]) -> str:
    """One line of the table."""
    line = f"{row['name']:34}{row['ours']:>12,.1f}"
    if row["ratio"] is None:
        return line
    return f"{line}  {row['baseline']:>12,.1f}  {row['ratio']:.2f}x {row['baseline_name']}"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def main() -> None:
    """Measure, print and write."""
    parts = {"simulation": simulation, "replay": replay, "learner": learner}
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", choices=[*parts, "gpu"], help="one part")
    parser.add_argument("--out", type=Path, help="file for the figures of one part")
    arguments = parser.parse_args()
    if arguments.out is not None and not arguments.only:
        parser.error("--out is for one part, with --only; all parts go to benchmarks/speed.json")
    chosen = [arguments.only] if arguments.only else list(parts)
    device = "cuda" if arguments.only == "gpu" else "cpu"

    figures: list[dict[str, Any]] = []
    print(f"{'figure':34}{'ours':>12}  {'baseline':>12}  ratio")
    th.set_num_threads(1)  # a run's own setting: the cores are shared out between runs
    for part in chosen:
        for figure in {**parts, "gpu": gpu}[part]():
            for row in compare(figure, arguments.rounds):
                figures.append(row)
                print(_line(row), flush=True)
    arithmetic_share(figures, device)
    report: dict[str, Any] = {
        "figures": figures,
        "versions": {name: _version(name) for name in PACKAGES},
        "machine": {"processor": _processor(), "cores": CORES, "python": platform.python_version()},
    }
    if device == "cuda":
        report["machine"]["gpu"] = th.cuda.get_device_name()
    out = arguments.out
    if not arguments.only:
        out = HERE / "speed.json"
        report["replay_bytes_per_transition"] = replay_bytes()
        report["throughput"] = throughput(HERE / "throughput.png")
    if out is not None:
        atomic_write(out, json.dumps(report, indent=2).encode() + b"\n")
        print(f"written to {out}")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(": ")[1] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    assert sb3_follow_object  # registers the environments
    main()
