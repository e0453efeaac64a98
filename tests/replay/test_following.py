"""Who holds an environment, a curriculum or a buffer follows when it is replaced."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from numbered import ALGORITHMS, learner
from small_buffers import as_arrays, fill, make_buffer, make_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from toy import HORIZON, PointEnv, StraightPredictor, curriculum

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.ddpg.auxiliary import AuxiliaryReward, Transitions
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv

MINUS_TWO = -2.0


class Paying(PointEnv):
    """Pays the same for everything."""

    pay = MINUS_TWO

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.full(np.shape(achieved)[:-1], self.pay, dtype=np.float32)


class Dense(PointEnv):
    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.linalg.norm(achieved - desired, axis=-1)


def imagining(levels: Curriculum, mode: str = "train") -> ImaginedGoalVecEnv:
    return ImaginedGoalVecEnv(make_env(), StraightPredictor(), levels, mode)


def relabelled(buffer: Any) -> np.ndarray:
    """Rewards of samples that all have hindsight goals."""
    ratio, buffer.her_ratio = buffer.her_ratio, 1.0
    got = as_arrays(buffer.sample(300))
    buffer.her_ratio = ratio
    return got["reward"]


def test_rewards_are_asked_of_the_environment_that_was_set() -> None:
    model = learner("HerDDPG", make_env(), target_clip=(-20.0, 0.0))
    model.learn(5 * 2 * HORIZON)
    model.env.close()
    model.set_env(make_env(env_class=Paying))
    assert (relabelled(model.replay_buffer) == MINUS_TWO).all()
    model.learn(5 * 2 * HORIZON, reset_num_timesteps=False)


def test_a_closed_process_is_not_asked_any_more() -> None:
    old = SubprocVecEnv([PointEnv] * 2)
    model = learner("HerDDPG", old)
    model.learn(3 * 2 * HORIZON)
    old.close()
    model.set_env(make_env())
    model.learn(3 * 2 * HORIZON, reset_num_timesteps=False)


@pytest.mark.parametrize("name", ALGORITHMS[1:])
def test_a_stock_algorithms_buffer_is_told_or_says_so(name: str) -> None:
    old = SubprocVecEnv([PointEnv] * 2)
    model = learner(name, old)
    model.learn(5 * 2 * HORIZON)
    old.close()
    model.set_env(make_env(env_class=Paying))
    with pytest.raises(ValueError, match=r"call model.replay_buffer.set_env\(model.env\)"):
        model.learn(5 * 2 * HORIZON, reset_num_timesteps=False)
    model.replay_buffer.set_env(model.env)
    model.learn(5 * 2 * HORIZON, reset_num_timesteps=False)
    assert (relabelled(model.replay_buffer) == MINUS_TWO).all()


@pytest.mark.parametrize("name", ALGORITHMS[1:])
def test_with_a_normaliser_stock_algorithms_tell_it_themselves(name: str) -> None:
    def normalised(env_class: type[PointEnv]) -> VecNormalize:
        return VecNormalize(make_env(env_class=env_class), norm_reward=False)

    model = learner(name, normalised(PointEnv))
    model.learn(5 * 2 * HORIZON)
    model.set_env(normalised(Paying))
    model.learn(5 * 2 * HORIZON, reset_num_timesteps=False)
    assert (relabelled(model.replay_buffer) == MINUS_TWO).all()


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_curriculum_callback_tells_the_buffer(name: str) -> None:
    first, second = curriculum(threshold=1.0, k_max=3), curriculum(threshold=1.0, k_max=7)
    options = {"replay_buffer_kwargs": {"imagined_ratio": 1.0, "n_sampled_goal": 10**9}}
    model = learner(name, imagining(first), **options)
    for levels in (first, second):
        model.set_env(imagining(levels))
        callback = CurriculumCallback(imagining(levels, "test"), 2)
        if levels is second:
            del model.curriculum_state
        model.learn(5 * 2 * HORIZON, callback=callback)
    assert model.replay_buffer.env is model.env
    assert model.replay_buffer.env.get_attr("curriculum")[0] is second
    model.replay_buffer.sample(50)


def test_imagined_goals_are_those_of_the_new_environments_curriculum() -> None:
    model = learner(
        "HerDDPG",
        imagining(curriculum(k_max=2)),
        replay_buffer_kwargs={"imagined_ratio": 1.0, "n_sampled_goal": 10**9},
    )
    model.learn(5 * 2 * HORIZON)
    drawn = []
    for levels in (curriculum(k_max=2), curriculum(k_max=6)):
        model.set_env(imagining(levels))
        buffer, asked = model.replay_buffer, []
        rows = np.zeros((50, 4), dtype=int)
        start = buffer.observations["achieved_goal"][0, 0]
        for _ in range(5):
            asked.append(np.linalg.norm(buffer._imagined_goals(rows) - start, axis=1))
        drawn.append(set(np.rint(np.concatenate(asked) / 0.05).astype(int).tolist()))
    assert drawn == [{1, 2}, {1, 2, 3, 4, 5, 6}]
    with pytest.raises(ValueError, match="imagines no goals"):
        model.set_env(make_env())
    assert model.env is model.replay_buffer.env


def test_an_environment_of_another_kind_is_refused_and_nothing_is_changed() -> None:
    model = learner("HerDDPG", make_env())
    before = model.env
    with pytest.raises(ValueError, match="leave VecNormalize"):
        model.set_env(VecNormalize(make_env()))
    assert model.env is before and model.replay_buffer.env is before
    buffer = make_buffer(make_env(2))
    with pytest.raises(ValueError, match="holds steps of 2 environments; this one has 3 copies"):
        buffer.set_env(make_env(3))


def test_a_buffer_that_was_assigned_follows_too(tmp_path: Any) -> None:
    model = learner("HerDDPG", make_env(env_class=Paying), target_clip=None)
    model.learn(5 * 2 * HORIZON)
    other_env = make_env()
    other = make_buffer(other_env, size=300)
    fill([other], other_env, 7 * HORIZON)
    count, mean = model.moments.count, model.moments.mean.copy()
    model.replay_buffer = other
    model.train(2, 8)
    assert other.env is model.env
    assert (relabelled(other) == MINUS_TWO).all()
    assert model.moments.count == count  # its content is not taken for what the model stored
    np.testing.assert_array_equal(model.moments.mean, mean)
    model.learn(2 * 2 * HORIZON, reset_num_timesteps=False)
    assert model.moments.count == pytest.approx(count + 2 * 2 * 2 * HORIZON)
    model.replay_buffer = make_buffer(make_env(3))
    with pytest.raises(ValueError, match="holds steps of 3 environments; this one has 2"):
        model.learn(20)


def test_replay_on_the_device_follows_environment_and_buffer() -> None:
    model = learner("HerDDPG", make_env(), replay_on_device=True)
    model.learn(5 * 2 * HORIZON)
    assert model._device_replay.reward.threshold is not None
    model.set_env(make_env(env_class=Dense))
    model.train(1, 8)
    assert model._device_replay.reward.threshold is None
    other_env = make_env()
    model.replay_buffer = make_buffer(other_env, size=300)
    fill([model.replay_buffer], other_env, 7 * HORIZON, seed=5)
    model.train(1, 8)
    samples, _ = model._device_replay.sample_with_steps(200)
    stored = model.replay_buffer.observations["observation"][: 7 * HORIZON].reshape(-1, 3)
    seen = samples.observations["observation"].numpy()
    assert (seen[:, None] == stored[None]).all(axis=2).any(axis=1).all()
    model.set_env(make_env(env_class=Paying))
    with pytest.raises(ValueError, match="compute_reward gives others"):
        model.train(1, 8)


class OfOneTask(AuxiliaryReward):
    """Refuses environments that are not of its task."""

    name = "of one task"
    reward_range = (-1.0, 0.0)

    def __init__(self, n_features: int) -> None:
        super().__init__()

    @classmethod
    def resolve(cls, options: dict[str, Any], env: Any) -> dict[str, Any]:
        if env is not None and env.get_attr("dtype")[0] != "float64":
            raise ValueError("this reward is for another task")
        return options

    def forward(self, batch: Transitions) -> th.Tensor:
        return -th.ones(len(batch.actions), 1)


def test_an_auxiliary_reward_looks_at_the_new_environment() -> None:
    model = learner("HerDDPG", make_env(), auxiliary={"name": OfOneTask})
    before = model.env
    with pytest.raises(ValueError, match="for another task"):
        model.set_env(DummyVecEnv([lambda: PointEnv("float32")] * 2))
    assert model.env is before


class Flat(OfOneTask):
    def forward(self, batch: Transitions) -> th.Tensor:
        return -th.ones(len(batch.actions))


def test_auxiliary_rewards_are_not_broadcast() -> None:
    model = learner("HerDDPG", make_env(), auxiliary={"name": Flat}, learning_starts=0)
    with pytest.raises(ValueError, match=r"Flat.forward must have the shape \(8, 1\), not \(8,\)"):
        model.learn(2 * HORIZON)


def test_a_callback_tests_in_what_the_next_model_trains_in() -> None:
    """Models' levels are their own, and so are the steps of their tests."""
    first, second = curriculum(threshold=0.0, k_max=2), curriculum(threshold=0.0, k_max=5)
    callback = CurriculumCallback(imagining(first, "test"), 2)
    learner("DDPG", imagining(first)).learn(2 * 2 * HORIZON, callback=callback)
    assert first.k_max == 3 and callback.test_steps == 2 * HORIZON
    with pytest.raises(ValueError, match="the Curriculum object that the training has"):
        learner("DDPG", imagining(second)).learn(2 * HORIZON, callback=callback)
    other = learner("DDPG", imagining(first))
    other.curriculum_state = {**first.state_dict(), "k_max": 7}
    other.learn(2 * 2 * HORIZON, callback=callback)
    assert first.k_max == 8 and callback.test_steps == 2 * HORIZON
