"""The replay buffer draws what HerReplayBuffer draws, and what it adds is as it says."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from small_buffers import LazyPointEnv, as_arrays, fill, make_buffer, make_env
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from toy import HORIZON, PointEnv, StraightPredictor

from sb3_follow_object.common.array_trees import load_tree, save_tree
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_steps_to_a_hindsight_goal_are_those_of_the_episode(strategy: str) -> None:
    """The goal is where the episode stood so many steps later, and reward 0 means none."""
    env = make_env()
    buffer = make_buffer(env, goal_selection_strategy=strategy)
    fill([buffer], env, 5 * HORIZON)
    samples, steps = buffer.sample_with_steps(4000)
    got, steps_to_goal = as_arrays(samples), steps.numpy().ravel()
    known = np.isfinite(steps_to_goal)
    assert 0.3 < known.mean() < 0.9 and got["reward"][steps_to_goal == 0].min() == 0.0
    stored = buffer.observations["observation"][: buffer.pos].reshape(-1, 3)
    achieved = buffer.next_observations["achieved_goal"][: buffer.pos].reshape(-1, 3)
    for i in np.flatnonzero(known)[:200]:
        (at,) = np.flatnonzero((stored == got["obs"][i]).all(axis=1))
        later = int(at + steps_to_goal[i] * env.num_envs)
        np.testing.assert_array_equal(achieved[later], got["goal"][i])


def test_relabelled_reward_is_the_environments() -> None:
    env = make_env()
    buffer = make_buffer(env)
    fill([buffer], env, 100)
    got = as_arrays(buffer.sample(4000))
    expected = PointEnv().compute_reward(got["next_achieved"], got["goal"], {})
    np.testing.assert_array_equal(got["reward"], expected)
    np.testing.assert_array_equal(got["goal"], got["next_goal"])
    assert 0.05 < (got["reward"] == 0).mean() < 0.95
    assert not got["done"].any()  # a truncation is not a termination


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_same_distribution_as_sb3(strategy: str) -> None:
    """Means of rewards, goals and goal distances agree within their standard errors."""
    env = make_env()
    ours = make_buffer(env, goal_selection_strategy=strategy)
    theirs = HerReplayBuffer(
        2000,
        env.observation_space,
        env.action_space,
        env,
        "cpu",
        env.num_envs,
        goal_selection_strategy=strategy,
    )
    fill([ours, theirs], env, 205)  # ends in mid-episode: that one must not be drawn
    np.random.seed(0)
    a, b = as_arrays(ours.sample(40_000)), as_arrays(theirs.sample(40_000))
    for name in ("reward", "obs", "goal"):
        error = np.hypot(a[name].std(axis=0), b[name].std(axis=0)) / np.sqrt(40_000)
        assert (np.abs(a[name].mean(axis=0) - b[name].mean(axis=0)) <= 4.5 * error).all(), name
    distance = [np.linalg.norm(x["next_achieved"] - x["goal"], axis=1) for x in (a, b)]
    for q in (0.1, 0.25, 0.5, 0.75, 0.9):
        assert np.quantile(distance[0], q) == pytest.approx(np.quantile(distance[1], q), abs=0.006)


def test_overwritten_and_unfinished_episodes_are_not_drawn() -> None:
    env = make_env(n_envs=1)
    for n_steps in (9, 11, 35, 36, 58, 71):
        buffer = make_buffer(env, size=35)  # the episode that wraps around overwrites one in part
        fill([buffer], env, n_steps)
        if n_steps < HORIZON:
            with pytest.raises(RuntimeError, match="no finished episode"):
                buffer.sample(1)
            continue
        valid = np.flatnonzero(buffer.ep_length[:, 0] > 0)
        assert buffer.table.n_transitions() == len(valid)
        row, step = buffer.table.draw(2000, np.random.default_rng(0))
        drawn = np.unique((buffer.table.start[row] + step) % 35)
        np.testing.assert_array_equal(drawn, valid)


def test_moved_ratio_draws_episodes_in_which_the_object_moved() -> None:
    env = make_env(env_class=LazyPointEnv)
    for ratio, expected in ((0.0, 0.5), (0.5, 0.75), (1.0, 1.0)):
        buffer = make_buffer(env, moved_ratio=ratio)
        fill([buffer], env, 20 * HORIZON)
        assert buffer.moved_share() == 0.5
        row, _ = buffer._draw(20_000)
        assert (buffer.table.priority[row] > 0).mean() == pytest.approx(expected, abs=0.02)


def test_energy_priority_prefers_lifts_to_pushes() -> None:
    buffer = make_buffer(make_env(), moved_ratio=1.0, moved_priority="energy")
    origin = np.zeros(3)
    along = np.linspace(0.005, 0.2, 40)[:, None]
    push, lift = along * np.array([1.0, 0, 0]), along * np.array([0, 0, 1.0])
    assert buffer._priority(origin, 0.01 * push) == 0.0
    # Speed 0.125 m/s is 0.0078 J/kg; 0.2 m of height is 1.962 J/kg.
    assert buffer._priority(origin, push) == pytest.approx(0.0078, abs=2e-4)
    assert buffer._priority(origin, lift) == pytest.approx(1.962 + 0.0078, abs=2e-3)
    buffer.table.insert(0, 0, 10, 1.0)
    buffer.table.insert(10, 0, 10, 3.0)
    row, step = buffer.table.draw(20_000, np.random.default_rng(0), by_priority=True)
    assert (row == 1).mean() == pytest.approx(0.75, abs=0.02)
    assert set(step) == set(range(10))


def test_hindsight_goals_lie_away_from_where_the_episode_began() -> None:
    """Nearer ones leave the transition as it was shown, reward included."""
    env = make_env(env_class=LazyPointEnv)
    buffer = make_buffer(env, min_goal_distance=0.05, n_sampled_goal=10**9)
    fill([buffer], env, 20 * HORIZON)
    seen = buffer.observations["observation"][: 20 * HORIZON]
    shown = buffer.observations["desired_goal"].reshape(-1, 3)
    got = as_arrays(buffer.sample(4000))
    is_shown = (got["goal"][:, None] == shown[None]).all(axis=2).any(axis=1)
    assert 0.5 < is_shown.mean() < 0.9  # all of the lazy episodes, early steps of the others
    moved = {key: value[~is_shown] for key, value in got.items()}
    same = (moved["obs"][:, None, None] == seen[None]).all(axis=3)
    _, slot, env_idx = np.nonzero(same)
    starts = seen[slot // HORIZON * HORIZON, env_idx]
    assert len(starts) == len(moved["goal"])
    assert np.linalg.norm(moved["goal"] - starts, axis=1).min() > 0.0499
    expected = PointEnv().compute_reward(got["next_achieved"], got["goal"], {})
    np.testing.assert_array_equal(got["reward"], expected)


def imagining_buffer(curriculum: Curriculum) -> FollowObjectReplayBuffer:
    """Twenty episodes, of which every goal that is learned from is imagined."""
    env = ImaginedGoalVecEnv(make_env(), StraightPredictor(), curriculum)
    env.seed(0)
    buffer = make_buffer(env, imagined_ratio=1.0, n_sampled_goal=10**9)
    fill([buffer], env, 20 * HORIZON)
    return buffer


def test_imagined_ratio_relabels_with_imagined_goals() -> None:
    curriculum = Curriculum(HORIZON, k_max=3, p=0.5)
    buffer = imagining_buffer(curriculum)
    got = as_arrays(buffer.sample(3000))
    starts = buffer.observations["achieved_goal"][::HORIZON].reshape(-1, 3)
    distance = np.linalg.norm(got["goal"][:, None] - starts[None], axis=2)
    # Levels 1..3 lie 5, 10 and 15 cm from some episode's start.
    error = np.abs(distance[:, :, None] - np.array([0.05, 0.10, 0.15])).min(axis=(1, 2))
    assert error.max() < 1e-5


def test_imagined_ratio_shows_no_level_that_training_would_not() -> None:
    for options, nearest in ({"min_distance": 0.12}, 0.15), ({"sampling": "max"}, 0.2):
        env = ImaginedGoalVecEnv(
            make_env(), StraightPredictor(), Curriculum(HORIZON, k_max=4, p=0.5, **options)
        )
        env.seed(0)
        buffer = make_buffer(env, imagined_ratio=1.0, n_sampled_goal=10**9)
        fill([buffer], env, HORIZON)
        starts = np.repeat(buffer.observations["achieved_goal"][:1], 500, axis=0).reshape(-1, 3)
        episode = np.tile(buffer.table.facts[:2], (500, 1))
        far = np.linalg.norm(buffer._imagined_goals(episode) - starts[episode[:, 1]], axis=1)
        assert far.min() > nearest - 1e-5 and far.max() < 0.2 + 1e-5


def test_imagined_ratio_ends_with_the_curriculum() -> None:
    curriculum = Curriculum(HORIZON, k_max=3, p=0.5)
    buffer = imagining_buffer(curriculum)
    curriculum.k_max = curriculum.n_levels
    achieved = buffer.next_observations["achieved_goal"][: buffer.pos].reshape(-1, 3)
    goals = as_arrays(buffer.sample(200))["goal"]
    assert (goals[:, None] == achieved[None]).all(axis=2).any(axis=1).all()


def test_the_predictor_is_asked_for_once() -> None:
    class Asked(ImaginedGoalVecEnv):
        names: list[str]

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            self.names.append(attr_name)
            return super().get_attr(attr_name, indices)

    Asked.names = []
    env = Asked(make_env(), StraightPredictor(), Curriculum(HORIZON))
    buffer = make_buffer(env, imagined_ratio=0.5)
    fill([buffer], env, 2 * HORIZON)
    buffer.sample(20)
    Asked.names.clear()
    for _ in range(3):
        buffer.sample(20)
    assert "predictor" not in Asked.names and "curriculum" in Asked.names
    other = pickle.loads(pickle.dumps(buffer))
    other.set_env(ImaginedGoalVecEnv(make_env(), StraightPredictor(), Curriculum(HORIZON)))
    other.sample(20)
    assert other._predictor is other.env.predictor


def test_a_seed_begins_the_generator_anew() -> None:
    env = make_env()
    buffer = make_buffer(env)
    fill([buffer], env, 2 * HORIZON)
    drawn = []
    for seed in (3, 3, 4):
        buffer.seed(seed)
        drawn.append(as_arrays(buffer.sample(50))["obs"])
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    with pytest.raises(ValueError, match="seed is -1; it must be at least 0"):
        buffer.seed(-1)


@pytest.mark.parametrize("imagines", [False, True])
def test_hindsight_goals_where_other_goals_lie_are_left_out(imagines: bool) -> None:
    goals = np.array([[0.2, 0.0, 0.0], [0.0, 0.2, 0.0]])

    class TwoGoals(PointEnv):
        """Goes to one of two places, whichever of them is asked."""

        episodes = 0

        def reset(self, **options: Any) -> Any:
            super().reset(**options)
            self.position = np.zeros(3)
            self.goal = goals[self.episodes % 2]
            self.episodes += 1
            return self._observe(), {}

        def step(self, action: np.ndarray) -> Any:
            return super().step(np.array([0.0, 1.0, 0.0]) if self.steps < 4 else np.zeros(3))

    env: Any = make_env(1, TwoGoals)
    if imagines:
        curriculum = Curriculum(HORIZON, k_max=1)
        env = ImaginedGoalVecEnv(env, StraightPredictor(), curriculum)
    buffer = make_buffer(env, scene_distance=0.04, n_sampled_goal=10**9)
    fill([buffer], env, 20 * HORIZON)

    def relabelled_to_the_second() -> np.ndarray:
        """How many of each goal's transitions are relabelled with where the second goal is."""
        row, step = buffer._draw(4000)
        episode = buffer.table.facts[row]
        achieved, _, usable = buffer._hindsight_goals(episode, step)
        of_first = (buffer.original_goals[episode[:, 0], 0] == np.float32(goals[0])).all(axis=1)
        there = np.linalg.norm(achieved[:, :3] - goals[1], axis=1) < 0.01
        there &= episode[:, 0] > HORIZON  # the first episode did not know of the second goal
        usable = np.ones(len(row), bool) if usable is None else usable
        return np.array([(of_first & there & usable).sum(), (~of_first & there & usable).sum()])

    if imagines:
        assert (relabelled_to_the_second() > 100).all(), "nothing stands around imagined goals"
        curriculum.k_max = curriculum.n_levels
    of_the_first, of_the_second = relabelled_to_the_second()
    assert of_the_first == 0 and of_the_second > 100
    goal = as_arrays(buffer.sample(2000))["goal"]
    assert np.isfinite(goal).all()

    other = make_buffer(env, scene_distance=0.04, n_sampled_goal=10**9)
    other.load_state_dict(buffer.state_dict())
    fill([buffer, other], env, 2 * HORIZON, seed=1)
    np.testing.assert_array_equal(buffer._amiss, other._amiss)


