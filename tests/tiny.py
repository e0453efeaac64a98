"""A predictor fitted in a moment, where `predictor="auto"` looks for one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_follow_object.envs import TASKS, physics_id
from sb3_follow_object.goal_predictor import GoalPredictor

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
    predictor.save(cache / TASK / facts["physics"])
