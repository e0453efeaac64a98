"""Compare collision="reachable" with "full": same states, same actions, are the results bit-equal?

Every task is played by three behaviours, 200 episodes each by default: uniform random actions; a
script that goes to the object, pushes or grips it and carries it to the goal; and actions held at a
random corner of the action box, which drives the arm into itself and into its limits. Contacts that
"reachable" leaves out are looked for in the full model after every env step.

    python benchmarks/collision_equality.py     # writes collision_equality.json beside itself
    python benchmarks/collision_equality.py --episodes 5 --tasks PnPShelf --output -
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sb3_follow_object.envs import TASKS
from sb3_follow_object.envs.fetch import FetchSimulation
from sb3_follow_object.envs.scene import fetch_scene
from sb3_follow_object.envs.tasks import Task

BATCH = 20  # copies played side by side
Behaviour = Callable[[np.random.Generator, FetchSimulation, int], np.ndarray]


def random_actions(rng: np.random.Generator, simulation: FetchSimulation, step: int) -> np.ndarray:
    return rng.uniform(-1, 1, (simulation.n_envs, 4))


class TouchObject:
    """Go above or beside the object, down to it, close the fingers, move to the goal."""

    def __call__(
        self, rng: np.random.Generator, simulation: FetchSimulation, step: int
    ) -> np.ndarray:
        observations, objects = simulation.observe()
        if step == 0:
            beside = rng.uniform(-0.07, 0.07, (simulation.n_envs, 3))
            centred = rng.random(simulation.n_envs) < 0.5
            self.offset = np.where(centred[:, None], 0.0, beside)
        if step < 12:
            aim, fingers = objects + self.offset + [0.0, 0.0, 0.08], 1.0
        elif step < 18:
            aim, fingers = objects + self.offset, 1.0
        else:
            aim, fingers = objects if step < 22 else simulation.goals, -1.0
        actions = np.empty((simulation.n_envs, 4))
        actions[:, :3] = 6.0 * (aim - observations[:, :3])
        actions[:, 3] = fingers
        return np.clip(actions + rng.normal(0, 0.15, actions.shape), -1, 1)


class HoldCorner:
    """Hold a random corner of the action box for the whole episode, with a little noise."""

    def __call__(
        self, rng: np.random.Generator, simulation: FetchSimulation, step: int
    ) -> np.ndarray:
        if step == 0:
            self.corner = rng.choice([-1.0, 1.0], (simulation.n_envs, 4))
        return np.clip(self.corner + rng.normal(0, 0.2, self.corner.shape), -1, 1)


BEHAVIOURS: dict[str, Callable[[], Behaviour]] = {
    "random": lambda: random_actions,
    "touch": TouchObject,
    "corner": HoldCorner,
}


def compare(task: Task, behaviour: str, n_episodes: int, seed: int = 0) -> dict[str, Any]:
    """Play the same episodes with both models; count equal ones and contacts left out."""
    batch = min(BATCH, n_episodes)
    full = FetchSimulation(fetch_scene(task, "full"), batch)
    trimmed = FetchSimulation(fetch_scene(task, "reachable"), batch)
    rng = np.random.default_rng(seed)
    left_out: Counter[str] = Counter()
    steps_with_left_out = n_equal = n_steps = 0
    moved = []
    for _ in range(-(-n_episodes // batch)):
        for index in range(batch):
            draw = int(rng.integers(2**31))
            full.reset(index, np.random.default_rng(draw))
            trimmed.reset(index, np.random.default_rng(draw))
        equal = np.ones(batch, dtype=bool)
        start = full.read["object_pos"].copy()
        act = BEHAVIOURS[behaviour]()
        for step in range(task.horizon):
            actions = act(rng, full, step)
            full.step(actions)
            trimmed.step(actions)
            equal &= (full.read["qpos"] == trimmed.read["qpos"]).all(axis=1)
            equal &= (full.read["qvel"] == trimmed.read["qvel"]).all(axis=1)
            for data in full.data:
                pairs = left_out_contacts(full.scene.model, trimmed.scene.model, data)
                left_out.update(pairs)
                steps_with_left_out += bool(pairs)
        n_equal += int(equal.sum())
        n_steps += batch * task.horizon
        moved.append(np.linalg.norm(full.read["object_pos"] - start, axis=1) > 0.005)
    full.close()
    trimmed.close()
    return {
        "task": task.name,
        "behaviour": behaviour,
        "episodes": len(moved) * batch,
        "equal_episodes": n_equal,
        "episodes_object_moved": int(np.concatenate(moved).sum()),
        "env_steps": n_steps,
        "env_steps_with_left_out_contact": steps_with_left_out,
        "left_out_contacts": dict(left_out.most_common()),
    }


def left_out_contacts(
    full: mujoco.MjModel, trimmed: mujoco.MjModel, data: mujoco.MjData
) -> set[str]:
    """Pairs that touch in the full model and are not tested in the trimmed one."""
    pairs = set()
    for first, second in {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}:
        names = full.geom(first).name, full.geom(second).name
        bits = [_bits(trimmed, name) for name in names]
        if not (bits[0][0] & bits[1][1] or bits[1][0] & bits[0][1]):
            pairs.add(" x ".join(name.removeprefix("robot0:") for name in names))
    return pairs


def _bits(model: mujoco.MjModel, name: str) -> tuple[int, int]:
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    if geom < 0:
        return 0, 0
    return int(model.geom_contype[geom]), int(model.geom_conaffinity[geom])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=200, help="episodes a task and behaviour")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--output", default=str(Path(__file__).with_suffix(".json")))
    options = parser.parse_args()
    rows, start = [], time.process_time()
    for name in options.tasks:
        for behaviour in BEHAVIOURS:
            row = compare(TASKS[name], behaviour, options.episodes)
            rows.append(row)
            print(
                f"{name:20} {behaviour:7} equal {row['equal_episodes']}/{row['episodes']}, "
                f"object moved in {row['episodes_object_moved']}, steps with a left-out contact "
                f"{row['env_steps_with_left_out_contact']}/{row['env_steps']}",
                flush=True,
            )
            if options.output != "-":
                cpu = round(time.process_time() - start, 1)
                report = {"mujoco": mujoco.__version__, "cpu_s": cpu, "rows": rows}
                Path(options.output).write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
