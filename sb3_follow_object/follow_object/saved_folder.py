"""The folder of a saved `FollowObject`: settings, what the object stage learned, training state."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from ..any_task.tasks import registered_horizon
from ..common.array_trees import load_tree, save_tree
from ..common.files import atomic_write
from ..envs.goal_envs import known_id
from ..imagination.goal_predictor import GoalPredictor
from ..object_stage.networks import FILE as OBJECT_NETWORKS
from ..object_stage.networks import ObjectNetworks
from ..settings.presets import SAVED_STATE
from ..settings.run_config import CONFIG

_FACE = "environment"
_SETTINGS, _PREDICTOR = "settings.json", "predictor"


@dataclass
class Saved:
    """What the folder holds.

    Attributes:
        settings: arguments of `FollowObject` by name, plain values.
        predictor: F_phi, if there is one.
        object_networks: of the object stage, if they are needed.
        state: `FollowObject.state_dict`.
        face: of an environment that came with functions (`face_of`); None of others, and in saves
            from before 0.2.
    """

    settings: dict[str, Any]
    predictor: GoalPredictor | None
    object_networks: ObjectNetworks | None
    state: dict[str, Any]
    face: dict[str, Any] | None = None


def write(folder: Path, saved: Saved) -> None:
    """Write a folder; files of an earlier save are replaced, or removed.

    Raises:
        ValueError: it is the folder of a run, whose files have the same names.
    """
    if (folder / CONFIG).exists():
        raise ValueError(f"{folder} is the folder of a run; save into another one")
    settings = json.dumps({**saved.settings, _FACE: saved.face}, indent=2).encode()
    folder.mkdir(parents=True, exist_ok=True)
    if saved.predictor is not None:
        saved.predictor.save(folder / _PREDICTOR)
    elif (folder / _PREDICTOR).exists():
        shutil.rmtree(folder / _PREDICTOR)
    if saved.object_networks is not None:
        saved.object_networks.save(folder / OBJECT_NETWORKS)
    else:
        (folder / OBJECT_NETWORKS).unlink(missing_ok=True)
    save_tree(folder / SAVED_STATE, saved.state)
    atomic_write(folder / _SETTINGS, settings)


def saved_id(folder: Path) -> str:
    """Return the id of the environment that a save is of; raises as `read`."""
    return str(json.loads((folder / _SETTINGS).read_text("utf-8"))["env_id"])


def read(folder: Path) -> Saved:
    """Read what `write` wrote.

    Raises:
        OSError, KeyError, RecursionError, TypeError, ValueError: it holds no save, or a damaged
            one.
    """
    settings = json.loads((folder / _SETTINGS).read_text("utf-8"))
    env_id = known_id(settings["env_id"])
    predictor = networks = None
    if (folder / _PREDICTOR).exists():
        predictor = GoalPredictor.load(folder / _PREDICTOR, env_id=env_id)
    if (folder / OBJECT_NETWORKS).exists():
        networks = ObjectNetworks.load(folder / OBJECT_NETWORKS, env_id=env_id)
    face = settings.pop(_FACE, None)
    return Saved(settings, predictor, networks, load_tree(folder / SAVED_STATE), face)


def face_of(env_id: str) -> dict[str, Any]:
    """Return what tells an environment from another that functions made, plain values."""
    env = gym.make(env_id)
    try:
        return {
            "class": type(env.unwrapped).__qualname__,
            "observation_space": str(env.observation_space),
            "action_space": str(env.action_space),
            "steps": registered_horizon(env_id),
        }
    finally:
        env.close()


def differing(saved: Mapping[str, Any], face: Mapping[str, Any]) -> str:
    """Say in which of its facts an environment differs from the one that was saved."""
    return ", ".join(
        f"{name} {face[name]} instead of {saved.get(name)}"
        for name in face
        if face[name] != saved.get(name)
    )