def test_a_state_may_take_the_place_of_more_than_it_holds() -> None:
    env = make_env()
    buffer, fuller = make_buffer(env, size=100), make_buffer(env, size=100)
    fill([buffer], env, 33)
    fill([fuller], env, 95)
    fuller.load_state_dict(buffer.state_dict())
    fill([buffer, fuller], env, 90, seed=1)
    expected, got = as_arrays(buffer.sample(500)), as_arrays(fuller.sample(500))
    for key in expected:
        np.testing.assert_array_equal(got[key], expected[key])


def test_imagined_ratio_needs_the_wrapper_to_learn() -> None:
    env = make_env()
    buffer = make_buffer(env, imagined_ratio=0.1)  # as of a model that is loaded to act
    with pytest.raises(ValueError, match="ImaginedGoalVecEnv"):
        buffer.set_env(make_env())
    with pytest.raises(
        ValueError, match=r"ImaginedGoalVecEnv .* call model\.replay_buffer\.set_env"
    ):
        fill([buffer], env, 1)
    assert buffer.pos == 0


def test_stacked_goals_are_refused() -> None:
    with pytest.raises(ValueError, match=r"VecFrameStack .* stacks goals too"):
        make_buffer(VecFrameStack(make_env(), 2))


def test_arguments_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="must lie in"):
        make_buffer(make_env(), moved_ratio=1.5)
    with pytest.raises(ValueError, match=r"moved_priority must be .*, not 'speed'"):
        make_buffer(make_env(), moved_priority="speed")
    with pytest.raises(ValueError, match=r"min_goal_distance is -0\.05; it must lie in .* metres"):
        make_buffer(make_env(), min_goal_distance=-0.05)


