"""What HerDDPG adds to DDPG: each piece alone, and that it learns."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_models import TINY, make_model, success_rate
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import HORIZON, PointEnv

from sb3_follow_object.callbacks.rollout import run_episodes
from sb3_follow_object.ddpg.actor_files import load_actor, save_actor
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import make_vec
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


@pytest.mark.parametrize("layer_norm", [False, True])
def test_learns_to_reach(layer_norm: bool) -> None:
    model = make_model(policy_kwargs={"net_arch": [64, 64], "critic_layer_norm": layer_norm})
    before = success_rate(model)
    model.learn(4000, log_interval=None)  # type: ignore[arg-type]
    assert before < 0.5
    assert success_rate(model) > 0.9


def test_learns_fetch_reach() -> None:
    env = make_vec("FetchReach-v4", 2, seed=0)
    model = HerDDPG("MultiInputPolicy", env, batch_size=128, buffer_size=10_000, seed=0)
    model.learn(1500, log_interval=None)  # type: ignore[arg-type]
    test_env = make_vec("FetchReach-v4", 2, seed=100)
    result = run_episodes(lambda obs: model.predict(obs, deterministic=True)[0], test_env, 10)
    assert result.success_rate >= 0.9


def test_targets_lie_in_the_range_of_returns() -> None:
    model = make_model()
    assert model._target_bounds() == (pytest.approx(-10.0), 0.0)
    model.learn(1200, log_interval=None)  # type: ignore[arg-type]
    data = model.replay_buffer.sample(1000)  # type: ignore[union-attr]
    with th.no_grad():
        q = model.critic(data.observations, data.actions)[0]
    assert q.min() > -11.5 and q.max() < 1.5
    assert make_model(target_clip=None)._target_bounds() == (-np.inf, np.inf)
    assert make_model(target_clip=(-3, 1))._target_bounds() == (-3.0, 1.0)


def test_targets_are_clipped() -> None:
    """With every target at the bound the critic learns the bound and nothing else."""
    model = make_model(target_clip=(-2.0, -2.0), learning_rate=3e-3)
    model.learn(1200, log_interval=None)  # type: ignore[arg-type]
    model.train(300, 64)
    data = model.replay_buffer.sample(500)  # type: ignore[union-attr]
    with th.no_grad():
        q = model.critic(data.observations, data.actions)[0]
    assert float((q + 2.0).abs().mean()) < 0.2


def test_targets_are_no_lower_than_the_episode_proves() -> None:
    """With every other target at its lowest the critic learns the bounds themselves."""
    model = make_model(target_clip=(-10.0, -10.0), learning_rate=3e-3, hindsight_bound=True)
    model.learn(1200, log_interval=None)  # type: ignore[arg-type]
    model.train(600, 64)
    data, steps = model._sample(500)
    known = th.isfinite(steps)
    bound = (0.9**steps - 1.0) / (1.0 - 0.9)
    with th.no_grad():
        q = model.critic(data.observations, data.actions)[0]
    assert float((q - bound)[known].abs().mean()) < 2.0 < float(q[known].mean() + 10.0)


@pytest.mark.parametrize("precision", ["highest", "medium"])
def test_matmul_precision_is_that_of_the_update_alone(
    precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = th.get_float32_matmul_precision()
    model = make_model(matmul_precision=precision)
    train, seen = model._train, []

    def note(*arguments: Any) -> None:
        seen.append(th.get_float32_matmul_precision())
        train(*arguments)

    monkeypatch.setattr(model, "_train", note)
    model.learn(100, log_interval=None)  # type: ignore[arg-type]
    assert th.get_float32_matmul_precision() == before
    assert set(seen) == {precision}


def test_predict_uses_the_averaged_actor_and_exploration_the_live_one() -> None:
    plain, averaged = make_model(), make_model(average_decay=0.99, noise_std=0.0)
    for model in (plain, averaged):
        model.random_action_prob = 0.0
        model.learn(400, log_interval=None)  # type: ignore[arg-type]
    for a, b in zip(plain.actor.parameters(), plain.policy.actor_average.parameters(), strict=True):
        assert th.equal(a, b)
    obs = averaged._last_obs
    live = averaged.actor.predict(obs, deterministic=True)[0]  # type: ignore[arg-type]
    shown = averaged.predict(obs, deterministic=True)[0]  # type: ignore[arg-type]
    assert np.abs(live - shown).max() > 1e-4
    np.testing.assert_allclose(averaged._sample_action(0, None, 4)[0], live, atol=1e-6)
    again = averaged.actor.predict(obs, deterministic=True)[0]  # type: ignore[arg-type]
    np.testing.assert_array_equal(again, live)


def test_average_of_the_actor_is_a_plain_mean_at_first() -> None:
    model = make_model(average_decay=0.999)
    seen = []
    update = model.policy.update_average

    def spy(decay: float) -> None:
        seen.append(decay)
        update(decay)

    model.policy.update_average = spy  # type: ignore[method-assign]
    model.learn(4 * 3 * HORIZON, log_interval=None)  # type: ignore[arg-type]
    assert seen[:3] == pytest.approx([0.0, 1 / 2, 2 / 3])


def test_action_l2_keeps_actions_small() -> None:
    sizes = []
    for weight in (0.0, 10.0):
        model = make_model(action_l2=weight)
        model.learn(1200, log_interval=None)  # type: ignore[arg-type]
        data = model.replay_buffer.sample(500)  # type: ignore[union-attr]
        with th.no_grad():
            sizes.append(float(model.actor(data.observations).square().mean()))
    assert sizes[1] < 0.5 * sizes[0]


def test_inputs_are_standardised_by_what_is_stored() -> None:
    model = make_model()
    model.learn(1000, log_interval=None)  # type: ignore[arg-type]
    buffer = model.replay_buffer
    assert buffer is not None
    seen = buffer.observations["observation"][: buffer.pos].reshape(-1, 3)
    for net in (model.actor, model.actor_target, model.critic, model.critic_target):
        extractor: Any = net.features_extractor
        np.testing.assert_allclose(extractor.mean[:3], seen.mean(axis=0), atol=1e-3)
        np.testing.assert_allclose(extractor.std[:3], seen.std(axis=0), rtol=1e-2)
    features = model.actor.features_extractor(
        {key: th.full((1, 3), 1e6) for key in ("observation", "achieved_goal", "desired_goal")}
    )
    assert features.max() == 5.0


def test_exploration_mixes_uniform_actions_in() -> None:
    model = make_model(n_envs=100, random_action_prob=1.0, noise_std=0.0)
    model._setup_learn(1000)
    actions = np.concatenate([model._sample_action(0, None, 100)[1] for _ in range(20)])
    assert abs(actions.mean()) < 0.05 and abs(actions.std() - 1 / np.sqrt(3)) < 0.02
    quiet = make_model(n_envs=1, random_action_prob=0.0, noise_std=0.0)
    quiet._setup_learn(1000)
    wanted = quiet.predict(quiet._last_obs, deterministic=True)[0]  # type: ignore[arg-type]
    np.testing.assert_allclose(quiet._sample_action(0, None, 1)[1], wanted, rtol=1e-6)


def test_exploration_adds_noise_of_the_given_size() -> None:
    model = make_model(n_envs=100, random_action_prob=0.0, noise_std=0.1)
    model._setup_learn(1000)
    wanted = model.actor.predict(model._last_obs, deterministic=True)[0]  # type: ignore[arg-type]
    noise = np.concatenate([model._sample_action(0, None, 100)[1] - wanted for _ in range(20)])
    inside = np.tile(np.abs(wanted) < 0.5, (20, 1))  # not clipped
    assert noise[inside].std() == pytest.approx(0.1, rel=0.1)
    assert abs(noise[inside].mean()) < 0.01


def test_target_networks_move_once_an_interval() -> None:
    model = make_model(target_update_interval=5, tau=1.0, gradient_steps=4)
    model.learn(HORIZON * 4, log_interval=None)  # type: ignore[arg-type]
    live, target = model._trained_parameters()
    assert any(not th.equal(a, b) for a, b in zip(live, target, strict=True))
    model.train(1, 64)
    assert all(th.equal(a, b) for a, b in zip(live, target, strict=True))


def test_the_actor_learns_once_in_so_many_updates_and_the_critic_in_each() -> None:
    model = make_model(policy_delay=3)
    model.learn(600, log_interval=None)  # type: ignore[arg-type]
    model._n_updates = 0

    def weights(network: th.nn.Module) -> th.Tensor:
        return th.cat([w.detach().flatten().clone() for w in network.parameters()])

    moved = []
    for _ in range(6):
        actor, critic = weights(model.actor.mu), weights(model.critic)
        model.logger.name_to_value.clear()
        model.train(1, 64)
        assert not th.equal(critic, weights(model.critic))
        moved.append(not th.equal(actor, weights(model.actor.mu)))
        assert ("train/actor_loss" in model.logger.name_to_value) == moved[-1]
    assert moved == [False, False, True] * 2
    model.train(3, 64)
    assert np.isfinite(model.logger.name_to_value["train/actor_loss"])


def test_episodes_of_several_environments() -> None:
    env = make_vec("FetchReach-v4", 2, seed=0)
    tiny = {"gradient_steps": 1, "batch_size": 8, "buffer_size": 1000}
    model = HerDDPG("MultiInputPolicy", env, seed=0, **tiny)
    model.learn(150, log_interval=None)  # type: ignore[arg-type]
    assert model.num_timesteps == 200  # whole episodes of 50 steps, two at a time
    assert model.gamma == pytest.approx(0.98)
    with pytest.raises(ValueError, match="how long its episodes are"):
        HerDDPG("MultiInputPolicy", DummyVecEnv([PointEnv]))


def test_episodes_of_several_environments_are_those_of_the_one_that_it_has(tmp_path: Any) -> None:
    def reach(n_envs: int, steps: int) -> DummyVecEnv:
        make = partial(gym.make, "FetchReach-v4", max_episode_steps=steps)
        return DummyVecEnv([make] * n_envs)

    def freq_of(model: HerDDPG) -> tuple[int, str]:
        return model.train_freq.frequency, model.train_freq.unit.value  # type: ignore[union-attr]

    file = tmp_path / "model"
    model = HerDDPG("MultiInputPolicy", reach(2, 50), buffer_size=1000)
    assert freq_of(model) == (50, "step")
    model.save(file)
    assert freq_of(HerDDPG.load(file, env=reach(2, 30))) == (30, "step")
    assert freq_of(HerDDPG.load(file, env=reach(2, 30), train_freq=20)) == (20, "step")
    assert freq_of(HerDDPG.load(file, env=reach(1, 30))) == (1, "episode")
    loaded = HerDDPG.load(file)
    loaded.set_env(reach(2, 30))
    assert freq_of(loaded) == (30, "step")


def test_same_seed_same_result() -> None:
    results = []
    for seed in (0, 0, 1):
        model = make_model(seed=seed)
        model.learn(1000, log_interval=None)  # type: ignore[arg-type]
        results.append(th.cat([p.detach().ravel() for p in model.actor.parameters()]))
    assert th.equal(results[0], results[1])
    assert not th.equal(results[0], results[2])


def test_sb3_saves_and_loads_it(tmp_path: Any) -> None:
    model = make_model()
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=model.env)
    np.testing.assert_array_equal(loaded.moments.mean, model.moments.mean)
    assert loaded.moments.count == model.moments.count
    obs = model.env.reset()  # type: ignore[union-attr]
    np.testing.assert_array_equal(
        model.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
        loaded.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
    )
    loaded.learn(80, log_interval=None)  # type: ignore[arg-type]


def test_moments_of_a_loaded_buffer_are_counted_once(tmp_path: Any) -> None:
    model = make_model()
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    count = float(model.moments.count)
    # The model that it is of, that model loaded, and a longer one: none sees the content anew.
    loaded = HerDDPG.load(tmp_path / "model", env=model.env)
    longer = make_model()
    longer.learn(800, log_interval=None)  # type: ignore[arg-type]
    for other, before in ((model, count), (loaded, count), (longer, float(longer.moments.count))):
        other.load_replay_buffer(tmp_path / "buffer")
        other._update_moments()
        assert other.moments.count == before
    fresh = make_model()
    fresh.load_replay_buffer(tmp_path / "buffer")
    fresh._update_moments()
    np.testing.assert_allclose(fresh.moments.mean, model.moments.mean, atol=1e-6)
    assert fresh.moments.count == pytest.approx(count)


def test_moments_take_in_a_buffer_as_long_as_a_rollout() -> None:
    model = make_model(buffer_size=4 * HORIZON)  # of every environment
    model.learn(4 * HORIZON * 3, log_interval=None)  # type: ignore[arg-type]
    # Each step is two samples: the goal shown and the one achieved.
    assert model.moments.count == pytest.approx(2 * 4 * HORIZON * 3, rel=1e-3)


def test_actor_file_needs_no_training_code(tmp_path: Any) -> None:
    model = make_model()
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    save_actor(tmp_path / "actor", model.actor, "Point-v0")
    spaces = model.observation_space, model.action_space
    actor, env_id = load_actor(tmp_path / "actor", *spaces)  # type: ignore[arg-type]
    obs = model.env.reset()  # type: ignore[union-attr]
    assert env_id == "Point-v0"
    np.testing.assert_array_equal(
        actor.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
        model.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
    )
    (tmp_path / "actor").write_bytes((tmp_path / "actor").read_bytes()[:-100])
    with pytest.raises(ValueError, match="not a whole checkpoint"):
        load_actor(tmp_path / "actor", *spaces)  # type: ignore[arg-type]


def test_actor_file_keeps_clip_and_activation(tmp_path: Any) -> None:
    model = make_model(policy_kwargs={"features_clip": 0.5, "activation_fn": th.nn.Tanh})
    model.learn(80, log_interval=None)  # type: ignore[arg-type]
    save_actor(tmp_path / "actor", model.actor, "Point-v0")
    actor, _ = load_actor(tmp_path / "actor", model.observation_space, model.action_space)  # type: ignore[arg-type]
    obs = model.env.reset()  # type: ignore[union-attr]
    np.testing.assert_array_equal(
        actor.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
        model.predict(obs, deterministic=True)[0],  # type: ignore[arg-type]
    )
    odd = make_model(policy_kwargs={"activation_fn": th.nn.Hardswish})
    with pytest.raises(ValueError, match="can name the activations ReLU, Tanh"):
        save_actor(tmp_path / "odd", odd.actor, "Point-v0")
    assert not (tmp_path / "odd").exists()


def test_environment_without_goals_is_refused() -> None:
    with pytest.raises(ValueError, match="lack achieved_goal, desired_goal, observation"):
        HerDDPG("MultiInputPolicy", gym.make("Pendulum-v1"))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"random_action_prob": 1.5}, "random_action_prob is 1.5; it must lie in"),
        ({"noise_std": -1.0}, "noise_std is -1.0; it must lie in"),
        ({"target_update_interval": 0}, "target_update_interval is 0"),
        ({"average_decay": 1.0}, "average_decay is 1.0"),
        ({"matmul_precision": "low"}, "matmul_precision must be .*, not 'low'"),
        (
            {"policy_kwargs": {"features_extractor_class": object}},
            "policy_kwargs has no setting .features_extractor_class.; known are",
        ),
        ({"target_clip": "wide"}, "target_clip must be .*, not 'wide'"),
        ({"target_clip": [0.0, -1.0]}, "target_clip must be .low, high."),
        ({"target_clip": [0.0]}, "target_clip must be .low, high."),
        ({"optimize_memory_usage": True}, "cannot have optimize_memory_usage"),
        ({"gamma": 1.0}, "gamma is 1.0; it must lie in"),
        ({"tau": 2.0}, "tau is 2.0; it must lie in"),
        ({"batch_size": 0}, "batch_size is 0; it must be at least 1"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make_model(**arguments)


def test_vec_normalize_is_refused() -> None:
    """It would standardise twice."""
    with pytest.raises(ValueError, match="leave VecNormalize"):
        HerDDPG("MultiInputPolicy", VecNormalize(DummyVecEnv([PointEnv])), **TINY)


class Paid(PointEnv):
    """Rewards of 0 and 1."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return super().compute_reward(achieved, desired, info) + 1.0


