"""GoalPolicy gives stock DDPG and TD3 what HerDDPG does to its networks."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from tiny import TASK

from sb3_follow_object import (
    FollowObjectReplayBuffer,
    GoalPolicy,
    HerDDPG,
    HerPolicy,
    LayerNormReLU,
)
from sb3_follow_object.ddpg.layer_norm import LayerNorm
from sb3_follow_object.envs import make_vec

ACTIONS = spaces.Box(-1.0, 1.0, (4,), np.float32)
OBSERVATIONS = spaces.Dict(
    {
        "observation": spaces.Box(-np.inf, np.inf, (10,), np.float32),
        "achieved_goal": spaces.Box(-np.inf, np.inf, (3,), np.float32),
        "desired_goal": spaces.Box(-np.inf, np.inf, (3,), np.float32),
    }
)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Networks and batches are the same each time."""
    th.manual_seed(0)


def policy(**settings: Any) -> GoalPolicy:
    return GoalPolicy(
        OBSERVATIONS, ACTIONS, lambda _: 1e-3, net_arch=[16, 16], n_critics=1, **settings
    )


def batch(n: int = 8) -> dict[str, th.Tensor]:
    return {key: th.randn(n, *box.shape) for key, box in OBSERVATIONS.items() if box.shape}


def actor_gradients(net: GoalPolicy, obs: dict[str, th.Tensor], price: float) -> list[th.Tensor]:
    """Of SB3's loss of the actor, to which `price` times the mean squared action is added."""
    actions = net.actor(obs)
    loss = -net.critic.q1_forward(obs, actions).mean()
    if price:
        loss = loss + price * actions.square().mean()
    return list(th.autograd.grad(loss, list(net.actor.parameters())))


def test_actions_have_their_price_in_the_gradient() -> None:
    priced, plain, obs = policy(action_l2=0.7), policy(action_l2=0.0), batch()
    plain.load_state_dict(priced.state_dict())
    got, wanted = actor_gradients(priced, obs, 0.0), actor_gradients(plain, obs, 0.7)
    without = actor_gradients(plain, obs, 0.0)
    for g, w, o in zip(got, wanted, without, strict=True):
        th.testing.assert_close(g, w, rtol=1e-4, atol=1e-7)
        assert not th.allclose(g, o, rtol=1e-3, atol=1e-7)
    assert th.equal(priced.actor(obs), plain.actor(obs))


@pytest.mark.filterwarnings("ignore:`torch.jit.trace")
def test_its_actor_can_be_traced() -> None:
    net, obs = policy(action_l2=0.7), batch()
    traced = th.jit.trace(net.actor, (obs,))  # traces twice and compares
    assert th.equal(traced(obs), net.actor(obs))


def test_what_is_left_open_is_the_default_and_a_chosen_kernel_stays() -> None:
    def made(**settings: Any) -> GoalPolicy:
        return GoalPolicy(OBSERVATIONS, ACTIONS, lambda _: 1e-3, **settings)

    assert made(net_arch=None).net_arch == made().net_arch == [256, 256, 256]
    (group,) = made().actor.optimizer.param_groups
    assert group["fused"]
    (group,) = made(optimizer_kwargs={"foreach": True}).actor.optimizer.param_groups
    assert group["foreach"] and not group["fused"]


def test_the_target_critic_alone_stays_within_the_bounds() -> None:
    obs, actions = batch(256), th.rand(256, 4) * 2.0 - 1.0
    free = policy()
    live = free.critic(obs, actions)[0]
    low, high = live.median().item() - 0.01, live.median().item() + 0.01
    net = policy(target_clip=(low, high))
    for part in (net.critic, net.critic_target):
        part.load_state_dict(free.critic.state_dict())
    assert th.equal(net.critic(obs, actions)[0], live)
    target = net.critic_target(obs, actions)[0]
    assert th.equal(target, live.clamp(low, high))
    assert live.min() < low and live.max() > high


def test_critics_have_layer_norm_and_the_actor_none() -> None:
    net = policy()
    for critic in (net.critic, net.critic_target):
        assert sum(isinstance(layer, LayerNorm) for layer in critic.modules()) == 2
    assert not any(isinstance(layer, LayerNorm) for layer in net.actor.modules())


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_a_saved_model_keeps_its_settings(algorithm: type[Any], tmp_path: Path) -> None:
    env = make_vec(TASK, 2, 1)
    settings = {"action_l2": 0.5, "target_clip": [-50, 0], "net_arch": [16, 16]}
    model: BaseAlgorithm = algorithm(
        GoalPolicy,
        env,
        train_freq=50,
        learning_starts=100,
        gradient_steps=2,
        batch_size=16,
        buffer_size=1000,
        replay_buffer_class=FollowObjectReplayBuffer,
        policy_kwargs=settings,
        seed=0,
    )
    model.learn(200)
    model.save(tmp_path / "model")
    again = algorithm.load(tmp_path / "model", env)
    obs = env.reset()
    assert np.array_equal(model.predict(obs)[0], again.predict(obs)[0])
    assert (again.policy.action_l2, again.policy.target_clip) == (0.5, (-50.0, 0.0))
    assert again.policy.critic_target.bounds == (-50.0, 0.0)
    model.policy.save(tmp_path / "policy")
    alone = GoalPolicy.load(tmp_path / "policy")
    assert np.array_equal(model.predict(obs)[0], alone.predict(obs)[0])
    assert (alone.action_l2, alone.target_clip) == (0.5, (-50.0, 0.0))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"action_l2": -1.0}, "action_l2 is -1.0; it must lie in [0, inf)"),
        ({"target_clip": (0.0, -50.0)}, "must be (low, high) with low <= high or None, not (0.0"),
        ({"target_clip": "auto"}, "must be (low, high) with low <= high or None, not 'auto'"),
        ({"mirrors": "auto"}, "GoalPolicy is without mirrors: leave mirrors out"),
    ],
)
def test_what_cannot_be_meant_is_refused(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        policy(**settings)


def test_each_policy_is_refused_by_algorithms_that_it_is_not_for() -> None:
    env = make_vec(TASK, 1, 1)
    with pytest.raises(
        ValueError, match=r"GoalPolicy is for DDPG and TD3, .*: with SAC and TQC take"
    ):
        SAC(GoalPolicy, env, buffer_size=100)
    of_sac = {"activation_fn": LayerNormReLU}  # what the sentence says to take
    SAC("MultiInputPolicy", env, buffer_size=100, policy_kwargs=of_sac)
    with pytest.raises(ValueError, match="HerDDPG wants a HerPolicy, not GoalPolicy"):
        HerDDPG(GoalPolicy, env, buffer_size=100)  # type: ignore[arg-type]
    shared = {"share_features_extractor": True}
    with pytest.raises(ValueError, match="'share_features_extractor'; known are net_arch") as error:
        HerDDPG("MultiInputPolicy", env, buffer_size=100, policy_kwargs=shared)
    assert "features_extractor_class" not in str(error.value)  # which is refused, too
    model = DDPG(HerPolicy, env, buffer_size=1000, learning_starts=100, batch_size=8)
    model.predict(env.reset())  # nothing is learned yet
    with pytest.raises(ValueError, match="HerPolicy is HerDDPG's alone"):
        model.learn(200)
