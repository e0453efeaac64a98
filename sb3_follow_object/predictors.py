"""F_phi for whoever needs one: the first two stages alone, and a cache of their results."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .config import run_config
from .envs import physics_id
from .experiment import RunConfig
from .follow_object import FollowObject, Report
from .goal_predictor import FACTS_FILE, GoalPredictor
from .object_networks import FILE as OBJECT_FILE
from .object_networks import ObjectNetworks

CACHE_VARIABLE = "SB3_FOLLOW_OBJECT_CACHE"


def get_predictor(
    env_id: str, folder: str | os.PathLike[str] | None = None, report: Report = print
) -> GoalPredictor:
    """Return a task's F_phi, learned with the default settings the first time it is asked for.

    Args:
        env_id: a task of this package.
        folder: where the predictor is kept; by default a folder for this task and its physics in
            $SB3_FOLLOW_OBJECT_CACHE or in the user's cache.
        report: called with a sentence now and then while it is learned, which takes minutes.

    Raises:
        ValueError: the folder holds a predictor for another task or other physics, or a damaged
            one; or the id is not of this package.
    """
    path = _kept(FACTS_FILE, env_id, folder, report)
    return GoalPredictor.load(path.parent, env_id=env_id, physics=physics_id(env_id))


def get_object_networks(
    env_id: str, folder: str | os.PathLike[str] | None = None, report: Report = print
) -> ObjectNetworks:
    """Return what SLDR needs of a task's object stage; kept beside F_phi, see `get_predictor`."""
    path = _kept(OBJECT_FILE, env_id, folder, report)
    return ObjectNetworks.load(path, env_id=env_id, physics=physics_id(env_id))


def _kept(name: str, env_id: str, folder: str | os.PathLike[str] | None, report: Report) -> Path:
    """Return a file of a task's first two stages, which run unless it is there already."""
    path = cache_folder() / env_id / physics_id(env_id) if folder is None else Path(folder)
    with _lock(path):
        if not (path / name).exists():
            learn_predictor(run_config(env_id), path, report)
    return path / name


def learn_predictor(
    config: RunConfig, folder: str | os.PathLike[str], report: Report = print
) -> GoalPredictor:
    """Run stages one and two (paper, sections 4.1 and 4.2) and save what they learn in a folder."""
    run = FollowObject(
        config.env_id, seed=config.seed, report=report, **{**config.settings, "n_envs": 1}
    )
    try:
        predictor = run.learn_predictor()
    finally:
        run.close()
    assert run.object_networks is not None
    predictor.save(folder)
    run.object_networks.save(Path(folder) / OBJECT_FILE)
    return predictor


def cache_folder() -> Path:
    """Return the folder that predictors are kept in; it need not exist."""
    if CACHE_VARIABLE in os.environ:
        return Path(os.environ[CACHE_VARIABLE])
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "sb3_follow_object"


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Let one process at a time look for a predictor: those of a SubprocVecEnv come together."""
    try:
        import fcntl
    except ImportError:  # not POSIX: two may then learn the same predictor
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # ends with the process, however that ends
        yield
