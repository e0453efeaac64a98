"""The shown goal is the goal everywhere: observations, rewards, success, replay buffer."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
import toy
from gymnasium.utils.env_checker import check_env
from imagined import N, check_transitions, episodes, expected_goal, imagining, play
from stable_baselines3 import DDPG, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
)

from sb3_follow_object import make_vec
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.reach.vec_env import ReachFirstVecEnv
from sb3_follow_object.reach.wrapper import ReachFirstWrapper


@pytest.mark.parametrize("levels", ["time", "path"])
def test_the_shown_goal_is_the_goal_of_the_whole_episode(levels: str) -> None:
    curriculum = toy.curriculum(k_max=3, levels=levels, p=0.3)
    finished = episodes(imagining(curriculum), 200)
    assert len(finished) == 80
    check_transitions(curriculum, finished)
    levels_seen = {episode[0]["info"]["imagined_level"] for episode in finished}
    assert levels_seen == {0, 1, 2, 3}
    steps = [step for episode in finished for step in episode]
    # The test would say nothing if both goals were always reached or missed together.
    assert any(step["info"]["is_success"] != step["info"]["original_success"] for step in steps)


@pytest.mark.parametrize("training", [True, False])
def test_goals_in_standard_deviations_are_refused(training: bool) -> None:
    normalised = VecNormalize(DummyVecEnv([toy.PointEnv] * N), training=training)
    with pytest.raises(ValueError, match="put it inside VecNormalize, not around it"):
        ImaginedGoalVecEnv(normalised, toy.StraightPredictor(), toy.curriculum())


def test_what_reaches_first_goes_outside() -> None:
    settings: dict[str, Any] = {"effector": (0, 1, 2), "height": 0.0}

    def reaching() -> gym.Env:
        return ReachFirstWrapper(toy.PointEnv(), **settings)

    around = ReachFirstVecEnv(DummyVecEnv([toy.PointEnv]), **settings)
    for inner in (DummyVecEnv([reaching]), around, VecMonitor(around)):
        with pytest.raises(ValueError, match="imagined goals go inside of reaching first"):
            ImaginedGoalVecEnv(inner, toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match="imagined goals go inside of reaching first"):
        ImaginedGoalWrapper(reaching(), toy.StraightPredictor(), toy.curriculum())


def test_goals_are_imagined_once() -> None:
    def imagined() -> gym.Env:
        return ImaginedGoalWrapper(toy.PointEnv(), toy.StraightPredictor(), toy.curriculum())

    batch = ImaginedGoalVecEnv(
        DummyVecEnv([toy.PointEnv]), toy.StraightPredictor(), toy.curriculum()
    )
    for inner in (DummyVecEnv([imagined]), batch, VecMonitor(batch)):
        with pytest.raises(ValueError, match="the environment imagines goals already: leave one"):
            ImaginedGoalVecEnv(inner, toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match="the environment imagines goals already: leave one"):
        ImaginedGoalWrapper(imagined(), toy.StraightPredictor(), toy.curriculum())


def test_a_predictor_of_another_task_is_refused() -> None:
    predictor, curriculum = toy.StraightPredictor(), toy.Curriculum(50)
    predictor.horizon, predictor.env_id = 50, "FollowObject/PushSideGap-v0"
    sentence = "made for env_id 'FollowObject/PushSideGap-v0', not for 'FollowObject/PnPShelf-v0'"
    with pytest.raises(ValueError, match=sentence):
        ImaginedGoalVecEnv(make_vec("FollowObject/PnPShelf-v0", 1), predictor, curriculum)
    with pytest.raises(ValueError, match=sentence):
        ImaginedGoalWrapper(gym.make("FollowObject/PnPShelf-v0"), predictor, curriculum)
    predictor.env_id = "FollowObject/PnPShelf-v0"
    ImaginedGoalVecEnv(make_vec("FollowObject/PnPShelf-v0", 1), predictor, curriculum)


@pytest.mark.parametrize(
    ("predictor", "curriculum", "named"),
    [("auto", toy.curriculum(), "str and Curriculum"), (toy.StraightPredictor(), {}, "and dict")],
)
def test_copies_want_a_predictor_and_a_curriculum(
    predictor: Any, curriculum: Any, named: str
) -> None:
    with pytest.raises(ValueError, match=f"takes a GoalPredictor .* and a Curriculum.*{named}"):
        ImaginedGoalVecEnv(DummyVecEnv([toy.PointEnv]), predictor, curriculum)


@pytest.mark.parametrize("name", ["predictor", "curriculum"])
def test_what_all_copies_share_is_not_set_in_copies(name: str) -> None:
    env = imagining(toy.curriculum())
    with pytest.raises(ValueError, match=f"{name} is shared by all copies"):
        env.set_attr(name, env.get_attr(name)[0])


def test_single_environments_and_no_predictor_are_refused() -> None:
    single: Any = toy.PointEnv()
    with pytest.raises(ValueError, match="ImaginedGoalVecEnv takes a VecEnv, not PointEnv"):
        ImaginedGoalVecEnv(single, toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match="predictor must be a GoalPredictor, the folder of one"):
        ImaginedGoalWrapper(single, None)  # type: ignore[arg-type]


def test_original_goals_come_from_the_environment() -> None:
    finished = episodes(imagining(toy.curriculum()), 50)
    bare = DummyVecEnv([toy.PointEnv] * N)
    bare.seed(0)
    goals = [episode[0]["info"]["original_goal"] for episode in finished]
    theirs = [episode[0]["obs"]["desired_goal"] for episode in episodes(bare, 50)]
    np.testing.assert_array_equal(goals, theirs)


def test_one_coin_an_episode_with_probability_p() -> None:
    curriculum = toy.curriculum(k_max=5, p=0.3)
    finished = episodes(imagining(curriculum, n=40), 500)
    levels = np.array([episode[0]["info"]["imagined_level"] for episode in finished])
    assert len(levels) == 2000
    shares = np.bincount(levels) / len(levels)
    np.testing.assert_allclose(shares, [0.3, 0.14, 0.14, 0.14, 0.14, 0.14], atol=0.04)
    # Copies that start together draw apart: within a round the coins differ as if independent.
    coins = (levels.reshape(-1, 40) == 0).mean(axis=1)
    assert 0.04 < coins.std() < 0.11  # sqrt(0.3 * 0.7 / 40) = 0.072


def test_the_goal_outlives_a_change_of_k_max() -> None:
    curriculum = toy.curriculum(k_max=2, p=0.0)
    venv = imagining(curriculum)
    obs = cast(dict[str, np.ndarray], venv.reset())
    for step in range(toy.HORIZON - 1):
        curriculum.k_max = min(2 + step, 9)
        new_obs, *_ = venv.step(np.zeros((N, 3), np.float32))
        np.testing.assert_array_equal(
            cast(dict[str, np.ndarray], new_obs)["desired_goal"], obs["desired_goal"]
        )
    *_, infos = venv.step(np.zeros((N, 3), np.float32))
    assert all(1 <= info["imagined_level"] <= 2 for info in infos)
    assert max(episode[0]["info"]["imagined_level"] for episode in episodes(venv, 100)) == 9


def test_a_finished_curriculum_changes_nothing_but_the_info() -> None:
    bare = DummyVecEnv([toy.PointEnv] * N)
    bare.seed(0)
    for ours, theirs in zip(
        play(imagining(toy.curriculum(k_max=10, p=0.0)), 30), play(bare, 30), strict=True
    ):
        assert ours["info"]["imagined_level"] == 0
        assert ours["info"]["is_success"] == ours["info"]["original_success"]
        for part in ("obs", "next_obs"):
            for key in ours[part]:
                np.testing.assert_array_equal(ours[part][key], theirs[part][key])
        assert ours["reward"] == theirs["reward"]


def test_mode_test_shows_h_max_in_every_episode() -> None:
    curriculum = toy.curriculum(k_max=4, p=1.0)
    finished = episodes(imagining(curriculum, "test"), 50)
    assert {episode[0]["info"]["imagined_level"] for episode in finished} == {4}
    check_transitions(curriculum, finished)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_goals_keep_the_environments_dtype(dtype: str) -> None:
    venv = imagining(toy.curriculum(), env=lambda: toy.PointEnv(dtype))
    for step in play(venv, 12):
        assert step["obs"]["desired_goal"].dtype == np.dtype(dtype)
        assert step["next_obs"]["desired_goal"].dtype == np.dtype(dtype)


def test_arrays_are_not_shared_between_steps() -> None:
    venv = imagining(toy.curriculum())
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    for step in play(venv, 25):
        for array in (step["next_obs"]["desired_goal"], step["info"]["original_goal"]):
            seen.append((array, array.copy()))
    for array, copied in seen:
        np.testing.assert_array_equal(array, copied)


def test_seeds_decide_everything() -> None:
    def goals(seed: int) -> np.ndarray:
        venv = imagining(toy.curriculum())
        venv.seed(seed)
        return np.array([step["obs"]["desired_goal"] for step in play(venv, 40)])

    np.testing.assert_array_equal(goals(1), goals(1))
    assert not np.array_equal(goals(1), goals(2))


def test_a_state_continues_the_same_draws() -> None:
    class StatefulVecEnv(DummyVecEnv):
        def get_state(self) -> bytes:
            return pickle.dumps(self.envs)

        def set_state(self, state: bytes) -> None:
            self.envs = pickle.loads(state)

    def make() -> ImaginedGoalVecEnv:
        inner = StatefulVecEnv([toy.PointEnv] * N)
        venv = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), toy.curriculum())
        venv.seed(0)
        return venv

    def go_on(venv: ImaginedGoalVecEnv) -> list[Any]:
        results = [venv.step(np.full((N, 3), 0.5, np.float32)) for _ in range(25)]
        return [(obs["desired_goal"], rewards) for obs, rewards, *_ in results]  # type: ignore[call-overload,index]

    first, second = make(), make()
    first.reset()
    for _ in range(7):
        first.step(np.zeros((N, 3), np.float32))
    state = first.get_state()
    expected = go_on(first)
    second.reset()
    second.set_state(state)
    for ours, theirs in zip(go_on(second), expected, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])
    with pytest.raises(ValueError, match="saved for 4 environments"):
        imagining(toy.curriculum(), n=3).set_state(state)


def test_subprocesses() -> None:
    curriculum = toy.curriculum(k_max=3)
    inner = SubprocVecEnv([toy.PointEnv] * 2)
    venv = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), curriculum)
    venv.seed(0)
    try:
        check_transitions(curriculum, episodes(venv, 40))
    finally:
        venv.close()


def test_a_monitor_outside_counts_the_shown_rewards() -> None:
    venv = VecMonitor(imagining(toy.curriculum(p=0.0)))
    for episode in episodes(venv, 20):
        returns = sum(step["reward"] for step in episode)
        assert episode[-1]["info"]["episode"]["r"] == pytest.approx(returns)


# One gymnasium environment


def single(curriculum: Curriculum, seed: int = 0) -> ImaginedGoalWrapper:
    env = ImaginedGoalWrapper(toy.PointEnv(), toy.StraightPredictor(), curriculum)
    env.reset(seed=seed)
    return env


def test_the_gymnasium_wrapper_shows_goals_in_the_same_way() -> None:
    curriculum = toy.curriculum(k_max=3, p=0.3)
    venv = DummyVecEnv([lambda: single(curriculum)] * 2)
    finished = episodes(venv, 200)
    check_transitions(curriculum, finished)
    levels = {episode[0]["info"]["imagined_level"] for episode in finished}
    assert levels == {0, 1, 2, 3}


@pytest.mark.parametrize("batched", [True, False])
def test_an_episode_that_reaches_its_imagined_goal_goes_on_to_the_original(batched: bool) -> None:
    curriculum = toy.curriculum(k_max=3, p=0.3, go_on=1.0)
    venv: VecEnv = (
        imagining(curriculum) if batched else DummyVecEnv([lambda: single(curriculum)] * N)
    )
    went_on, judge = 0, toy.PointEnv()
    for episode in episodes(venv, 300):
        shown = expected_goal(curriculum, episode[0])
        level = episode[0]["info"]["imagined_level"]
        for step in episode:
            info, achieved = step["info"], step["next_obs"]["achieved_goal"]
            np.testing.assert_allclose(step["obs"]["desired_goal"], shown, atol=1e-6)
            assert info["imagined_level"] == level
            assert info["is_success"] == bool(judge.is_success(achieved, shown))
            assert step["reward"] == float(judge.compute_reward(achieved, shown, {}))
            goes_on = level > 0 and info["is_success"] and not step["done"]
            assert info.get("goes_on", False) == goes_on
            if goes_on:
                went_on, level, shown = went_on + 1, 0, info["original_goal"]
            np.testing.assert_allclose(step["next_obs"]["desired_goal"], shown, atol=1e-6)
    assert went_on > 10


@pytest.mark.parametrize("batched", [True, False])
@pytest.mark.parametrize(("share", "expected"), [(0.0, 0.0), (0.3, 0.3), (1.0, 1.0)])
def test_a_share_of_the_episodes_goes_on(batched: bool, share: float, expected: float) -> None:
    curriculum = toy.curriculum(k_max=1, p=0.0, go_on=share)
    venv: VecEnv = (
        imagining(curriculum) if batched else DummyVecEnv([lambda: single(curriculum)] * N)
    )
    arrived = went_on = 0
    for episode in episodes(venv, 1500):
        early = [step["info"]["is_success"] for step in episode[:-1]]
        arrived += any(early)
        went_on += any(step["info"].get("goes_on", False) for step in episode)
    assert arrived > 150
    assert went_on / arrived == pytest.approx(expected, abs=0.1)


def test_an_episode_that_is_to_go_on_still_is_after_it_was_saved() -> None:
    first, second = (imagining(toy.curriculum(k_max=3, p=0.2, go_on=0.5)) for _ in range(2))
    first.reset()
    second.reset()
    second.set_state(first.get_state())
    np.testing.assert_array_equal(first._may_go_on, second._may_go_on)
    assert set(first._may_go_on.tolist()) == {True, False}


def test_tests_of_h_max_do_not_go_on() -> None:
    curriculum = toy.curriculum(k_max=2, go_on=1.0)
    finished = episodes(imagining(curriculum, "test"), 200)
    check_transitions(curriculum, finished)
    assert any(step["info"]["is_success"] for episode in finished for step in episode[:-1])


def test_the_gymnasium_wrapper_is_a_valid_environment() -> None:
    check_env(single(toy.curriculum()), skip_render_check=True)


def test_the_gymnasium_wrapper_follows_its_seed() -> None:
    envs = [single(toy.curriculum()), single(toy.curriculum())]
    first, second = ([env.reset(seed=s)[0]["desired_goal"] for s in range(20)] for env in envs)
    np.testing.assert_array_equal(first, second)
    obs, info = envs[0].reset(seed=3)
    assert info["imagined_level"] in (0, 1, 2)
    np.testing.assert_array_equal(
        info["original_goal"], toy.PointEnv().reset(seed=3)[0]["desired_goal"]
    )
    assert obs["desired_goal"].shape == (3,)


def test_a_fetch_task_of_gymnasium_robotics() -> None:
    gym.register_envs(gymnasium_robotics)
    curriculum = toy.curriculum(p=0.0, k_max=3)

    def make() -> gym.Env:
        return gym.make("FetchPush-v4", max_episode_steps=toy.HORIZON)

    one = ImaginedGoalWrapper(make(), toy.StraightPredictor(), curriculum)
    many = ImaginedGoalVecEnv(DummyVecEnv([make] * 2), toy.StraightPredictor(), curriculum)
    for venv in (DummyVecEnv([lambda: one]), many):
        venv.seed(0)
        finished = episodes(venv, 11)
        assert finished
        check_transitions(curriculum, finished)
    one.close()
    many.close()


def test_a_folder_of_a_task_that_was_learned_with_a_module_before_its_id(tmp_path: Path) -> None:
    env_id = "gymnasium_robotics:FetchPush-v4"
    line = np.tile(np.linspace([1.3, 0.7, 0.42], [1.4, 0.8, 0.42], 51), (8, 1, 1))
    fit: dict[str, Any] = {"physics": "a line", "hidden": (4,), "epochs": 1}
    GoalPredictor.fit(line, line[:, -1], env_id=env_id, **fit).save(tmp_path)
    env = ImaginedGoalWrapper(gym.make(env_id), predictor=tmp_path)
    assert (env.predictor.env_id, env.predictor.physics) == ("FetchPush-v4", "a line")
    env.close()


# With stock algorithms


@pytest.mark.parametrize("algorithm", [DDPG, TD3, SAC])
@pytest.mark.parametrize("outside", [True, False])
def test_stock_replay_buffers_store_the_shown_goals(algorithm: Any, outside: bool) -> None:
    curriculum = toy.curriculum(k_max=4)
    env: VecEnv = (
        imagining(curriculum) if outside else DummyVecEnv([lambda: single(curriculum)] * N)
    )
    model = algorithm(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"copy_info_dict": True},
        learning_starts=2 * N * toy.HORIZON,
        buffer_size=1000,
        batch_size=16,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    )
    model.learn(5 * N * toy.HORIZON)
    buffer = model.replay_buffer
    judge = toy.PointEnv()
    assert buffer.pos == 5 * toy.HORIZON
    shown = buffer.observations["desired_goal"][: buffer.pos]
    achieved = buffer.next_observations["achieved_goal"][: buffer.pos]
    np.testing.assert_array_equal(shown, buffer.next_observations["desired_goal"][: buffer.pos])
    np.testing.assert_array_equal(
        buffer.rewards[: buffer.pos], judge.compute_reward(achieved, shown, {})
    )
    by_episode = shown.reshape(5, toy.HORIZON, N, 3)
    assert (by_episode == by_episode[:, :1]).all()
    levels = {info["imagined_level"] for row in buffer.infos[: buffer.pos] for info in row}
    assert levels == {0, 1, 2, 3, 4}
    for slot, infos in enumerate(buffer.infos[: buffer.pos]):
        for i, info in enumerate(infos):
            is_original = np.array_equal(shown[slot, i], info["original_goal"])
            assert is_original == (info["imagined_level"] == 0)


def test_attributes_that_replay_buffers_ask_for() -> None:
    curriculum = toy.curriculum()
    for venv in (imagining(curriculum), DummyVecEnv([lambda: single(curriculum)] * N)):
        assert venv.get_attr("curriculum") == [curriculum] * N
        assert venv.get_attr("predictor", indices=[0])[0].horizon == toy.HORIZON
