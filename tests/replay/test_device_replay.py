"""Replay on the learner's device gives what replay on the host gives; the CPU stands in for it."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from small_buffers import LazyPointEnv, as_arrays, fill, make_buffer, make_env
from small_models import TINY, assert_resumes_exactly, make_model, success_rate, weights
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import HORIZON, THRESHOLD, PointEnv, StraightPredictor

from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.replay.device_replay import DeviceReplay, DistanceReward

CPU = th.device("cpu")


class DensePointEnv(PointEnv):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -np.linalg.norm(np.subtract(achieved, desired), axis=-1)


class OddPointEnv(PointEnv):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -np.abs(np.subtract(achieved, desired)).max(axis=-1)


def mirror(buffer: Any, seed: int = 0) -> DeviceReplay:
    replay = DeviceReplay(buffer, CPU, seed)
    replay.refresh(buffer)
    return replay


@pytest.mark.parametrize("env_class", [PointEnv, DensePointEnv])
def test_relabelled_rewards_are_the_environments(env_class: type[PointEnv]) -> None:
    env = make_env(env_class=env_class)
    buffer = make_buffer(env)
    fill([buffer], env, 100)
    samples, steps = mirror(buffer).sample_with_steps(4000)
    got = as_arrays(samples)
    expected = env_class().compute_reward(got["next_achieved"], got["goal"], {})
    np.testing.assert_allclose(got["reward"], expected, atol=1e-6)
    np.testing.assert_array_equal(got["goal"], got["next_goal"])
    assert 0.6 < float(steps.isfinite().float().mean()) < 0.95
    assert not got["done"].any()  # a truncation is not a termination


class NearPointEnv(PointEnv):
    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        self.goal = self.position + 0.06
        return self._observe(), {}


@pytest.mark.parametrize("where", ["host", "device"])
@pytest.mark.parametrize("n_sampled_goal", [0, 4])
def test_a_margin_asks_goals_to_be_reached_more_closely(where: str, n_sampled_goal: int) -> None:
    env = make_env(env_class=NearPointEnv)
    buffer = make_buffer(env, goal_margin=0.25, n_sampled_goal=n_sampled_goal)
    fill([buffer], env, 400)
    judge = buffer if where == "host" else mirror(buffer)
    got = as_arrays(judge.sample_with_steps(8000)[0])
    distance = np.linalg.norm(got["next_achieved"] - got["goal"], axis=1)
    clear = np.abs(distance - 0.75 * THRESHOLD) > 1e-5
    np.testing.assert_array_equal(got["reward"][clear], -1.0 * (distance > 0.75 * THRESHOLD)[clear])
    edge = (distance > 0.8 * THRESHOLD) & (distance < THRESHOLD)
    assert edge.sum() > 20, "without the margin these would count as reached"
    assert buffer.rewards.max() == 0.0, "what is stored is what was paid"


def test_a_margin_that_would_scale_the_rewards_is_refused() -> None:
    env = make_env(env_class=DensePointEnv)
    buffer = make_buffer(env, goal_margin=0.3)
    fill([buffer], env, 100)
    with pytest.raises(ValueError, match=r"goal_margin .* gives more than two rewards"):
        buffer.sample(64)
    with pytest.raises(ValueError, match=r"goal_margin .* gives more than two rewards"):
        mirror(buffer)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"goal_selection_strategy": "final"},
        {"goal_selection_strategy": "episode"},
        {"moved_ratio": 0.5, "moved_priority": "energy", "min_goal_distance": 0.05},
        {"goal_margin": 0.2},
    ],
    ids=["future", "final", "episode", "moved", "margin"],
)
def test_distribution_is_that_of_the_host(options: dict[str, Any]) -> None:
    """Means of all that is drawn, and of its products, agree within their standard errors."""
    env = make_env(env_class=LazyPointEnv)
    buffer = make_buffer(env, size=300, **options)
    fill([buffer], env, 205)  # has overwritten the first episodes and ends in mid-episode
    n = 40_000
    values = []
    for samples, steps in (
        buffer.sample_with_steps(n),
        mirror(buffer).sample_with_steps(n),
    ):
        got, steps_to_goal = as_arrays(samples), steps.numpy()
        known = np.isfinite(steps_to_goal)
        columns = [got["obs"], got["goal"], got["next_achieved"], samples.actions.numpy()]
        columns += [got["reward"][:, None], known, np.where(known, steps_to_goal, 0.0)]
        columns += [np.linalg.norm(got["goal"] - got["obs"], axis=1)[:, None]]
        table = np.concatenate(columns, axis=1)
        values.append(np.concatenate([table, table**2, table * table[:, -1:]], axis=1))
    a, b = values
    error = np.hypot(a.std(axis=0), b.std(axis=0)) / np.sqrt(n)
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) <= 4.5 * error + 1e-9).all()


def test_refresh_brings_what_was_stored_since() -> None:
    """A few steps, a wrap-around, more than fits, another content, another buffer."""
    env = make_env()
    buffer = make_buffer(env, size=70)  # 35 slots of 2 environments
    fill([buffer], env, 12)
    replay = mirror(buffer)
    other = make_buffer(env, size=70)
    fill([other], env, 50, seed=5)

    def check(of: Any) -> None:
        replay.refresh(of)
        for copied, stored in ((replay._records, of.records), (replay._achieved, of.achieved)):
            wanted = stored.array.reshape(copied.shape)
            used = slice(0, len(wanted) if of.full else of.pos * of.n_envs)
            np.testing.assert_array_equal(copied[used].numpy(), wanted[used])
        row = of.table.draw_list().rows
        np.testing.assert_array_equal(replay._lists[False][2].numpy(), of.table.facts[row, :3])

    for n_steps in (0, 7, 20, 35, 90):
        fill([buffer], env, n_steps)
        check(buffer)
    for n_steps in (13, 3):
        buffer.reset()
        with pytest.raises(RuntimeError, match="no finished episode yet"):
            replay.refresh(buffer)
        fill([buffer], env, n_steps + HORIZON, seed=n_steps)
        check(buffer)
    buffer.load_state_dict(copy.deepcopy(other.state_dict()))
    check(buffer)
    fill([other], env, 3)
    check(other)


def test_learns_to_reach() -> None:
    model = make_model(replay_on_device=True, policy_kwargs={"net_arch": [64, 64]})
    assert success_rate(model) < 0.5
    model.learn(4000, log_interval=None)  # type: ignore[arg-type]
    assert success_rate(model) > 0.9


def test_same_batch_same_weights_as_on_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both begin with the same networks and are given the same batches."""
    host, device = make_model(), make_model(replay_on_device=True)
    assert host._device_replay is None and device._device_replay is not None
    host.learn(10 * HORIZON, log_interval=None)  # type: ignore[arg-type]
    device.set_parameters(copy.deepcopy(host.get_parameters()))
    device._n_updates, device.replay_buffer = host._n_updates, host.replay_buffer
    device.set_logger(host.logger)
    device.moments = host.moments
    batch = host.replay_buffer.sample_with_steps(128)  # type: ignore[union-attr]
    monkeypatch.setattr(host.replay_buffer, "sample_with_steps", lambda *_, **__: batch)
    monkeypatch.setattr(device._device_replay, "sample_with_steps", lambda _: batch)
    before = weights(device)
    for model in (host, device):
        model.train(2, 64)
    assert not th.equal(before, weights(device))
    assert th.equal(weights(host), weights(device))


