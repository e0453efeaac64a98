"""Train a stock algorithm with rl_zoo3 as a user would, and test what comes out as `train` does.

    python benchmarks/stock_sb3.py --algo ddpg --env FollowObject/PnPShelf-v0 \
        --conf-file zoo_configs/ddpg.yml --steps 300000 --run runs/PnPShelf-sb3-ddpg-0

RUN then holds rl_zoo3's logs, the validations on original goals as evaluations.csv, and result.json
with the final test of 380 episodes. The object's stage is learned anew and counted. With --minutes
rl_zoo3 is interrupted then, as by Ctrl+C, and what it saves is tested. A row of benchmarks/results
is made of it by collect.py.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_follow_object.callbacks.rollout import Episodes, run_episodes
from sb3_follow_object.common.cache import CACHE_VARIABLE
from sb3_follow_object.common.seeds import stream_seed
from sb3_follow_object.runs.evaluation import evaluation_env
from sb3_follow_object.runs.run_folder import write_versions

EVAL_EVERY, EVAL_EPISODES, TEST_EPISODES = 20_000, 76, 380


def zoo_command(options: argparse.Namespace) -> list[str]:
    """Return rl_zoo3's own command line."""
    return [
        *(sys.executable, "-m", "rl_zoo3.train", "--gym-packages", "sb3_follow_object"),
        *("--algo", options.algo, "--env", options.env, "--conf-file", options.conf_file),
        *("-n", str(options.steps), "--seed", str(options.seed)),
        *("--num-threads", str(options.threads)),
        *("--eval-freq", str(EVAL_EVERY), "--eval-episodes", str(EVAL_EPISODES)),
        *("-f", str(options.run / "logs"), "--log-interval", "100"),
    ]


def train(options: argparse.Namespace) -> float:
    """Run rl_zoo3 and return the seconds that it took."""
    env = {**os.environ, CACHE_VARIABLE: str(options.run / "cache")}
    # A shell's background jobs ignore SIGINT, and would hand that on.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    began = time.monotonic()
    with open(options.run / "train.log", "w") as log:
        zoo = subprocess.Popen(zoo_command(options), env=env, stdout=log, stderr=log)
        try:
            failed = zoo.wait(options.minutes and 60 * options.minutes)
        except subprocess.TimeoutExpired:
            zoo.send_signal(signal.SIGINT)
            failed = zoo.wait()
    if failed:
        raise SystemExit(f"rl_zoo3 failed: see {options.run / 'train.log'}")
    return time.monotonic() - began


def last_told(run: Path, pattern: str) -> int:
    """Return the last number that the training's log says so, 0 where it does not."""
    told = re.findall(pattern, (run / "train.log").read_text(), re.MULTILINE)
    return int(told[-1]) if told else 0


def final_test(folder: Path, options: argparse.Namespace) -> tuple[Episodes, BaseAlgorithm]:
    """Test the last model as `sb3-follow-object train` tests its own."""
    env: VecEnv = evaluation_env(options.env, stream_seed(options.seed, "final test"), 1)
    statistics = folder / options.env.replace("/", "-") / "vecnormalize.pkl"
    if statistics.exists():
        env = VecNormalize.load(str(statistics), env)
        env.training = False
    file = folder / f"{options.env.replace('/', '-')}.zip"
    model = ALGOS[options.algo].load(file, env=env)
    episodes = run_episodes(
        lambda obs: model.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
        env,
        TEST_EPISODES,
    )
    env.close()
    return episodes, model


def validations(folder: Path, before: int) -> list[tuple[int, float]]:
    """Return rl_zoo3's evaluations: env steps, those of the object included, and success."""
    if not (folder / "evaluations.npz").exists():
        return []
    with np.load(folder / "evaluations.npz") as file:
        steps, success = file["timesteps"], file["successes"].mean(axis=1)
    return [(int(n) + before, float(rate)) for n, rate in zip(steps, success, strict=True)]


def result(options: argparse.Namespace, seconds: float) -> dict[str, Any]:
    """Return what result.json holds, after writing the validations."""
    (folder,) = (options.run / "logs" / options.algo).iterdir()
    before = last_told(options.run, r"^ +(\d+) env steps")
    episodes, model = final_test(folder, options)
    rows = [(n, rate, EVAL_EPISODES) for n, rate in validations(folder, before)]
    if not rows:  # interrupted before the first
        rows = [(model.num_timesteps + before, episodes.success_rate, TEST_EPISODES)]
    with open(options.run / "evaluations.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("env_steps", "success_rate", "episodes"))
        writer.writerows(rows)
    return {
        "task": options.env.removeprefix("FollowObject/").removesuffix("-v0"),
        "method": options.method or f"sb3-{options.algo}",
        "seed": options.seed,
        "env_steps": model.num_timesteps + before,
        "object_steps": before,
        "test_steps": last_told(options.run, r"test_steps +\| (\d+)"),
        "wall_s": round(seconds, 1),
        "success_rate": episodes.success_rate,
        "episodes": len(episodes.success),
        "command": shlex.join(["python", *sys.argv]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--algo", required=True, choices=("ddpg", "td3", "sac", "tqc"))
    parser.add_argument("--env", required=True)
    parser.add_argument("--conf-file", required=True)
    parser.add_argument("--steps", type=int, required=True, help="of the robot and its tests")
    parser.add_argument("--minutes", type=float, help="stop after so many, if steps are left")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch")
    parser.add_argument("--method", help="in the table; sb3-ALGO by default")
    parser.add_argument("--run", type=Path, required=True, help="a new folder")
    options = parser.parse_args()
    options.run.mkdir(parents=True)
    write_versions(options.run)
    seconds = train(options)
    row = result(options, seconds)
    (options.run / "result.json").write_text(json.dumps(row, indent=1) + "\n")
    print(f"{row['success_rate']:.3f} of {row['episodes']} after {row['env_steps']} env steps")


if __name__ == "__main__":
    main()
