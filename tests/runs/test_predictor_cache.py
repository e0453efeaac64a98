"""The cache of F_phi: read without a write, made once, and found where its variable says."""

from __future__ import annotations

import errno
import fcntl
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from read_only import read_only_copy
from tiny import HORIZON, TASK, cache_networks, cache_predictor, tiny_networks
from tiny_runs import SMALL_NET, config, quiet

from sb3_follow_object.common.files import lock
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.predictor_files import FACTS_FILE
from sb3_follow_object.object_stage.networks import FILE as OBJECT_FILE
from sb3_follow_object.object_stage.networks import ObjectNetworks
from sb3_follow_object.object_stage.stage import ObjectStage
from sb3_follow_object.runs import predictor_cache
from sb3_follow_object.runs.predictor_cache import (
    CACHE_VARIABLE,
    cache_folder,
    get_object_networks,
    get_predictor,
    kept_predictor,
    learn_predictor,
)
from sb3_follow_object.settings.run_config import RunConfig


@pytest.fixture
def never_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise AssertionError("the object stage was run")

    monkeypatch.setattr(predictor_cache, "learn_predictor", fail)


@pytest.mark.usefixtures("never_learned")
def test_what_a_read_only_cache_holds_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache_predictor(tmp_path)
    cache_networks(tmp_path)
    before = {path.name for path in tmp_path.rglob("*")}
    with read_only_copy(tmp_path) as cache:
        monkeypatch.setenv(CACHE_VARIABLE, str(cache))
        assert get_predictor(TASK).env_id == TASK
        assert get_object_networks(TASK).env_id == TASK
        (folder,) = (cache / TASK).iterdir()
        assert get_predictor(TASK, folder).env_id == TASK
        assert {path.name for path in cache.rglob("*")} == before


@pytest.mark.usefixtures("never_learned")
@pytest.mark.parametrize("kept", [None, "folder"])
def test_a_module_before_the_id_is_the_same_task(
    kept: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache_predictor(tmp_path)
    cache_networks(tmp_path)
    (folder,) = (tmp_path / TASK).iterdir()
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "empty" if kept else tmp_path))
    full_id, given = f"sb3_follow_object:{TASK}", folder if kept else None
    assert get_predictor(full_id, given).env_id == TASK
    assert get_object_networks(full_id, given).env_id == TASK
    predictor = kept_predictor(full_id)
    assert predictor is None if kept else predictor is not None and predictor.env_id == TASK


@pytest.mark.usefixtures("never_learned")
def test_a_read_only_cache_without_the_file_is_refused_before_anything_is_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache_networks(tmp_path)
    with read_only_copy(tmp_path) as cache:
        monkeypatch.setenv(CACHE_VARIABLE, str(cache))
        for env_id in (TASK, "FollowObject/PnPShelf-v0"):  # a folder is there, and is not
            with pytest.raises(ValueError) as error:
                get_predictor(env_id)
            assert str(error.value).startswith(f"{cache / env_id}/")
            assert str(error.value).endswith(
                f"holds no {FACTS_FILE} and cannot be written (Permission denied); "
                f"set {CACHE_VARIABLE} to a folder that can be written"
            )
        with pytest.raises(ValueError, match=r"cannot be written .*; give another folder"):
            get_predictor(TASK, cache / "mine")


def test_makers_that_come_together_learn_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    learned = []

    def learn(config: Any, folder: Path, report: Any) -> None:
        learned.append(config.env_id)
        time.sleep(0.3)
        cache_predictor(tmp_path)

    monkeypatch.setattr(predictor_cache, "learn_predictor", learn)
    with ThreadPoolExecutor(4) as pool:
        predictors = list(pool.map(get_predictor, [TASK] * 4))
    assert learned == [TASK]
    assert [predictor.env_id for predictor in predictors] == [TASK] * 4


