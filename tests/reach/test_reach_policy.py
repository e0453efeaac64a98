"""The reach policy learns from the robot's episodes to bring the effector to places."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from reaching import HORIZON, REACH, TASK
from small_buffers import as_arrays
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.goal_env import with_terminal_observations
from sb3_follow_object.reach.policy import ReachPolicy
from sb3_follow_object.reach.vec_env import ReachFirstVecEnv
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer
from sb3_follow_object.settings.stages import ReachFirstSettings


def spaces_of(env: VecEnv) -> Any:
    return env.observation_space, env.action_space


def buffer_of(env: VecEnv) -> FollowObjectReplayBuffer:
    return FollowObjectReplayBuffer(20_000, *spaces_of(env), env, "cpu", env.num_envs, seed=0)


def toy_env(n: int = 8) -> ReachFirstVecEnv:
    env = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * n), **REACH)
    env.seed(0)
    return env


def act_at_random(
    env: ReachFirstVecEnv, buffer: FollowObjectReplayBuffer, steps: int, rng: np.random.Generator
) -> None:
    """Play whole episodes of a learner that knows nothing into a replay buffer."""
    obs: Any = env.reset()
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (env.num_envs, 4)).astype(np.float32)
        new_obs, rewards, dones, infos = env.step(actions)
        next_obs = with_terminal_observations(new_obs, dones, infos)  # type: ignore[arg-type]
        buffer.add(dict(obs), dict(next_obs), actions, rewards, dones, infos)
        obs = new_obs


def taught(env: ReachFirstVecEnv, horizon: int, n_rollouts: int) -> ReachPolicy:
    """Teach as training does: half of the episodes begin with what was learned so far."""
    buffer, rng = buffer_of(env), np.random.default_rng(0)
    policy = ReachPolicy(*spaces_of(env), env.reach_settings(), seed=0)
    for _ in range(n_rollouts):
        act_at_random(env, buffer, horizon, rng)
        policy.learn(buffer, 40, 256)
        env.set_reach(policy.actor(), 0.5)
    return policy


def success(env: ReachFirstVecEnv, horizon: int, n_rollouts: int) -> float:
    """Share of episodes that all begin with reaching in which the effector comes to the place."""
    actor: Any = env.approach.actor
    env.set_reach(actor, 1.0)
    env.reset()
    env.take_counts()
    for _ in range(n_rollouts * horizon):
        env.step(np.zeros((env.num_envs, 4), np.float32))
    (own, begun) = env.take_counts()
    assert own.sum() == 0 and begun.sum() == n_rollouts * env.num_envs
    return float(begun[1] / begun.sum())


def test_learns_to_bring_the_effector_to_the_object() -> None:
    env = toy_env()
    env.set_reach(ReachPolicy(*spaces_of(env), env.reach_settings()).actor(), 1.0)
    assert success(env, HORIZON, 6) < 0.3, "untaught it would come there too"
    policy = taught(env, HORIZON, 25)
    assert success(env, HORIZON, 12) > 0.9
    assert policy.idle.tolist() == [False, False, False, True]  # the toy's fourth does nothing


def test_learns_to_reach_in_the_simulation() -> None:
    env = ReachFirstVecEnv(make_vec("FollowObject/PnPSimpleV1-v0", 8, 1))
    env.seed(0)
    taught(env, 50, 20)
    assert success(env, 50, 3) > 0.9


def outcome(policy: ReachPolicy) -> dict[str, Any]:
    return {
        **{name: value.numpy().copy() for name, value in policy.policy.state_dict().items()},
        "mean": policy.moments.mean.copy(),
        "draw": copy.deepcopy(policy.rng.bit_generator.state),
    }


def filled(n: int = 4) -> tuple[ReachFirstVecEnv, FollowObjectReplayBuffer]:
    env = toy_env(n)
    buffer = buffer_of(env)
    act_at_random(env, buffer, 2 * HORIZON, np.random.default_rng(0))
    return env, buffer


def test_one_seed_one_policy_whatever_is_drawn_elsewhere() -> None:
    env, buffer = filled()
    policies = []
    for noise in (0, 1):
        th.manual_seed(noise)
        np.random.seed(noise)
        policy = ReachPolicy(*spaces_of(env), env.reach_settings(), seed=7)
        policy.learn(buffer, 3, 32)
        policies.append(policy)
    np.testing.assert_equal(outcome(policies[0]), outcome(policies[1]))
    other = ReachPolicy(*spaces_of(env), env.reach_settings(), seed=8)
    other.learn(buffer, 3, 32)
    assert not np.array_equal(outcome(other)["mean"], outcome(policies[0])["mean"])


def test_neither_the_learner_nor_its_buffer_notice_that_it_learns() -> None:
    env, buffer = filled()
    twin = copy.deepcopy(buffer)
    policy = ReachPolicy(*spaces_of(env), env.reach_settings(), seed=0)
    before = th.get_rng_state()
    policy.learn(buffer, 3, 32)
    assert th.equal(th.get_rng_state(), before)
    np.testing.assert_equal(as_arrays(buffer.sample(16)), as_arrays(twin.sample(16)))


def test_goes_on_from_its_state_exactly() -> None:
    env, buffer = filled()
    policy, other = (ReachPolicy(*spaces_of(env), env.reach_settings(), s) for s in (0, 1))
    policy.learn(buffer, 3, 32)
    other.load_state_dict(copy.deepcopy(policy.state_dict()))
    for each in (policy, other):
        each.learn(buffer, 3, 32)
    np.testing.assert_equal(outcome(policy), outcome(other))


def test_actor_does_what_the_network_does() -> None:
    env, buffer = filled()
    policy = ReachPolicy(*spaces_of(env), env.reach_settings(), seed=0)
    policy.learn(buffer, 20, 64)
    rng = np.random.default_rng(0)
    observation, goal = (rng.normal(size=(9, n)).astype(np.float32) for n in (6, 3))
    inputs = {"observation": th.as_tensor(observation), "desired_goal": th.as_tensor(goal)}
    with th.no_grad():
        expected = policy.policy.actor(inputs).numpy()
    np.testing.assert_allclose(policy.actor()(observation, goal), expected, atol=1e-5)


def test_effector_must_be_in_the_observation() -> None:
    settings = ReachFirstSettings(effector=(4, 5, 6))
    with pytest.raises(ValueError, match=r"effector is \[4, 5, 6\].* of shape \(6,\), must hold"):
        ReachPolicy(*spaces_of(toy_env(1)), settings)