class Far(PointEnv):
    """Rewards of minus a distance, in centimetres."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -100.0 * np.linalg.norm(np.subtract(achieved, desired), axis=-1)


@pytest.mark.parametrize(
    ("made", "said", "bounds"), [(Paid, "1", (0.0, 10.0)), (Far, "-[0-9.]+", (-1000.0, 0.0))]
)
def test_rewards_beyond_the_bounds_of_targets_are_refused(
    made: type[PointEnv], said: str, bounds: tuple[float, float]
) -> None:
    env = DummyVecEnv([made] * 4)
    with pytest.raises(ValueError, match=f"a reward is {said}; target_clip 'auto' is for rewards"):
        HerDDPG("MultiInputPolicy", env, **TINY).learn(100)
    HerDDPG("MultiInputPolicy", env, **TINY, target_clip=bounds).learn(100)


@pytest.mark.parametrize("loaded", [False, True])
def test_rewards_of_another_environment_are_checked_too(loaded: bool, tmp_path: Any) -> None:
    model = make_model()
    model.learn(100)
    other: Any = DummyVecEnv([Far] * 4)
    if loaded:
        model.save(tmp_path / "model")
        model = HerDDPG.load(tmp_path / "model", env=other)
    else:
        model.set_env(other)
    with pytest.raises(ValueError, match=r"a reward is .* target_clip 'auto' is for rewards"):
        model.learn(100)


@pytest.mark.parametrize(
    "part", [gym.spaces.Box(0, 255, (8, 8, 1), np.uint8), gym.spaces.MultiDiscrete([3, 2])]
)
def test_observations_that_are_no_numbers_are_refused(part: gym.spaces.Space) -> None:
    """SB3 prepares them in `predict`, where HerDDPG standardises what is stored."""

    class Seen(PointEnv):
        def __init__(self) -> None:
            super().__init__()
            entries = dict(self.observation_space.spaces)  # type: ignore[attr-defined]
            self.observation_space = gym.spaces.Dict({**entries, "observation": part})

    with pytest.raises(ValueError, match=r"the observation's observation is .*needs a Box"):
        HerDDPG("MultiInputPolicy", DummyVecEnv([Seen]), **TINY)


def test_a_model_trained_in_graphs_is_loaded_without_them(tmp_path: Any) -> None:
    model = make_model(policy_kwargs={"net_arch": [8], "optimizer_kwargs": {"fused": False}})
    model.learn(100, log_interval=None)  # type: ignore[arg-type]
    for group in model.actor.optimizer.param_groups:
        group["capturable"] = True  # as training on CUDA leaves it
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=model.env)
    loaded.learn(100, log_interval=None)  # type: ignore[arg-type]
    assert not any(group["capturable"] for group in loaded.actor.optimizer.param_groups)


def test_a_bound_that_the_replay_buffer_cannot_give_is_refused() -> None:
    with pytest.raises(ValueError, match="hindsight_bound needs a FollowObjectReplayBuffer"):
        make_model(replay_buffer_class=HerReplayBuffer, hindsight_bound=True)


def test_other_optimisers_and_observations_of_more_dimensions() -> None:
    class Square(PointEnv):
        def __init__(self) -> None:
            super().__init__()
            entries = dict(self.observation_space.spaces)  # type: ignore[attr-defined]
            entries["observation"] = gym.spaces.Box(-np.inf, np.inf, (3, 1))
            self.observation_space = gym.spaces.Dict(entries)

        def _observe(self) -> dict[str, np.ndarray]:
            obs = super()._observe()
            return {**obs, "observation": obs["observation"].reshape(3, 1).astype(np.float32)}

    policy_kwargs = {"net_arch": [8], "optimizer_class": th.optim.RMSprop}
    env = DummyVecEnv([Square] * 2)
    model = HerDDPG("MultiInputPolicy", env, **{**TINY, "policy_kwargs": policy_kwargs})
    model.learn(100, log_interval=None)  # type: ignore[arg-type]
    assert isinstance(model.actor.optimizer, th.optim.RMSprop)


class Counting(FollowObjectReplayBuffer):
    """Draws as ever, and counts."""

    drawn = 0

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        self.drawn += 1
        return super().sample(*args, **kwargs)


def test_the_sample_of_a_subclass_is_asked() -> None:
    model = make_model(replay_buffer_class=Counting)
    model.learn(200, log_interval=None)  # type: ignore[arg-type]
    assert isinstance(model.replay_buffer, Counting) and model.replay_buffer.drawn > 0
    with pytest.raises(ValueError, match="Counting has another sample"):
        make_model(replay_buffer_class=Counting, hindsight_bound=True)
