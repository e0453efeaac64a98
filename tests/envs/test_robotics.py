"""Where Gymnasium-Robotics' own environments cannot run, one sentence says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sb3_follow_object import FollowObject
from sb3_follow_object.any_task import derived as derived_tasks
from sb3_follow_object.any_task.derived import derived
from sb3_follow_object.envs import make_vec, robotics
from sb3_follow_object.envs.goal_envs import check_task


def installed(monkeypatch: pytest.MonkeyPatch, **releases: str) -> None:
    def version(package: str) -> Any:
        return releases[package.replace("gymnasium-", "")]

    monkeypatch.setattr(robotics, "version", version)


def follow(env_id: str) -> Any:
    return FollowObject(env_id).learn(1)


@pytest.mark.parametrize("ask", [check_task, lambda env_id: make_vec(env_id, 1), derived, follow])
def test_its_environments_are_refused_from_mujoco_3_12_on(
    ask: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    installed(monkeypatch, mujoco="4.0.0", robotics="1.4.2")
    monkeypatch.setenv("SB3_FOLLOW_OBJECT_CACHE", str(tmp_path))
    monkeypatch.setattr(derived_tasks, "_LOOKED_AT", {})  # as in a new process
    with pytest.raises(ValueError) as error:
        ask("FetchPush-v4")
    assert str(error.value) == (
        "'FetchPush-v4' is gymnasium-robotics's own, and its 1.4.2 does not run with mujoco 4.0.0: "
        "pip install 'mujoco<3.12', or take a task of this package"
    )


@pytest.mark.parametrize(
    "releases",
    [
        {"mujoco": "3.11.0", "robotics": "1.4.2"},
        {"mujoco": "3.2.7", "robotics": "1.4.0"},
        {"mujoco": "4.0.0", "robotics": "1.4.3"},
        {"mujoco": "4.0.0", "robotics": "1.5.0"},
    ],
)
def test_all_else_is_let_through(releases: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, **releases)
    assert check_task("FetchPush-v4") == "FetchPush-v4"


def test_own_tasks_and_others_are_never_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, mujoco="4.0.0", robotics="1.4.2")
    for env_id in ("FollowObject/PnPShelf-v0", "CartPole-v1", "unknown"):
        robotics.check_robotics(env_id)
