"""What the first two stages leave in a run's folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..any_task.tasks import physics_of_task
from ..common.files import atomic_write
from ..follow_object.follow_object import FollowObject
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.predictor_files import FACTS_FILE
from ..object_stage.networks import FILE as OBJECT_FILE
from ..object_stage.networks import ObjectNetworks

PREDICTOR, OBJECT_STAGE = "predictor", "object_stage.json"


def save_object_stage(folder: Path, run: FollowObject, wall_s: float) -> None:
    """Keep what the object stage made and what it cost; the last file says that all are there."""
    stage = run.object_stage
    if stage.networks is not None:
        stage.networks.save(folder / OBJECT_FILE)
    if stage.predictor is not None:
        stage.predictor.save(folder / PREDICTOR)
    facts = {
        "object_steps": stage.steps,
        "policy_steps": stage.policy_steps,
        "object_success": stage.success,
        "wall_s": round(wall_s, 1),
    }
    atomic_write(folder / OBJECT_STAGE, json.dumps(facts).encode())


def load_object_stage(folder: Path, run: FollowObject, saved: Any) -> float | None:
    """Give a run what its folder's object stage made.

    Args:
        folder: of the run.
        run: is changed.
        saved: the checkpoint that the run goes on from, None without one.

    Returns:
        The seconds that the stage took; None where it has not ended.

    Raises:
        ValueError: a file is missing, damaged or for another task.
    """
    if not run.has_object_stage:
        return 0.0
    stage = run.object_stage
    path = folder / OBJECT_STAGE
    robot_has_begun = isinstance(saved, dict) and saved.get("stage") == "robot"
    if not path.exists() and not robot_has_begun:
        return None
    for needed, file, purpose in (
        (True, path, "says what it cost"),
        (run.imagine, folder / PREDICTOR / FACTS_FILE, "the robot's goals come from"),
        (stage.needs_networks, folder / OBJECT_FILE, "SLDR's reward reads"),
    ):
        if needed and not file.exists():
            raise ValueError(
                f"{file} of the finished object stage is missing, which {purpose}; "
                "put it back, or start another run"
            )
    if run.imagine:
        stage.use_predictor(GoalPredictor.load(folder / PREDICTOR, env_id=run.env_id))
    if stage.needs_networks:
        physics = physics_of_task(run.env_id)
        stage.networks = ObjectNetworks.load(folder / OBJECT_FILE, run.env_id, physics)
    try:
        facts = json.loads(path.read_text("utf-8"))
        # A stage that other runs share may have more than this one uses.
        stage.steps = int(facts["object_steps" if run.imagine else "policy_steps"])
        stage.success = float(facts["object_success"])
        return float(facts["wall_s"])
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} does not say what the object stage cost ({error})") from error