@pytest.mark.parametrize("way", ["pickle", "state_dict"])
def test_survives_saving_and_loading(way: str, tmp_path: Any) -> None:
    env = make_env()
    buffer = make_buffer(env, size=100)
    fill([buffer], env, 73)
    if way == "pickle":
        other = pickle.loads(pickle.dumps(buffer))
        other.set_env(env)
    else:
        save_tree(tmp_path / "buffer", buffer.state_dict())
        other = make_buffer(env, size=100)
        other.load_state_dict(load_tree(tmp_path / "buffer"))
    fill([buffer, other], env, 40, seed=1)
    expected, got = as_arrays(buffer.sample(500)), as_arrays(other.sample(500))
    for key in expected:
        np.testing.assert_array_equal(got[key], expected[key])


def test_observations_are_stored_in_float32() -> None:
    buffer = make_buffer(make_env())
    stores = [*buffer.observations.values(), *buffer.next_observations.values()]
    assert {store.dtype for store in stores} == {np.dtype(np.float32)}
    assert buffer.infos.size == 0


def test_works_in_stock_ddpg(tmp_path: Any) -> None:
    model = DDPG(
        "MultiInputPolicy",
        make_env(),
        replay_buffer_class=FollowObjectReplayBuffer,
        replay_buffer_kwargs={"moved_ratio": 0.5},
        learning_starts=2 * HORIZON,
        train_freq=HORIZON,
        gradient_steps=2,
        policy_kwargs={"net_arch": [16]},
        seed=0,
    )
    model.learn(10 * HORIZON)
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    model.learn(10 * HORIZON, reset_num_timesteps=False)


