"""What the object stage makes, made in a moment, where `"auto"` looks for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_follow_object.any_task.tasks import kept_as
from sb3_follow_object.envs import TASKS, physics_id
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.object_stage.networks import FILE, ObjectNetworks

NAME = "PushSideGap"
TASK = f"FollowObject/{NAME}-v0"
HORIZON = TASKS[NAME].horizon


def cache_predictor(cache: Path) -> None:
    """Keep an F_phi of straight paths over the table in a cache folder."""
    rng = np.random.default_rng(0)
    start, goal = rng.uniform([1.2, 0.6, 0.42], [1.4, 0.9, 0.43], (2, 64, 3))
    share = np.linspace(0.0, 1.0, HORIZON + 1)[:, None]
    paths = start[:, None] + share * (goal - start)[:, None]
    facts = {"env_id": TASK, "physics": physics_id(TASK)}
    predictor = GoalPredictor.fit(paths, goal, hidden=(16,), epochs=3, **facts)
    predictor.save(cache / TASK / kept_as(TASK))


def tiny_networks(env_id: str = TASK) -> ObjectNetworks:
    """Object networks that have learned nothing."""
    return ObjectNetworks(env_id, physics_id(env_id), pi=[8], qf=[8], inverse=[8])


def cache_networks(cache: Path) -> None:
    """Keep object networks in a cache folder."""
    folder = cache / TASK / kept_as(TASK)
    folder.mkdir(parents=True, exist_ok=True)
    tiny_networks().save(folder / FILE)
