"""F_phi that sees where things stand imagines a way round them, wherever environments run."""

from __future__ import annotations

import json
import pickle
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import moving_wall
import numpy as np
import pytest
from small_buffers import fill
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_follow_object.envs.robot_copies import ProcessVecEnv, robot_maker
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.imagined_goals import ahead, draw_goals, imagine
from sb3_follow_object.imagination.predictor_files import FACTS_FILE
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer

T = 50
SEES = ("wall x", "wall y")
N = 4


def detours(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Paths (n, T + 1, 3), goals and walls (n, 2): past the wall, as far aside as it stands."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([0.3, -0.25, 0.025], [0.5, -0.1, 0.025], (n, 3))
    goal = rng.uniform([0.3, 0.1, 0.025], [0.5, 0.25, 0.025], (n, 3))
    wall = rng.uniform([0.3, -0.02], [0.5, 0.02], (n, 2))
    share = np.linspace(0.0, 1.0, T + 1)[:, None]
    paths = start[:, None] + share * (goal - start)[:, None]
    paths[:, :, 0] += np.sin(np.pi * share[:, 0]) * (wall[:, :1] - 0.4)
    return paths, goal, wall


@pytest.fixture(scope="module")
def predictor() -> GoalPredictor:
    paths, goals, walls = detours(200)
    return GoalPredictor.fit(
        paths,
        goals,
        env_id=moving_wall.WALL,
        physics="abc",
        context=SEES,
        contexts=walls,
        hidden=(64, 64),
        batch_size=256,
        learning_rate=3e-3,
        epochs=20,
    )


def test_it_imagines_another_way_past_another_wall(predictor: GoalPredictor) -> None:
    paths, goals, walls = detours(100, seed=9)
    start = paths[:, 0]
    error = np.linalg.norm(predictor.paths(start, goals, walls) - paths, axis=2)
    assert error.mean() < 0.01, "metres; without the wall it would be 0.03"
    left, right = walls.copy(), walls.copy()
    left[:, 0], right[:, 0] = 0.32, 0.48
    apart = predictor.paths(start, goals, right) - predictor.paths(start, goals, left)
    assert abs(apart[:, T // 2, 0].mean() - 0.16) < 0.02
    assert np.abs(apart[:, -1]).mean() < 0.02, "the goal is the same"


def test_levels_and_what_lies_ahead_are_on_the_way_past_the_wall(predictor: GoalPredictor) -> None:
    paths, goals, walls = detours(6, seed=1)
    ways = predictor.paths(paths[:, 0], goals, walls)
    level = np.array([1, 10, 25, 40, 49, 50])
    curriculum = Curriculum(T, k_max=T - 1, p=0.0, min_distance=0.1)
    asked = predictor, curriculum, paths[:, 0], goals
    np.testing.assert_allclose(imagine(*asked, level, walls), ways[np.arange(6), level], atol=1e-6)
    shown, drawn = draw_goals(*asked, np.random.default_rng(0), walls)
    np.testing.assert_allclose(shown, ways[np.arange(6), drawn], atol=1e-6)
    there = ahead(predictor, paths[:, 0], goals, 0.1, walls)
    assert np.abs(ways - there[:, None]).sum(axis=2).min(axis=1).max() < 1e-6


def test_files_say_what_it_sees(predictor: GoalPredictor, tmp_path: Path) -> None:
    predictor.save(tmp_path)
    loaded = GoalPredictor.load(tmp_path)
    paths, goals, walls = detours(5)
    asked = paths[:, 0], goals, walls
    assert loaded.context == SEES
    np.testing.assert_array_equal(loaded.paths(*asked), predictor.paths(*asked))
    facts = json.loads((tmp_path / FACTS_FILE).read_text())
    for context, sentence in (
        ("wall x", "context is not a list of bodies' names"),
        (["wall"], "context is not a list of bodies' names"),
        (["wall x"], "does not hold the tensors"),
        ([], "does not hold the tensors"),
    ):
        (tmp_path / FACTS_FILE).write_text(json.dumps({**facts, "context": context}))
        with pytest.raises(ValueError, match=sentence):
            GoalPredictor.load(tmp_path)


def test_files_of_a_predictor_that_sees_start_and_goal_alone_are_as_ever(tmp_path: Path) -> None:
    paths, goals, _ = detours(4)
    facts: dict[str, Any] = {"env_id": "Toy-v0", "physics": "abc", "hidden": (4,), "epochs": 1}
    GoalPredictor.fit(paths, goals, **facts).save(tmp_path)
    assert "context" not in json.loads((tmp_path / FACTS_FILE).read_text())
    assert GoalPredictor.load(tmp_path).context == ()


@pytest.mark.parametrize(
    ("contexts", "sentence"),
    [
        (None, r"contexts must have the shape \(2, 2\), of wall x, wall y, got none"),
        (np.zeros((2, 1)), r"contexts must have the shape \(2, 2\), of .*, got \(2, 1\)"),
        (np.array([[0.0, np.nan]] * 2), "contexts must be finite"),
    ],
)
def test_what_it_cannot_see_is_refused(
    predictor: GoalPredictor, contexts: np.ndarray | None, sentence: str
) -> None:
    paths, goals, _ = detours(2)
    with pytest.raises(ValueError, match=sentence):
        predictor.predict(paths[:, 0], goals, np.array([1, 2]), contexts)


def in_one_process() -> VecEnv:
    return DummyVecEnv([robot_maker(moving_wall.WALL)] * N)


def in_two_processes() -> VecEnv:
    return ProcessVecEnv(robot_maker(moving_wall.WALL), N, 2)


def test_copies_show_the_ways_past_their_own_walls(predictor: GoalPredictor) -> None:
    told = []
    for make in (in_one_process, in_two_processes):
        curriculum = Curriculum(T, k_max=T, p=0.0)
        env = ImaginedGoalVecEnv(make(), predictor, curriculum, mode="test")
        env.seed(3)
        for steps in (0, T):  # the first episodes, then those that begin by themselves
            obs: Any = env.reset() if not steps else None
            for _ in range(steps):
                obs, _, _, infos = env.step(np.zeros((N, 3), np.float32))
            walls = env.get_state()["contexts"]
            start, shown = obs["achieved_goal"], obs["desired_goal"]
            goals = np.array([fact["original_goal"] for fact in env._facts()])
            expected = predictor.predict(start, goals, np.full(N, T), walls)
            np.testing.assert_allclose(shown, expected, atol=1e-6)
            told.append((walls, shown))
        assert all("context" in info for info in infos), "for whoever imagines goals later"
        env.close()
    (first, second), (first_again, second_again) = told[:2], told[2:]
    assert len({tuple(row) for walls, _ in told[:2] for row in walls}) == 2 * N
    for one, other in ((first, first_again), (second, second_again)):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_the_walls_are_those_of_the_environments(predictor: GoalPredictor) -> None:
    inner = in_one_process()
    env = ImaginedGoalVecEnv(inner, predictor, Curriculum(T))
    env.seed(0)
    env.reset()
    walls = np.stack(inner.env_method("wall"))
    np.testing.assert_allclose(env.reset_infos[2]["context"], walls[2], atol=1e-12)
    np.testing.assert_allclose(env.get_state()["contexts"], walls, atol=1e-12)
    state = env.get_state()
    env.reset()
    env.set_state(state)
    np.testing.assert_array_equal(env.get_state()["contexts"], state["contexts"])
    env.close()


def one_that_imagines(predictor: GoalPredictor) -> gym.Env:
    env = gym.make(moving_wall.WALL)
    return ImaginedGoalWrapper(env, predictor, Curriculum(T, k_max=T, p=0.0))


def test_one_environment_shows_the_way_past_its_wall(predictor: GoalPredictor) -> None:
    env: Any = one_that_imagines(predictor)
    env.mode = "test"
    obs, info = env.reset(seed=5)
    wall = env.unwrapped.wall()
    np.testing.assert_allclose(info["context"], wall, atol=1e-12)
    start, goal = obs["achieved_goal"][None], info["original_goal"][None]
    expected = predictor.predict(start, goal, np.array([T]), wall[None])
    np.testing.assert_allclose(obs["desired_goal"], expected[0], atol=1e-6)
    np.testing.assert_allclose(
        env.ahead(0.1), ahead(predictor, start, goal, 0.1, wall[None])[0], atol=1e-6
    )
    env.close()


def test_one_that_begins_to_imagine_in_an_episode_knows_its_wall(predictor: GoalPredictor) -> None:
    env: Any = ImaginedGoalWrapper(gym.make(moving_wall.WALL), predictor)
    _, info = env.reset(seed=5)
    assert info["imagined_level"] == 0
    np.testing.assert_allclose(info["context"], env.unwrapped.wall(), atol=1e-12)
    env.load_curriculum(env.curriculum.state_dict())
    info = env.step(np.zeros(3, np.float32))[-1]
    np.testing.assert_allclose(info["context"], env.unwrapped.wall(), atol=1e-12)
    env.close()


def test_processes_of_sb3_need_the_wrapper_in_each_copy(predictor: GoalPredictor) -> None:
    curriculum = Curriculum(T, p=0.0)
    env = SubprocVecEnv([partial(gym.make, moving_wall.WALL)], start_method="fork")
    with pytest.raises(ValueError, match=r"the place of wall, .* SubprocVecEnv cannot be asked"):
        ImaginedGoalVecEnv(env, predictor, curriculum)
    env.close()
    env = SubprocVecEnv([partial(one_that_imagines, predictor)], start_method="fork")
    env.seed(5)
    env.reset()
    assert env.reset_infos[0]["context"].shape == (2,)
    env.close()


def test_imagined_goals_of_replay_lie_on_the_way_past_the_wall(predictor: GoalPredictor) -> None:
    curriculum = Curriculum(T, k_max=T, finish_threshold=0.9)
    env = ImaginedGoalVecEnv(in_one_process(), predictor, curriculum)
    env.seed(0)
    buffer = FollowObjectReplayBuffer(
        1000, env.observation_space, env.action_space, env, n_envs=N, imagined_ratio=1.0, seed=0
    )
    fill([buffer], env, T)
    start = buffer.observations["achieved_goal"][0]
    ways = predictor.paths(start, buffer.original_goals[0], buffer.contexts[0]).reshape(-1, 3)
    goals = buffer.sample(64).observations["desired_goal"].numpy()
    on_way = np.linalg.norm(goals[:, None] - ways, axis=2).min(axis=1) < 1e-5
    assert on_way.sum() > 30, "the others keep the goal that was shown"
    assert on_way.mean() > 0.7
    again = pickle.loads(pickle.dumps(buffer.state_dict()))
    assert again["slots"]["contexts"].shape == (T, N, 2)
    env.close()