def test_learning_what_is_missing_leaves_what_others_may_be_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache_predictor(tmp_path)
    (folder,) = (tmp_path / TASK).iterdir()
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}

    class Stage:
        networks = tiny_networks()

        def learn_predictor(self, networks: bool, keep: Any) -> GoalPredictor:
            predictor = GoalPredictor.load(folder)
            keep(predictor)
            return predictor

    class Run:
        def __init__(self, *arguments: Any, **settings: Any) -> None:
            self.object_stage = Stage()
            self.settings, self.horizon = settings, HORIZON

        def close(self) -> None:
            pass

    monkeypatch.setattr(predictor_cache, "FollowObject", Run)
    monkeypatch.setattr(predictor_cache, "check_object_stage", lambda *_, **options: None)
    monkeypatch.setattr(GoalPredictor, "save", lambda *arguments: pytest.fail("written over"))
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    assert get_object_networks(TASK).env_id == TASK
    assert (folder / OBJECT_FILE).exists()
    assert {name: (folder / name).read_bytes() for name in kept} == kept


def folding(mirror: dict[str, Any]) -> RunConfig:
    """A tiny run whose object's policy has a mirror."""
    algorithm = {**SMALL_NET, "policy_kwargs": {"net_arch": [8], "mirrors": [mirror]}}
    return config(settings={"object_algorithm": algorithm})


def test_an_object_that_sldr_cannot_read_has_f_phi_alone(tmp_path: Path) -> None:
    said: list[str] = []
    learn_predictor(folding({"axis": 0, "at": 1.3}), tmp_path, said.append)
    assert GoalPredictor.load(tmp_path).env_id == TASK
    assert not (tmp_path / OBJECT_FILE).exists()
    assert "object's networks are left out: SLDR's reward reads an object's policy" in said[-1]


def test_f_phi_is_kept_before_the_networks_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **settings: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(ObjectNetworks, "learned", fail)
    with pytest.raises(MemoryError):
        learn_predictor(config(), tmp_path, quiet)
    assert GoalPredictor.load(tmp_path).env_id == TASK


def test_an_object_that_cannot_be_trained_is_refused_before_it_learns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ObjectStage, "learn_predictor", lambda *_, **options: pytest.fail("learns"))
    with pytest.raises(ValueError, match="mirror"):
        learn_predictor(folding({"axis": 0, "at": 1.3, "actions": [99]}), tmp_path, quiet)


@pytest.mark.usefixtures("never_learned")
def test_networks_are_of_this_packages_tasks_alone() -> None:
    with pytest.raises(ValueError, match="'FetchPush-v4' is not a task of this package; SLDR"):
        get_object_networks("FetchPush-v4")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("", "home/.cache/sb3_follow_object"),
        ("  ", "home/.cache/sb3_follow_object"),
        ("~", "home"),
        ("~/goals", "home/goals"),
    ],
)
def test_the_variable_is_read_as_a_shell_would(
    value: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv(CACHE_VARIABLE, value)
    for ignored in ("", "~/.cache", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", ignored)
        assert cache_folder() == tmp_path / expected
    if not value.strip():
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
        assert cache_folder() == tmp_path / "xdg" / "sb3_follow_object"
    monkeypatch.setenv(CACHE_VARIABLE, "here/goals")
    assert cache_folder() == Path("here/goals")


def test_without_a_home_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, "~no-such-user/goals")
    with pytest.raises(ValueError, match=f"no home folder .*; set {CACHE_VARIABLE} to a folder"):
        cache_folder()


def test_a_file_system_without_locks_is_worked_in_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(number: int) -> Any:
        def flock(*arguments: Any) -> None:
            raise OSError(number, "as the file system says")

        return flock

    monkeypatch.setattr(fcntl, "flock", refuse(errno.ENOLCK))
    with lock(tmp_path, wait=True):
        pass
    monkeypatch.setattr(fcntl, "flock", refuse(errno.EIO))
    with pytest.raises(OSError, match="as the file system says"), lock(tmp_path, wait=True):
        pass
