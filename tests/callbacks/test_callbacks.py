"""h_max is tested, k_max advances, tests are counted and stored."""

from __future__ import annotations

import contextlib
import json
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy
from imagined import N, bare, imagining, learner
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper


class Watch(BaseCallback):
    """Note values at the end of each rollout, after the callbacks before it."""

    def __init__(self, look: Any) -> None:
        super().__init__()
        self.look = look
        self.seen: list[Any] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.seen.append(self.look(self.model))


def test_threshold_zero_advances_once_a_cycle_until_finished() -> None:
    curriculum = toy.curriculum(threshold=0.0, k_max=7)
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    watch = Watch(lambda model: (curriculum.k_max, callback.test_steps))
    cycle = N * toy.HORIZON
    # The budget counts the three tests too.
    learner(imagining(curriculum)).learn((6 + 3) * cycle, callback=[callback, watch])
    # Once finished, nothing is tested any more.
    assert watch.seen == [
        (8, cycle),
        (9, 2 * cycle),
        (10, 3 * cycle),
        (10, 3 * cycle),
        (10, 3 * cycle),
        (10, 3 * cycle),
    ]


def test_failing_tests_keep_k_max() -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    learner(imagining(curriculum)).learn(3 * N * toy.HORIZON, callback=callback)
    assert curriculum.k_max == 6


def test_a_cycle_needs_a_finished_episode() -> None:
    """Stock SB3 ends a rollout after every step by default."""
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    callback = CurriculumCallback(imagining(curriculum, "test"), N, every=2)
    model = learner(imagining(curriculum), train_freq=1)
    model.learn((7 + 3) * N * toy.HORIZON, callback=callback)
    assert callback.test_steps == 3 * N * toy.HORIZON
    assert model.num_timesteps == (7 + 3) * N * toy.HORIZON
    assert model.replay_buffer.pos == (7 + 3) * toy.HORIZON


class Short(toy.PointEnv):
    """Its episodes have as many steps as are said."""

    def __init__(self, length: int) -> None:
        super().__init__()
        self.length = length

    def step(self, action: np.ndarray) -> Any:
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward, terminated, self.steps >= self.length, info