def test_a_state_without_its_infos_is_not_given() -> None:
    buffer = make_buffer(make_env(), copy_info_dict=True)
    with pytest.raises(ValueError, match="leave copy_info_dict out"):
        buffer.state_dict()


def test_energy_needs_a_height() -> None:
    class Flat(PointEnv):
        def __init__(self) -> None:
            super().__init__()
            box = spaces.Box(-np.inf, np.inf, (2,))
            keys = ("achieved_goal", "desired_goal")
            entries = {**self.observation_space.spaces, **dict.fromkeys(keys, box)}  # type: ignore
            self.observation_space = spaces.Dict(entries)

    env = DummyVecEnv([Flat])
    with pytest.raises(ValueError, match="goals of 3 numbers; these have 2"):
        make_buffer(env, moved_priority="energy")


def test_a_buffer_that_forgets_an_episode_while_the_next_one_runs_says_so() -> None:
    model = DDPG(
        "MultiInputPolicy",
        TimeLimit(PointEnv(), HORIZON),
        replay_buffer_class=FollowObjectReplayBuffer,
        buffer_size=HORIZON + 1,
        learning_starts=HORIZON,
        train_freq=1,
        policy_kwargs={"net_arch": [8]},
    )
    with pytest.raises(RuntimeError, match="hold two episodes of every environment; it holds 11"):
        model.learn(3 * HORIZON)
