"""However `learn` ends and begins again, the buffer holds what happened and nothing else."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest
from numbered import ALGORITHMS, NumberedEnv, assert_true_episodes, learner, numbered
from small_buffers import as_arrays, fill, make_buffer, make_env
from stable_baselines3 import PPO, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from toy import HORIZON, PointEnv, StraightPredictor, curriculum

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


class StopAfter(BaseCallback):
    """Stops, or raises what Ctrl-C does, after so many steps."""

    def __init__(self, n: int, error: type[BaseException] | None = None) -> None:
        super().__init__()
        self.left, self.error = n, error

    def _on_step(self) -> bool:
        self.left -= 1
        if self.left == 0 and self.error is not None:
            raise self.error
        return self.left > 0


def learn_until(model: Any, n: int, error: type[BaseException] | None, **options: Any) -> None:
    try:
        model.learn(10_000, callback=StopAfter(n, error), **options)
    except KeyboardInterrupt:
        assert error is KeyboardInterrupt


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_learning_anew_in_the_middle_of_an_episode_ends_it(name: str, n_envs: int) -> None:
    model = (
        learner(name, numbered(n_envs), train_freq=13, hindsight_bound=True)
        if (name == "HerDDPG")
        else learner(name, numbered(n_envs), train_freq=13)
    )
    for _ in range(3):
        model.learn(26 * n_envs)
    # Twice ten and six steps each time; the last six have not ended yet.
    assert assert_true_episodes(model.replay_buffer) == (3 * 3 - 1) * n_envs
    assert model.replay_buffer.pos == 3 * 26


# The step that ends an episode is the tenth: 9 stops before, 10 in it and 11 after it.
@pytest.mark.parametrize("error", [None, KeyboardInterrupt], ids=["stopped", "interrupted"])
@pytest.mark.parametrize("anew", [True, False], ids=["anew", "on"])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_step_that_was_not_stored_joins_no_episode(
    name: str, n_envs: int, anew: bool, error: type[BaseException] | None
) -> None:
    model = learner(name, numbered(n_envs), learning_starts=85 * n_envs)
    for n in (9, 10, 11, 14, 3, 3, 25):
        learn_until(model, n, error, reset_num_timesteps=anew)
    model.learn(5 * HORIZON * n_envs, reset_num_timesteps=anew)
    assert assert_true_episodes(model.replay_buffer) >= 5 * n_envs


def test_hindsight_goals_are_of_the_same_episode() -> None:
    model = learner("HerDDPG", numbered(2), replay_buffer_kwargs={"n_sampled_goal": 10**9})
    for _ in range(3):
        model.learn(2 * 26)
    _, steps = model.replay_buffer.sample_with_steps(2000)
    assert steps.max() < HORIZON


def test_a_stopped_episode_goes_on_where_its_environment_does() -> None:
    """Between two steps nothing is lost: the same episodes as without a pause."""
    model, whole = learner("HerDDPG", numbered(2)), learner("HerDDPG", numbered(2))
    for n in (2 * HORIZON, 3 * HORIZON):
        model.learn(2 * n, reset_num_timesteps=False)
    whole.learn(2 * 5 * HORIZON)
    got, expected = (each.replay_buffer.table.facts for each in (model, whole))
    np.testing.assert_array_equal(got, expected)
    obs = [each.replay_buffer.observations["observation"] for each in (model, whole)]
    np.testing.assert_array_equal(*obs)


def test_a_stock_buffer_of_her_ddpg_ends_its_episodes_too() -> None:
    model = learner("HerDDPG", numbered(2), replay_buffer_class=HerReplayBuffer)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(3):
            model.learn(2 * 26)
    buffer = model.replay_buffer
    numbers = buffer.observations["observation"][: buffer.pos, :, 0]
    starts = buffer.ep_start[: buffer.pos]
    same = starts[1:] == starts[:-1]
    assert same.any() and (numbers[1:] == numbers[:-1])[same].all()


def test_a_reset_that_nobody_tells_of_ends_the_episode() -> None:
    env = make_env()
    buffer = make_buffer(env)
    for n in (13, 4, 10):
        fill([buffer], env, n)
    assert sorted(buffer.table.length[buffer.table.length > 0]) == [3, 3, 4, 4, 10, 10, 10, 10]
    got = as_arrays(buffer.sample(200))
    assert not got["done"].any()


def test_an_episode_as_long_as_the_buffer_is_cut_there() -> None:
    env = make_env(n_envs=1)
    buffer = make_buffer(env, size=7)
    fill([buffer], env, 25)
    lengths = buffer.table.length[buffer.table.length > 0]
    assert lengths.sum() <= 7
    stored = buffer.observations["observation"][:, 0]
    later = buffer.next_observations["observation"][:, 0]
    for start, _, length, _ in buffer.table.facts[buffer.table.length > 0]:
        slots = (start + np.arange(length)) % 7
        np.testing.assert_array_equal(stored[slots[1:]], later[slots[:-1]])


@pytest.mark.parametrize("env_indices", [[0], [0, 0], [1], None])
def test_where_no_episode_runs_none_is_ended(env_indices: list[int] | None) -> None:
    env = make_env()
    buffer = make_buffer(env, size=120)
    for n_steps, stored in ((2 * HORIZON, 40), (4, 44 if env_indices else 48)):
        fill([buffer], env, n_steps)
        for _ in range(2):
            buffer.end_episodes(None if env_indices is None else np.array(env_indices))
            assert buffer.table.n_transitions() == stored
    assert buffer.table.length.max() == HORIZON


def test_an_episode_that_ends_as_the_buffer_is_full_is_kept_whole() -> None:
    env = make_env()
    buffer = make_buffer(env, size=2 * HORIZON)
    fill([buffer], env, HORIZON)
    buffer.end_episodes(np.array([0, 1]))
    assert buffer.table.facts[buffer.table.length > 0, 1:3].tolist() == [[0, 10], [1, 10]]


class Raises(BaseCallback):
    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["HerDDPG", "TD3"])
def test_stored_tests_that_are_interrupted_stay_apart_from_training(name: str) -> None:
    def imagining(mode: str) -> ImaginedGoalVecEnv:
        inner: Any = DummyVecEnv([Interrupted if mode == "test" else NumberedEnv] * 2)
        return ImaginedGoalVecEnv(inner, StraightPredictor(), levels, mode)

    class Interrupted(NumberedEnv):
        total = 0

        def step(self, action: np.ndarray) -> Any:
            Interrupted.total += 1
            if Interrupted.total in (9, 52):
                raise KeyboardInterrupt
            return super().step(action)

        def reset(self, **options: Any) -> Any:
            result = super().reset(**options)
            self.episode += 1000  # no number of the training's
            result[0]["observation"][0] = self.episode
            return result

    levels = curriculum(threshold=1.0, k_max=6)
    model = learner(name, imagining("train"), train_freq=5)
    callback = CurriculumCallback(imagining("test"), 2)
    for _ in range(4):
        try:
            model.learn(80, callback=callback, reset_num_timesteps=False)
        except KeyboardInterrupt:
            continue
    assert_true_episodes(model.replay_buffer)
    numbers = model.replay_buffer.observations["observation"][: model.replay_buffer.pos, :, 0]
    assert (numbers > 1000).any() and (numbers < 1000).any()


@pytest.mark.parametrize("name", ["DDPG", "SAC"])
def test_the_curriculum_callback_lets_stock_algorithms_begin_anew(name: str) -> None:
    """Without a Monitor nothing else tells of the step that SB3 forgets."""
    levels = curriculum(threshold=1.0, k_max=6)

    def imagining(mode: str) -> ImaginedGoalVecEnv:
        inner: Any = DummyVecEnv([NumberedEnv] * 2)
        return ImaginedGoalVecEnv(inner, StraightPredictor(), levels, mode)

    model = learner(name, imagining("train"))
    callback = CurriculumCallback(imagining("test"), 2, store=False)
    for error in (None, KeyboardInterrupt):
        for n in (9, 10, 11, 14, 3, 3):
            try:
                model.learn(
                    10_000, callback=[callback, StopAfter(n, error)], reset_num_timesteps=False
                )
            except KeyboardInterrupt:
                continue
    model.learn(100, callback=callback, reset_num_timesteps=False)
    assert_true_episodes(model.replay_buffer)


@pytest.mark.parametrize("face", ["batched", "single"])
@pytest.mark.parametrize("algorithm", ["HerDDPG", "DDPG"])
def test_an_episode_that_goes_on_to_another_goal_stays_one(algorithm: str, face: str) -> None:
    levels = curriculum(k_max=3, p=0.2, go_on=1.0)
    env: VecEnv
    if face == "batched":
        env = ImaginedGoalVecEnv(DummyVecEnv([PointEnv] * 3), StraightPredictor(), levels)
    else:
        env = DummyVecEnv(
            [lambda: ImaginedGoalWrapper(PointEnv(), StraightPredictor(), levels)] * 3
        )
    model = learner(algorithm, env, train_freq=HORIZON)
    model.learn(40 * 3 * HORIZON)
    buffer = model.replay_buffer
    length = buffer.table.length[buffer.table.length > 0]
    assert len(length) == 40 * 3 and (length == HORIZON).all()
    goals = buffer.observations["desired_goal"][: buffer.pos]
    # Each transition is about the goal that its step was for, before and after it ...
    np.testing.assert_array_equal(goals, buffer.next_observations["desired_goal"][: buffer.pos])
    achieved = buffer.next_observations["achieved_goal"][: buffer.pos]
    np.testing.assert_array_equal(
        buffer.rewards[: buffer.pos], PointEnv().compute_reward(achieved, goals, {})
    )
    # ... and some episodes have two.
    goals = goals.reshape(40, HORIZON, 3, 3)
    changes = (goals[:, 1:] != goals[:, :-1]).any(axis=-1).sum(axis=1)
    assert set(np.unique(changes)) == {0, 1}


def one_copy() -> FollowObjectReplayBuffer:
    env = DummyVecEnv([PointEnv])
    return FollowObjectReplayBuffer(40, env.observation_space, env.action_space, env, seed=0)


def stand(buffer: FollowObjectReplayBuffer, shown: float, then: float, info: Any = None) -> None:
    """Store a step at 0 for the goal at x = shown that ends with one at x = then."""
    still = np.zeros((1, 3))
    obs, later = (
        {"observation": still, "achieved_goal": still, "desired_goal": np.array([[x, 0.0, 0.0]])}
        for x in (shown, then)
    )
    buffer.add(obs, later, still, np.array([-1.0]), np.array([False]), [info or {}])


def lengths(buffer: FollowObjectReplayBuffer) -> list[int]:
    buffer.end_episodes()
    return buffer.table.length[buffer.table.length > 0].tolist()


def test_another_goal_without_going_on_is_another_episode() -> None:
    """An environment that is reset unnoticed begins where it stood, for another original goal."""
    buffer = one_copy()
    for goal in (0.1, 0.3):
        for _ in range(3):
            stand(buffer, goal, goal, {"imagined_level": 0})
    assert lengths(buffer) == [3, 3]


@pytest.mark.parametrize("saved", ["state", "pickle"])
def test_an_episode_that_goes_on_after_it_was_saved_stays_one(saved: str) -> None:
    buffer = one_copy()
    stand(buffer, 0.1, 0.1)
    stand(buffer, 0.1, 0.3, {"goes_on": True})
    if saved == "state":
        state, buffer = buffer.state_dict(), one_copy()
        buffer.load_state_dict(state)
    else:
        buffer = pickle.loads(pickle.dumps(buffer))
        buffer.set_env(DummyVecEnv([PointEnv]))
    stand(buffer, 0.3, 0.3)
    assert lengths(buffer) == [3]


def test_what_would_store_the_next_goal_for_the_last_is_refused() -> None:
    levels = curriculum(go_on=1.0)
    env = ImaginedGoalVecEnv(DummyVecEnv([PointEnv]), StraightPredictor(), levels)
    model = learner("DDPG", env, replay_buffer_class=HerReplayBuffer)
    with pytest.raises(ValueError, match=r"go_on shows another goal .* HerReplayBuffer would take"):
        model.learn(100, callback=CurriculumCallback())
    on_policy = PPO("MultiInputPolicy", env, n_steps=10, batch_size=10, device="cpu")
    with pytest.raises(ValueError, match=r"go_on shows another goal .* the model would take"):
        on_policy.learn(100, callback=CurriculumCallback())
