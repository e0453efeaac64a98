"""What stands elsewhere in each episode is seen where the object's way depends on it, else not."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import moving_wall
import mujoco
import numpy as np
import pytest
from scenes import kitchen

from sb3_follow_object.any_task import derived as module
from sb3_follow_object.any_task.context import context_of, located, read_context
from sb3_follow_object.any_task.derived import derived
from sb3_follow_object.any_task.resets import Resets
from sb3_follow_object.any_task.simulation import DerivedObjectVecEnv
from sb3_follow_object.any_task.tasks import kept_as, physics_of_task, what_is_followed
from sb3_follow_object.common.cache import CACHE_VARIABLE

N = 40


@pytest.fixture(autouse=True)
def few_resets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(module, "N_RESETS", 60)
    monkeypatch.setattr(module, "_LOOKED_AT", {})


def kitchen_resets(**moved: Any) -> tuple[mujoco.MjModel, Resets]:
    """Episodes in the kitchen, whose mug has random starts and goals.

    Args:
        moved: body -> a function of (generator, start, goal) -> position, maybe with a quaternion.
    """
    model, data = kitchen()
    rng = np.random.default_rng(0)
    starts, goals = rng.uniform(-0.2, 0.2, (2, N, 3))
    places = np.tile(np.concatenate([data.xpos, data.xquat], axis=1), (N, 1, 1))
    for name, place in moved.items():
        body = model.body(name.replace("_", " ")).id
        for row, start, goal in zip(places, starts, goals, strict=True):
            told = np.ravel(place(rng, start, goal))
            row[body, : len(told)] = told
    return model, Resets(goals, starts, np.zeros((N, model.nq)), np.zeros((N, model.nv)), places)


def anywhere(rng: np.random.Generator, start: np.ndarray, goal: np.ndarray) -> Any:
    return [*rng.uniform(-0.2, 0.2, 2), 0.1]


def turned(rng: np.random.Generator, start: np.ndarray, goal: np.ndarray) -> Any:
    angle = rng.uniform(-1.5, 1.5)
    return [0.1, 0.2, 0.3, np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]


def seen(**moved: Any) -> tuple[str, ...]:
    model, resets = kitchen_resets(**moved)
    return context_of(model, resets, model.body("mug").id)


def test_what_stands_anywhere_is_seen_by_what_varies_of_its_place() -> None:
    assert seen() == ()
    assert seen(shelf=anywhere) == ("shelf x", "shelf y")
    assert seen(drawer=anywhere) == ("drawer x", "drawer y"), "what can move is seen, too"


def test_a_thing_that_turns_is_seen_by_its_axes() -> None:
    assert seen(shelf=turned) == ("shelf xx", "shelf xy"), "the other axis follows from these"


def test_what_follows_from_start_and_goal_is_not_seen() -> None:
    assert seen(shelf=lambda rng, start, goal: goal - [0.0, 0.1, 0.2]) == ()
    assert seen(shelf=lambda rng, start, goal: (start + goal) / 2) == ()
    assert seen(shelf=lambda rng, start, goal: [goal[0], rng.uniform(), 0.0]) == ("shelf y",)


def test_parts_that_are_moved_together_are_seen_once() -> None:
    place: list[np.ndarray] = []

    def first(*known: Any) -> Any:
        place.append(np.array(anywhere(*known)))
        return place[-1]

    def beside(*known: Any) -> Any:
        return place.pop(0) + np.array([0.1, 0.0, 0.3])

    assert seen(bench=first, shelf=beside) == ("bench x", "bench y")


def test_what_cannot_be_touched_the_robot_and_the_object_are_not_seen() -> None:
    model, _ = kitchen()
    assert not model.geom_contype[model.body("cabinet").geomadr[0]]
    assert seen(cabinet=anywhere, arm=anywhere, mug=turned, grip=turned, puller=anywhere) == ()


def test_a_tenth_of_a_millimetre_does_not_matter() -> None:
    def settled(rng: np.random.Generator, start: np.ndarray, goal: np.ndarray) -> Any:
        return rng.normal(0.3, 1e-4, 3)

    assert seen(empty_root=settled, load=settled) == ()


def test_the_object_sees_the_wall_that_stands_elsewhere_in_each_of_its_episodes() -> None:
    found = derived(moving_wall.WALL)
    assert found.varying == ("wall", "paint", "target")
    assert found.context == ("wall x", "wall y")
    env = DerivedObjectVecEnv(found.scene, 4, 1, seed=0)
    obs = env.reset()["observation"]
    assert obs.shape == (4, 14) and env.observation_space["observation"].shape == (14,)  # type: ignore[index]
    wall = env.simulation.scene.model.body("wall").id
    stands = np.array([data.xpos[wall, :2] for data in env.data])
    assert len(np.unique(stands)) == 8
    np.testing.assert_array_equal(obs[:, 12:], stands)
    for _ in range(3):
        obs = env.step(np.ones((4, 7)))[0]["observation"]
    np.testing.assert_array_equal(obs[:, 12:], stands)
    twin = copy.deepcopy(env)
    actions = np.full((4, 7), 0.3)
    np.testing.assert_array_equal(
        twin.step(actions)[0]["observation"], env.step(actions)[0]["observation"]
    )
    env.close()


def test_an_environment_is_read_without_a_trace_though_its_places_are_stale() -> None:
    env: Any = gym.make(moving_wall.WALL)
    env.reset(seed=3)
    data = env.unwrapped.data
    before = data.xpos.copy()
    assert not np.allclose(before[env.unwrapped.model.body("wall").id, :2], env.unwrapped.wall())
    read = read_context(("wall y", "wall x"), env)
    np.testing.assert_allclose(read, env.unwrapped.wall()[::-1], atol=1e-12)
    np.testing.assert_array_equal(data.xpos, before)
    assert read_context((), gym.make("CartPole-v1")).shape == (0,), "nothing is looked for"
    env.close()


def test_bodies_without_a_name_are_found_by_their_number() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body/><body/></worldbody></mujoco>")
    bodies, numbers = located(["body 2 x", "body 1 z"], model)
    assert bodies.tolist() == [2, 1] and numbers.tolist() == [0, 2]


def test_a_body_that_is_not_there_is_named() -> None:
    model, _ = kitchen()
    with pytest.raises(ValueError, match=r"sees the place of shelf, wall, but .* no body 'wall'"):
        located(["shelf x", "wall x", "wall y"], model)


def test_what_is_found_is_said_and_kept_apart_from_what_was_learned_without_it() -> None:
    assert what_is_followed(moving_wall.WALL).endswith("nu and F_phi also see the place of wall")
    physics = physics_of_task(moving_wall.WALL)
    assert kept_as(moving_wall.WALL).startswith(f"{physics}-")
    assert kept_as("FollowObject/PnPShelf-v0") == physics_of_task("FollowObject/PnPShelf-v0")
