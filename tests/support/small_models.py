"""A HerDDPG of tiny networks in a toy environment."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch as th
from small_buffers import fill, make_env
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import HORIZON, PointEnv

from sb3_follow_object.callbacks.rollout import run_episodes
from sb3_follow_object.ddpg.her_ddpg import HerDDPG

TINY: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [32, 32]},
    "batch_size": 64,
    "gradient_steps": 10,
    "train_freq": HORIZON,
    "gamma": 0.9,
    "buffer_size": 10_000,  # SB3's default of a million takes a second to lay out
}


def make_model(n_envs: int = 4, **kwargs: Any) -> HerDDPG:
    env = DummyVecEnv([PointEnv] * n_envs)
    return HerDDPG("MultiInputPolicy", env, **{**TINY, "seed": 0, **kwargs})


def success_rate(model: HerDDPG, n_episodes: int = 100) -> float:
    env = DummyVecEnv([PointEnv] * 4)
    env.seed(1000)

    def policy(obs: Any) -> np.ndarray:
        return model.predict(obs, deterministic=True)[0]

    return run_episodes(policy, env, n_episodes).success_rate


def weights(model: HerDDPG) -> th.Tensor:
    return th.cat([p.detach().ravel() for p in model.policy.parameters()])


def assert_resumes_exactly(n_phases: int, **kwargs: Any) -> tuple[HerDDPG, HerDDPG]:
    """Train a model and one that took over its state; return both."""
    model, other = make_model(**kwargs), make_model(seed=1, **kwargs)
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    other.learn(80, log_interval=None)  # type: ignore[arg-type]
    assert not th.equal(weights(model), weights(other))
    other.load_training_state(copy.deepcopy(model.training_state()))
    other.replay_buffer.load_state_dict(  # type: ignore[union-attr]
        copy.deepcopy(model.replay_buffer.state_dict())  # type: ignore[union-attr]
    )
    for _ in range(n_phases):
        fill([model.replay_buffer, other.replay_buffer], make_env(4), 15)
        for each in (model, other):
            each.train(5, 64)
    assert th.equal(weights(model), weights(other))
    return model, other