def test_a_cycle_is_as_many_episodes_as_copies_however_they_end() -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    lengths = [5 + copy for copy in range(N)]
    env = DummyVecEnv([partial(Short, length) for length in lengths])
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    model = learner(ImaginedGoalVecEnv(env, toy.StraightPredictor(), curriculum), train_freq=1)
    model.learn(100 * N, callback=callback)
    trained = (model.num_timesteps - callback.test_steps) // N
    tests, ended = callback.test_steps / (N * toy.HORIZON), sum(trained // n for n in lengths)
    assert ended / N / 2 <= tests <= ended / N, "not one wherever any copy's episode has ended"


class Falls(toy.PointEnv):
    """Its episodes are over half-way."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, self.steps == toy.HORIZON // 2, truncated, info


@pytest.mark.parametrize(("kind", "n"), [(toy.PointEnv, 0), (Falls, 1)])
def test_episodes_that_end_by_themselves_are_told_once(kind: Any, n: int) -> None:
    curriculum = toy.curriculum()
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    env = ImaginedGoalVecEnv(DummyVecEnv([kind] * N), toy.StraightPredictor(), curriculum)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learner(env, train_freq=1).learn(4 * N * toy.HORIZON, callback=callback)
    told = [str(each.message) for each in caught if "was terminated, not" in str(each.message)]
    assert len(told) == n


def test_stacked_goals_are_refused() -> None:
    curriculum = toy.curriculum()
    model = learner(VecFrameStack(imagining(curriculum), 2))
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    with pytest.raises(ValueError, match=r"VecFrameStack .* stacks goals too"):
        model.learn(10, callback=callback)


def test_tests_give_no_alarm_about_what_vec_normalize_has_clipped() -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    env = VecNormalize(imagining(curriculum), norm_reward=False, clip_obs=0.01)
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    model = learner(env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(2 * N * toy.HORIZON, callback=callback)
    assert callback.test_steps > 0


def test_tests_are_stored_as_whole_episodes_with_scaled_actions() -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6, p=1.0)
    test_env = imagining(curriculum, "test")
    test_env.action_space.high[:] = 2.0  # SB3 stores 2.0 as 1.0
    test_env.action_space.low[:] = -2.0
    train_env = imagining(curriculum)
    train_env.action_space = test_env.action_space
    model = learner(train_env, replay_buffer_kwargs={"copy_info_dict": True})
    model.learn(2 * 3 * N * toy.HORIZON, callback=CurriculumCallback(test_env, 2 * N))
    buffer = model.replay_buffer
    assert buffer.pos == 2 * 3 * toy.HORIZON
    assert (buffer.ep_length[: buffer.pos] == toy.HORIZON).all()
    np.testing.assert_array_equal(
        buffer.ep_start[: buffer.pos, 0], np.repeat(np.arange(6) * 10, 10)
    )
    assert (buffer._current_ep_start == buffer.pos).all()
    levels = [infos[0]["imagined_level"] for infos in buffer.infos[: buffer.pos]]
    assert levels == 2 * ([0] * 10 + [6] * 20)
    # The stored transitions are what the noise-free policy does at h_max.
    rows = slice(toy.HORIZON, 3 * toy.HORIZON)
    obs = {key: value[rows, 0] for key, value in buffer.observations.items()}
    actions = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(buffer.actions[rows, 0], actions / 2.0, atol=1e-6)
    np.testing.assert_array_equal(
        buffer.rewards[rows],
        toy.PointEnv().compute_reward(
            buffer.next_observations["achieved_goal"][rows],
            buffer.next_observations["desired_goal"][rows],
            {},
        ),
    )
    # The next observation of an episode's end is its own, not the next episode's start.
    moved = buffer.next_observations["observation"] - buffer.observations["observation"]
    assert np.abs(moved[: buffer.pos]).max() <= toy.STEP + 1e-9
    # A horizon's end is no terminal state.
    assert not (buffer.dones * (1 - buffer.timeouts))[: buffer.pos].any()


@pytest.mark.parametrize(
    ("n_test", "train_freq", "store"), [(3, 10, True), (N, 15, True), (N, 10, False)]
)
def test_tests_are_not_stored_where_they_would_mix_episodes(
    n_test: int, train_freq: int, store: bool
) -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    callback = CurriculumCallback(imagining(curriculum, "test", n_test), 2, store=store)
    model = learner(imagining(curriculum), train_freq=train_freq)
    model.learn(train_freq * N, callback=callback)
    assert model.replay_buffer.pos == train_freq
    assert callback.test_steps == n_test * toy.HORIZON


def test_test_episodes_of_unequal_length_do_not_run_into_the_training() -> None:
    class EndsOnGoal(toy.PointEnv):
        def step(self, action: np.ndarray) -> Any:
            obs, reward, _, truncated, info = super().step(action)
            return obs, reward, self.steps >= 3 + len(str(self.goal[0])) % 5, truncated, info

    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    inner = DummyVecEnv([EndsOnGoal] * N)
    test_env = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), curriculum, "test")
    model = learner(imagining(curriculum))
    model.learn(300, callback=CurriculumCallback(test_env, 3 * N))
    buffer = model.replay_buffer
    assert (buffer._current_ep_start == buffer.pos).all()
    assert (buffer.ep_length[: buffer.pos] > 0).all()
    for env in range(N):  # the goal never changes within what the buffer takes for an episode
        goals = buffer.observations["desired_goal"][: buffer.pos, env]
        starts = buffer.ep_start[: buffer.pos, env]
        same_episode = starts[1:] == starts[:-1]
        assert (goals[1:] == goals[:-1]).all(axis=1)[same_episode].all()


class Breaks(BaseCallback):
    """Stop or break off the training in the middle of episodes."""

    def __init__(self, raises: bool) -> None:
        super().__init__()
        self.raises = raises

    def _on_step(self) -> bool:
        done = self.n_calls < toy.HORIZON + toy.HORIZON // 2
        if self.raises and not done:
            raise InterruptedError
        return done


@pytest.mark.parametrize("anew", [False, True])
@pytest.mark.parametrize("raises", [False, True])
def test_episodes_that_training_broke_off_are_not_gone_on_with(raises: bool, anew: bool) -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    model = learner(imagining(curriculum), train_freq=(1, "step"))
    callback = CurriculumCallback(imagining(curriculum, "test"), N, every=10**6)
    with contextlib.suppress(InterruptedError):
        model.learn(10**4, callback=[callback, Breaks(raises)])
    model.learn(3 * N * toy.HORIZON, callback=callback, reset_num_timesteps=anew)
    buffer = model.replay_buffer
    filled = slice(0, buffer.pos)
    starts, ended = buffer.ep_start[filled], buffer.ep_length[filled] > 0
    within = (starts[1:] == starts[:-1]) & ended[1:] & ended[:-1]
    came = buffer.next_observations["achieved_goal"][filled][:-1]
    went_on = buffer.observations["achieved_goal"][filled][1:]
    assert within.sum() > 3 * N * toy.HORIZON // 2
    np.testing.assert_array_equal(came[within], went_on[within])


@pytest.mark.parametrize("algorithm", [DDPG, TD3, SAC])
def test_stock_algorithms_climb_the_curriculum(algorithm: Any) -> None:
    class StopAtLevel(BaseCallback):
        def _on_step(self) -> bool:
            return curriculum.k_max < 7

    curriculum = toy.curriculum()
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    model = learner(
        imagining(curriculum),
        algorithm,
        learning_starts=400,
        gradient_steps=40,
        batch_size=128,
        learning_rate=3e-3,
        tau=0.02,
        policy_kwargs={"net_arch": [64, 64]},
    )
    model.learn(8000, callback=[callback, StopAtLevel()])
    assert curriculum.k_max == 7  # the first policy reaches h_max at levels 1 and 2 only


def test_curricula_inside_subprocesses_follow() -> None:
    curriculum = toy.curriculum(threshold=0.0, p=0.0)

    def make() -> ImaginedGoalWrapper:
        return ImaginedGoalWrapper(toy.PointEnv(), toy.StraightPredictor(), toy.curriculum(p=0.0))

    env = SubprocVecEnv([make] * 2)
    try:
        callback = CurriculumCallback(imagining(curriculum, "test"), N)
        learner(env).learn(5 * (2 + N) * toy.HORIZON, callback=callback)
        assert curriculum.k_max == 7
        assert [copy.k_max for copy in env.get_attr("curriculum")] == [7, 7]
    finally:
        env.close()


def test_observation_normalisers_are_applied_in_tests() -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    model = learner(VecNormalize(imagining(curriculum), norm_reward=False))
    model.learn(4 * N * toy.HORIZON, callback=CurriculumCallback(imagining(curriculum, "test"), N))
    buffer = model.replay_buffer
    rows = slice(3 * toy.HORIZON, 4 * toy.HORIZON)
    obs = {key: value[rows, 0] for key, value in buffer.observations.items()}
    normaliser = model.get_vec_normalize_env()
    actions = model.predict(normaliser.normalize_obs(obs), deterministic=True)[0]
    np.testing.assert_allclose(buffer.actions[rows, 0], actions, atol=1e-5)


def test_the_curriculum_callback_resumes() -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    first = CurriculumCallback(imagining(curriculum, "test"), N, every=3)
    learner(imagining(curriculum)).learn((4 + 1) * N * toy.HORIZON, callback=first)
    second = CurriculumCallback(imagining(curriculum, "test"), N, every=3)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert second.test_steps == N * toy.HORIZON
    learner(imagining(curriculum)).learn(2 * N * toy.HORIZON, callback=second)
    assert second.test_steps == 2 * N * toy.HORIZON  # cycles 3 and 6 of the whole run


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_episodes": 0}, "n_episodes is 0; it must be at least 1"),
        ({"every": 0}, "every is 0; it must be at least 1"),
    ],
)
def test_bad_counts_are_refused(options: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CurriculumCallback(imagining(toy.curriculum(), "test"), **{"n_episodes": 1, **options})


@pytest.mark.parametrize("kind", ["curriculum", "eval"])
def test_event_callbacks_are_refused_that_tell_nothing_of_rollouts(kind: str) -> None:
    env = imagining(toy.curriculum())
    callback: BaseCallback = (
        CurriculumCallback(n_episodes=N)
        if kind == "curriculum"
        else OriginalGoalEvalCallback(bare(), N, 10)
    )
    with pytest.raises(ValueError, match="of which EveryNTimesteps tells it nothing"):
        learner(env).learn(10, callback=EveryNTimesteps(5, callback))


def test_an_eval_env_is_a_vectorised_one() -> None:
    single: Any = toy.PointEnv()
    with pytest.raises(ValueError, match="eval_env is a PointEnv; give a VecEnv"):
        OriginalGoalEvalCallback(single, N, 10)


def test_a_test_env_must_show_h_max() -> None:
    for env in (imagining(toy.curriculum()), bare()):
        with pytest.raises(ValueError, match="mode='test'"):
            CurriculumCallback(env, 1)  # type: ignore[arg-type]


def test_a_test_env_in_vec_normalize_is_refused() -> None:
    normalised: Any = VecNormalize(imagining(toy.curriculum(), "test"))
    with pytest.raises(ValueError, match="test_env is in VecNormalize"):
        CurriculumCallback(normalised, 1)


def test_a_test_env_must_share_the_curriculum() -> None:
    callback = CurriculumCallback(imagining(toy.curriculum(), "test"), N)
    with pytest.raises(ValueError, match="the Curriculum object that the training has"):
        learner(imagining(toy.curriculum())).learn(10, callback=callback)
    with pytest.raises(ValueError, match="imagines no goals"):
        learner(bare()).learn(10, callback=callback)


def test_a_loaded_model_goes_on_at_its_k_max_with_a_test_env(tmp_path: Path) -> None:
    curriculum = toy.curriculum(threshold=0.0, k_max=5)
    model = learner(imagining(curriculum))
    model.learn(2 * N * toy.HORIZON, callback=CurriculumCallback(imagining(curriculum, "test"), N))
    assert curriculum.k_max == 6
    model.save(tmp_path / "model")
    begun = toy.curriculum(threshold=1.0, k_max=2)
    loaded = DDPG.load(tmp_path / "model", env=imagining(begun))
    loaded.learn(10, callback=CurriculumCallback(imagining(begun, "test"), N))
    assert begun.k_max == 6
    assert loaded.curriculum_state["k_max"] == 6


def test_a_loaded_models_first_episodes_are_of_its_k_max(tmp_path: Path) -> None:
    options: Any = {"p": 0.0, "sampling": "max", "threshold": 1.0}
    curriculum = toy.curriculum(k_max=7, **options)
    model = learner(imagining(curriculum))
    callback = CurriculumCallback(imagining(curriculum, "test"), N)
    model.learn(N * toy.HORIZON, callback=callback)
    model.save(tmp_path / "model")
    begun = toy.curriculum(k_max=2, **options)
    env = VecMonitor(imagining(begun), info_keywords=("imagined_level",))
    loaded = DDPG.load(tmp_path / "model", env=env)
    loaded.learn(N * toy.HORIZON, callback=CurriculumCallback(imagining(begun, "test"), N))
    assert [info["imagined_level"] for info in loaded.ep_info_buffer] == [7] * N


@pytest.mark.parametrize("face", ["VecEnv", "gymnasium"])
def test_a_new_model_begins_at_the_first_level_where_another_has_trained(face: str) -> None:
    def make_curriculum() -> toy.Curriculum:
        return toy.curriculum(threshold=0.0, k_max=3, p=0.0)

    def make() -> ImaginedGoalWrapper:
        return ImaginedGoalWrapper(toy.PointEnv(), toy.StraightPredictor(), make_curriculum())

    env: Any = imagining(make_curriculum()) if face == "VecEnv" else DummyVecEnv([make] * N)
    for _ in range(2):
        tested = env.curriculum if face == "VecEnv" else make_curriculum()
        shown = Watch(lambda model: [info["imagined_level"] for info in model.ep_info_buffer])
        callback = CurriculumCallback(imagining(tested, "test"), N)
        model = learner(VecMonitor(env, info_keywords=("imagined_level",)))
        model.learn(20 * N * toy.HORIZON, callback=[callback, shown])
        assert len(shown.seen[0]) == N and set(shown.seen[0]) <= {1, 2, 3}
        assert not set(shown.seen[-1]) <= {1, 2, 3}, "it advances"


def test_learning_again_counts_anew_and_tests_an_episode_of_every_copy(tmp_path: Path) -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    callback = CurriculumCallback(imagining(curriculum, "test"))
    evaluation = OriginalGoalEvalCallback(bare(), N, 80)
    model = learner(imagining(curriculum))
    for n in (1, 2):
        model.learn(2 * N * toy.HORIZON, callback=[callback, evaluation])
        assert callback.test_steps == N * toy.HORIZON
        assert evaluation.n_evaluations == n


@pytest.mark.parametrize("algorithm", [HerDDPG, DDPG, SAC])
def test_schedules_end_at_zero_with_tests_beyond_the_last_step(algorithm: Any) -> None:
    rates: list[float] = []

    def linear(progress: float) -> float:
        rates.append(1e-3 * progress)
        return rates[-1]

    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    model = learner(
        imagining(curriculum), algorithm, learning_rate=linear, learning_starts=0, batch_size=8
    )
    rollout = N * toy.HORIZON
    model.learn(3 * rollout + 1, callback=CurriculumCallback(imagining(curriculum, "test"), N))
    assert model.num_timesteps == 4 * rollout
    assert min(rates) >= 0.0 and rates[-1] <= 1e-3 / 3
    for every in (1, 100):  # with a test after it, and with none
        callback = CurriculumCallback(imagining(curriculum, "test"), N, every=every)
        model.learn(rollout // 2, callback=callback)
        assert min(rates) == 0.0
