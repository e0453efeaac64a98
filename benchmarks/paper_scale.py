"""Train at the paper's scale on a GPU and say where the time went.

    python benchmarks/paper_scale.py --run runs/paper-scale --out benchmarks/paper_scale.json

The paper's robot takes 9.5 million training steps and 200,000 updates of 4,864 transitions. This
takes as many with the default preset, in larger cycles: of --n-envs episodes instead of 38, and as
many updates for each training step. The run folder is that of `sb3-follow-object train`; the
seconds are those of this call, also where it goes on with a run that was stopped.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.common.files import atomic_write
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs.batch import BatchedSimulation
from sb3_follow_object.object_stage.stage import ObjectStage
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.runs.run_callbacks import CheckpointCallback
from sb3_follow_object.runs.run_folder import CONFIG, RESULT
from sb3_follow_object.settings.presets import parse_override, run_config

TRAINING_STEPS, UPDATES, BATCH = 9_500_000, 200_000, 4_864
COMMAND = shlex.join(["python", "benchmarks/paper_scale.py", *sys.argv[1:]])

UPDATES_OF_ROBOT = "robot's updates"
OBJECT = "object's policy", "object's paths and F_phi"
PARTS: list[tuple[str, type, str]] = [
    (OBJECT[0], ObjectStage, "_train"),
    (OBJECT[1], ObjectStage, "learn_predictor"),
    ("robot's rollouts besides physics", HerDDPG, "collect_rollouts"),
    ("robot's physics", BatchedSimulation, "step"),
    (UPDATES_OF_ROBOT, HerDDPG, "train"),
    ("tests of the curriculum", CurriculumCallback, "_test"),
    ("validations", OriginalGoalEvalCallback, "_on_rollout_end"),
    ("checkpoints", CheckpointCallback, "write"),
]
WHOLE = ("tests of the curriculum", "validations", OBJECT[0])  # with the physics in them


class Clock:
    """Seconds in each part, those of parts inside it left out; and the robot's updates so far."""

    def __init__(self) -> None:
        self.updates = 0
        self.seconds = {name: 0.0 for name, _, _ in PARTS}
        self._open: list[tuple[str, float]] = []  # parts, and the seconds of those inside
        for name, owner, method in PARTS:
            setattr(owner, method, self._timed(name, getattr(owner, method)))

    def _timed(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(*args: Any, **kwargs: Any) -> Any:
            around = self._open[-1][0] if self._open else None
            if around in WHOLE or (around == OBJECT[1] and name != OBJECT[0]):
                return method(*args, **kwargs)
            started = time.perf_counter()
            self._open.append((name, 0.0))
            try:
                return method(*args, **kwargs)
            finally:
                if name == UPDATES_OF_ROBOT:
                    self.updates = args[0]._n_updates
                spent = time.perf_counter() - started
                self.seconds[name] += spent - self._open.pop()[1]
                if self._open:
                    outer, inside = self._open[-1]
                    self._open[-1] = outer, inside + spent

        return call


def main() -> None:
    """Train, then write the seconds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--env", default="FollowObject/PnPSimpleV2-v0")
    parser.add_argument("--run", type=Path, required=True, help="run folder")
    parser.add_argument("--out", type=Path, help="JSON file for the seconds")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--n-envs", type=int, default=304)
    parser.add_argument("--training-steps", type=int, default=TRAINING_STEPS)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()

    horizon = gym.spec(arguments.env).max_episode_steps
    assert horizon is not None
    cycle = arguments.n_envs * horizon
    n_cycles = -(-arguments.training_steps // cycle)
    updates = round(UPDATES * arguments.training_steps / TRAINING_STEPS)
    overrides: dict[str, Any] = {
        "n_envs": arguments.n_envs,
        "batch_size": BATCH,
        "gradient_steps": -(-updates // n_cycles),
        "torch_threads": 1,  # what is large is done on the GPU; the cores simulate
        "test_every": 8,
        "eval_every": 500_000,
        "checkpoint_minutes": 5.0,
    }
    overrides |= dict(parse_override(setting) for setting in arguments.set)
    # The object's steps and the tests' are counted too: they come on top.
    overrides.setdefault("n_timesteps", round(1.08 * arguments.training_steps))
    config = run_config(arguments.env, seed=arguments.seed, overrides=overrides)
    if (arguments.run / RESULT).exists():
        parser.error(f"{arguments.run} is finished: there is nothing to time")
    clock = Clock()
    started = time.perf_counter()
    result = train(
        config,
        arguments.run,
        resume=(arguments.run / CONFIG).exists(),
        command=COMMAND,
    )
    wall = time.perf_counter() - started
    clock.seconds["all else, the final test in it"] = wall - sum(clock.seconds.values())
    steps = result["env_steps"] - result["object_steps"] - result["test_steps"]
    report = {
        "task": result["task"],
        "seed": result["seed"],
        "success_rate": result["success_rate"],
        "episodes": result["episodes"],
        "env_steps": result["env_steps"],
        "object_steps": result["object_steps"],
        "test_steps": result["test_steps"],
        "training_steps": steps,
        "updates": clock.updates,
        "batch_size": config.settings["algorithm"]["batch_size"],
        "seconds": round(wall, 1),
        "seconds_of_parts": {name: round(value, 1) for name, value in clock.seconds.items()},
        "command": COMMAND,
        "machine": {
            "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "torch": th.__version__,
        },
    }
    print(json.dumps(report, indent=2))
    if arguments.out is not None:
        atomic_write(arguments.out, json.dumps(report, indent=2).encode() + b"\n")


if __name__ == "__main__":
    main()
