"""Functions that make environments, or say their goals, get ids like any other."""

from __future__ import annotations

from typing import Any

import arm_and_wall
import gymnasium as gym
import numpy as np
import pytest
import toy
from gymnasium.wrappers import TimeLimit

from sb3_follow_object import fingertips
from sb3_follow_object.any_task import derived as deriving
from sb3_follow_object.any_task import registering
from sb3_follow_object.any_task.derived import derived
from sb3_follow_object.any_task.registering import registered
from sb3_follow_object.envs.robot_copies import ProcessVecEnv, robot_maker, robot_vec_env


@pytest.fixture(autouse=True)
def no_ids_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registering, "_GIVEN", {})


def make_my_arm() -> gym.Env:
    return TimeLimit(arm_and_wall.ArmAndWall(), 30)  # type: ignore[attr-defined]


def elsewhere(env: Any, obs: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return obs["achieved_goal"], obs["desired_goal"] + [0.0, 0.0, 0.1]


def near(achieved: np.ndarray, desired: np.ndarray) -> Any:
    return np.linalg.norm(achieved - desired, axis=-1) < 0.02


def test_a_function_gets_an_id_with_its_time_limit() -> None:
    env_id = registered(make_env=make_my_arm, object="box")
    assert env_id == "Followed/make_my_arm-v0"
    assert gym.spec(env_id).max_episode_steps == 30
    env = robot_maker(env_id)()
    assert env.get_wrapper_attr("followed_object") == "box"
    env.close()


def test_goals_of_an_id_are_what_the_functions_say() -> None:
    env_id = registered(arm_and_wall.ARM, goal=elsewhere, is_success=near)
    assert env_id == "Followed/ArmAndWall-v0"
    env = robot_maker(env_id)()
    obs, _ = env.reset(seed=0)
    assert obs["desired_goal"][2] == pytest.approx(0.125)
    assert obs["observation"].shape == (21,), "without the goals that it had before"
    assert env.get_wrapper_attr("is_success")(obs["desired_goal"], obs["desired_goal"])
    assert env.step(np.zeros(3))[1] == -1.0
    env.close()


class ZeroOne(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Pays 1 on the goal."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, *rest = super().step(action)
        return obs, reward + 1.0, *rest

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return super().compute_reward(achieved, desired, info) + 1.0


def test_an_objects_name_is_kept_where_rewards_are_shown_otherwise() -> None:
    env_id = registered(make_env=lambda: TimeLimit(ZeroOne(), 30), object="box")
    env = robot_maker(env_id)()
    env.reset(seed=0)
    assert env.get_wrapper_attr("shifted")
    assert env.get_wrapper_attr("followed_object") == "box"
    env.close()


def test_an_effector_is_told_at_the_observations_end() -> None:
    def elbow(env: Any) -> np.ndarray:
        return env.data.body("forearm").xpos

    env_id = registered(arm_and_wall.ARM, effector=elbow)
    env = robot_maker(env_id)()
    told = env.get_wrapper_attr("told_effector")
    assert told == (21, 22, 23)
    obs, _ = env.reset(seed=0)
    for action in (np.ones(3), -np.ones(3)):
        assert env.observation_space.contains(obs)
        np.testing.assert_allclose(obs["observation"][list(told)], elbow(env.unwrapped), atol=1e-7)
        obs = env.step(action)[0]
    env.close()


@pytest.mark.parametrize("env_id", [arm_and_wall.ARM, "FetchPush-v4"])
def test_an_id_with_functions_is_known_in_other_processes(
    env_id: str, capfd: pytest.CaptureFixture[str]
) -> None:
    env = robot_vec_env(registered(env_id, effector=fingertips), 4, 2)
    assert isinstance(env, ProcessVecEnv)
    env.reset()
    env.close()
    assert capfd.readouterr() == ("", "")


def test_an_id_alone_stays_what_it_is() -> None:
    assert registered("FetchPush-v4") == "FetchPush-v4"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({}, "give an environment's id, or make_env"),
        ({"env_id": "FetchPush-v4", "make_env": make_my_arm}, "give an environment's id, or make"),
        ({"make_env": toy.PointEnv}, "PointEnv-v0 does not say how long its episodes are"),
        ({"env_id": "Nowhere-v0", "object": "box"}, "there is no environment 'Nowhere-v0'"),
    ],
)
def test_what_cannot_be_meant_is_refused(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        registered(**arguments)


def pushed_arm() -> Any:
    return TimeLimit(arm_and_wall.ArmAndWall(), 50)


def test_the_same_functions_have_one_id_and_others_another() -> None:
    def made(size: int) -> Any:
        return lambda: TimeLimit(arm_and_wall.ArmAndWall(), size)

    first = registered(make_env=made(50))
    assert registered(make_env=made(50)) == first, "written anew in the same words"
    words = "def make():\n    return TimeLimit(Arm(), 50)\n"
    names = {"TimeLimit": TimeLimit, "Arm": arm_and_wall.ArmAndWall}
    cells = []
    for text in (words, "# A comment more.\n" + words, words.replace("50", "51")):
        exec(text, names)
        cells.append(registered(make_env=names["make"]))
    assert cells[0] == cells[1] != cells[2]
    other = registered(make_env=made(60))
    assert other != first
    assert gym.spec(first).max_episode_steps == 50 and gym.spec(other).max_episode_steps == 60
    assert registered(make_env=pushed_arm) == registered(make_env=pushed_arm)

    def near(achieved: Any, desired: Any) -> Any:
        return np.linalg.norm(achieved - desired, axis=-1) < 0.01

    judged = registered(arm_and_wall.ARM, is_success=near)
    assert judged != registered(arm_and_wall.ARM, is_success=lambda achieved, desired: False)
    assert judged == registered(arm_and_wall.ARM, is_success=near)
    with pytest.raises(ValueError, match="is another environment here"):
        registered(make_env=pushed_arm, named=first)


class Renamed(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """The same under another name."""


def test_what_is_registered_again_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[str] = []
    monkeypatch.setattr(deriving, "_LOOKED_AT", {})
    monkeypatch.setattr(deriving, "_look", lambda name, report: looks.append(name) or len(looks))
    kinds: list[dict[str, Any]] = [
        {"make_env": make_my_arm, "object": "box"},
        {"env_id": arm_and_wall.ARM, "is_success": near},
    ]
    for arguments in kinds:
        looks.clear()
        first = derived(registered(**arguments))
        assert derived(registered(**arguments)) == first == 1
    assert len(deriving._LOOKED_AT) == 2
    namespace = {"TimeLimit": TimeLimit, "Arm": arm_and_wall.ArmAndWall}
    exec("def made():\n    return TimeLimit(Arm(), 50)\n", namespace)
    looks.clear()
    ids = [registered(make_env=namespace["made"])]
    derived(ids[0])
    namespace["Arm"] = Renamed  # a notebook's cell above, run again
    ids.append(registered(make_env=namespace["made"]))
    derived(ids[1])
    assert ids[0] == ids[1] and looks == ids, "what it makes may be another"
    assert len(deriving._LOOKED_AT) == 3, "and what the old one was is forgotten"


def test_an_id_that_is_registered_with_another_length_is_looked_at_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(deriving, "_LOOKED_AT", {})
    monkeypatch.setattr(deriving, "_look", lambda name, report: gym.spec(name).max_episode_steps)
    told = []
    for horizon in (30, 40):
        gym.registry.pop("Again-v0", None)
        gym.register("Again-v0", arm_and_wall.ArmAndWall, max_episode_steps=horizon)  # type: ignore[attr-defined]
        told.append(derived("Again-v0"))
    assert told == [30, 40]


def test_ids_without_a_version_or_with_a_namespace_keep_their_name() -> None:
    for env_id in ("Unversioned", "mine/Spaced-v3"):
        gym.register(env_id, arm_and_wall.ArmAndWall, max_episode_steps=30)  # type: ignore[attr-defined]
    assert registered("Unversioned", object="box") == "Followed/Unversioned-v0"
    assert registered("mine/Spaced-v3", object="box") == "Followed/Spaced-v3"