def test_resumed_training_equals_uninterrupted() -> None:
    assert_resumes_exactly(2, replay_on_device=True)


def test_works_with_an_auxiliary_reward_and_after_sb3s_saving(tmp_path: Any) -> None:
    model = make_model(replay_on_device=True, auxiliary={"name": "rnd", "hidden": [16]})
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=model.env)
    assert loaded._device_replay is not None
    assert th.equal(weights(loaded), weights(model))
    loaded.learn(80, log_interval=None)  # type: ignore[arg-type]
    assert not th.equal(weights(loaded), weights(model))


def test_rewards_of_known_environments_are_recognised() -> None:
    assert DistanceReward.of(make_vec("FetchReach-v4", 1), 3).threshold == 0.05
    task = "FollowObject/PushSideGap-v0"
    assert DistanceReward.of(make_vec(task, 1), 3).threshold == 0.05
    assert DistanceReward.of(make_vec(task, 1, reward_type="dense"), 3).threshold is None


@pytest.mark.parametrize("bound", [0.3, 0.5, 10.0])
def test_minus_a_distance_that_is_bounded_is_not_taken_for_minus_the_distance(bound: float) -> None:
    class BoundedPointEnv(PointEnv):
        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> np.ndarray:
            return -np.minimum(np.linalg.norm(np.subtract(achieved, desired), axis=-1), bound)

    with pytest.raises(ValueError, match="compute_reward gives others"):
        DistanceReward.of(make_env(1, BoundedPointEnv), 3)


