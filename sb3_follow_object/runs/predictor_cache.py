"""F_phi for whoever needs one: the first two stages alone, and a cache of their results."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

from ..any_task.derived import derived
from ..any_task.tasks import kept_as, physics_of_task, surface_choices
from ..common.cache import CACHE_VARIABLE as CACHE_VARIABLE
from ..common.cache import SET_THE_VARIABLE, cache_folder
from ..common.files import lock
from ..common.reports import Report
from ..common.torch_helpers import threads_at
from ..envs import IDS
from ..envs.registration import import_task
from ..follow_object.checks import check_object_stage
from ..follow_object.follow_object import FollowObject
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.predictor_files import FACTS_FILE
from ..object_stage.networks import FILE as OBJECT_FILE
from ..object_stage.networks import ObjectNetworks
from ..settings.fields import settings_of
from ..settings.presets import run_config
from ..settings.run_config import RunConfig
from ..settings.stages import StageSettings

# The settings that the first two stages read.
OF_OBJECT_STAGE = tuple(
    name
    for name in settings_of(StageSettings)
    if name.startswith("object_") or name.endswith("_fit") or name in ("n_paths", "n_threads")
)
_FILES = (FACTS_FILE, OBJECT_FILE)


def get_predictor(
    env_id: str, folder: str | os.PathLike[str] | None = None, report: Report = print
) -> GoalPredictor:
    """Return a task's F_phi, learned with the default settings the first time it is asked for.

    Args:
        env_id: a task of this package, or any other whose object can be followed; "module:" may
            stand before it, and what is kept is the same.
        folder: where the predictor is kept; by default a folder for this task and its physics in
            $SB3_FOLLOW_OBJECT_CACHE or in the user's cache. What is there is read, not written.
        report: called with a sentence now and then while it is learned, which takes minutes.

    Raises:
        ValueError: the folder holds a predictor for another task, other physics or another
            object_on_table, a damaged one, or an object's networks alone; it holds none and cannot
            be written; or the task's object cannot be followed.
    """
    env_id = import_task(env_id)
    if env_id not in IDS:
        derived(env_id, report)
    path = _kept(FACTS_FILE, env_id, folder, report)
    choices = surface_choices(env_id)
    on_table = choices[0] if len(choices) == 1 else None  # else the object's learning has decided
    physics = physics_of_task(env_id)
    return GoalPredictor.load(path.parent, env_id=env_id, physics=physics, object_on_table=on_table)


def kept_predictor(env_id: str) -> GoalPredictor | None:
    """Return the F_phi that `get_predictor` has kept for a task; None, there is none yet.

    Raises:
        ValueError: the task's object cannot be followed, or what is kept is damaged.
    """
    env_id = import_task(env_id)
    folder = cache_folder() / env_id / kept_as(env_id)
    if not (folder / FACTS_FILE).exists():
        return None
    return GoalPredictor.load(folder, env_id=env_id, physics=physics_of_task(env_id))


def get_object_networks(
    env_id: str, folder: str | os.PathLike[str] | None = None, report: Report = print
) -> ObjectNetworks:
    """Return what SLDR needs of a task's object stage; kept beside F_phi, see `get_predictor`.

    Raises:
        ValueError: as `get_predictor`; the folder holds F_phi alone, which is not replaced; or the
            task is not one of this package, whose networks alone SLDR can read.
    """
    env_id = import_task(env_id)
    if env_id not in IDS:
        raise ValueError(
            f"{env_id!r} is not a task of this package; SLDR reads an object's networks in no other"
        )
    path = _kept(OBJECT_FILE, env_id, folder, report)
    return ObjectNetworks.load(path, env_id=env_id, physics=physics_of_task(env_id))


def _kept(name: str, env_id: str, folder: str | os.PathLike[str] | None, report: Report) -> Path:
    """Return a file of a task's first two stages, which run unless it is there already."""
    if folder is None:
        path = cache_folder() / env_id / kept_as(env_id)
    else:
        path = Path(folder).expanduser()
    if (path / name).exists():  # whole, since files take their names so: reading needs no lock
        return path / name
    with ExitStack() as held:
        try:
            path.mkdir(parents=True, exist_ok=True)
            held.enter_context(lock(path, wait=True))  # those of a SubprocVecEnv come together
        except OSError as error:
            raise ValueError(
                f"{path} holds no {name} and cannot be written ({error.strerror or error}); "
                + ("give another folder" if folder is not None else SET_THE_VARIABLE)
            ) from error
        if not (path / name).exists():
            other = next((file for file in _FILES if (path / file).exists()), None)
            if folder is not None and other is not None:
                raise ValueError(f"{path} has {other} but no {name}; give an empty folder")
            learn_predictor(run_config(env_id), path, report)
    return path / name


def learn_predictor(
    config: RunConfig, folder: str | os.PathLike[str], report: Report = print
) -> GoalPredictor:
    """Run stages one and two (paper, sections 4.1 and 4.2) and save what a folder lacks of both.

    Raises:
        ValueError: the object's algorithm cannot be built with these settings.
    """
    folder = Path(folder)

    def keep(predictor: GoalPredictor) -> None:
        if not (folder / FACTS_FILE).exists():  # others may be reading it
            predictor.save(folder)

    run = FollowObject(
        config.env_id,
        preset=None,
        seed=config.seed,
        report=report,
        **{**config.settings, "n_envs": 1},
    )
    try:
        check_object_stage(run.settings, run.horizon, needs_networks=False)
        with threads_at(1):
            predictor = run.object_stage.learn_predictor(networks=True, keep=keep)
    finally:
        run.close()
    networks = run.object_stage.networks
    if networks is not None and not (folder / OBJECT_FILE).exists():
        networks.save(folder / OBJECT_FILE)
    return predictor