@pytest.mark.parametrize("goal_size", [1, 3, 30])
def test_rewards_are_recognised_in_either_precision(goal_size: int) -> None:
    class DoublePointEnv(PointEnv):
        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> np.ndarray:
            return super().compute_reward(achieved.astype(np.float64), desired, info)

    class DoubleDensePointEnv(DensePointEnv):
        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> np.ndarray:
            return super().compute_reward(achieved.astype(np.float64), desired, info)

    for env_class in (PointEnv, DoublePointEnv):
        assert DistanceReward.of(make_env(1, env_class), goal_size).threshold == THRESHOLD
    for env_class in (DensePointEnv, DoubleDensePointEnv):
        assert DistanceReward.of(make_env(1, env_class), goal_size).threshold is None


def test_what_needs_the_host_is_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match="compute_reward gives others"):
        mirror(make_buffer(make_env(env_class=OddPointEnv)))
    with pytest.raises(ValueError, match="has no cher; replay on the host has"):
        make_model(replay_on_device=True, replay_buffer_kwargs={"cher": {}})
    imagining = ImaginedGoalVecEnv(make_env(), StraightPredictor(), Curriculum(HORIZON))
    with pytest.raises(ValueError, match="has no imagined_ratio > 0"):
        mirror(make_buffer(imagining, imagined_ratio=0.1))
    with pytest.raises(ValueError, match="replay_on_device must be true or false, not 'yes'"):
        make_model(replay_on_device="yes")
    env = make_env()
    buffer = make_buffer(env)
    fill([buffer], env, HORIZON)
    replay = mirror(buffer)
    buffer.goals_are_shared = False
    with pytest.raises(ValueError, match="goals that are the same"):
        replay.refresh(buffer)


def test_the_graph_of_another_state_is_not_replayed() -> None:
    """Sizes, rate, phase of the targets and loaded optimisers are all part of a graph's key."""
    model = make_model(target_update_interval=20)
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    inputs = {"rewards": th.zeros(64, 1)}
    keys = [model._updates._key(inputs, 64), model._updates._key(inputs, 32)]
    assert keys[0] == model._updates._key(inputs, 64)
    model._n_updates += 20
    assert keys[0] == model._updates._key(inputs, 64)
    model._n_updates += 19 - model._n_updates % 20  # the next step moves the targets
    keys.append(model._updates._key(inputs, 64))
    model.actor.optimizer.param_groups[0]["lr"] *= 0.5
    keys.append(model._updates._key(inputs, 64))
    kept = model.critic.optimizer.state_dict()
    model.critic.optimizer.load_state_dict(copy.deepcopy(kept))
    keys.append(model._updates._key(inputs, 64))
    assert len(set(keys)) == 5


def test_chunks_of_a_call_move_the_targets_alike() -> None:
    """In the authors' setting one graph serves all: 40 steps of 4864 and targets once in 40."""
    model = make_model(replay_on_device=True, target_update_interval=40)
    assert model._chunks(40, 4864) == [40]
    assert model._chunks(320, 4864) == [40] * 8
    assert model._chunks(50, 4864) == [40, 10]
    assert model._chunks(3, 10**6) == [1, 1, 1]
    assert make_model(replay_on_device=True)._chunks(120, 256) == [120]
    assert make_model()._chunks(40, 4864) == [6] * 6 + [4]


def test_a_goal_that_moves_sends_replay_back_to_the_host() -> None:
    """Where nobody asked for the device; else it is an error."""

    class MovingGoal(PointEnv):
        def step(self, action: np.ndarray) -> Any:
            self.goal = self.goal + 0.01
            return super().step(action)

    def learner() -> HerDDPG:
        env = DummyVecEnv([MovingGoal] * 2)
        return HerDDPG("MultiInputPolicy", env, **TINY, replay_on_device=True, seed=0)

    with pytest.raises(ValueError, match="goals that are the same"):
        learner().learn(40)
    model = learner()
    model.replay_on_device = None
    with pytest.warns(UserWarning, match="goes on on the host: .* goals that are the same"):
        model.learn(40)
    assert model._device_replay is None and model._n_updates > 0


def test_rewards_are_checked_there_as_well() -> None:
    env = DummyVecEnv([DensePointEnv] * 4)
    with pytest.raises(ValueError, match="hindsight_bound is for rewards of -1 and 0"):
        HerDDPG("MultiInputPolicy", env, **TINY, hindsight_bound=True, replay_on_device=True).learn(
            100
        )
