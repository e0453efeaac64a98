"""A second reward with its own critic: what it learns, what the actor makes of it, resuming."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from small_models import TINY, make_model
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import PointEnv

from sb3_follow_object.ddpg.auxiliary import AuxiliaryReward, Transitions
from sb3_follow_object.ddpg.her_ddpg import HerDDPG


class UpReward(AuxiliaryReward):
    """Pays for the height of the action and learns how many batches there were."""

    name: ClassVar[str] = "up"
    n_batches: th.Tensor

    def __init__(self, n_features: int, high: float = 2.0) -> None:
        super().__init__()
        self.reward_range = (0.0, high)
        self.register_buffer("n_batches", th.zeros(()))

    def forward(self, batch: Transitions) -> th.Tensor:
        return 1.0 + batch.actions[:, 2:]

    def update(self, batch: Transitions) -> None:
        self.n_batches += 1


UP: dict[str, Any] = {"name": UpReward}


def heights(model: HerDDPG) -> float:
    data = model.replay_buffer.sample(500)  # type: ignore[union-attr]
    with th.no_grad():
        return float(model.actor(data.observations)[:, 2].mean())


def weights(model: HerDDPG) -> np.ndarray:
    assert model.auxiliary_critic is not None
    parts = [*model.policy.parameters(), *model.auxiliary_critic.parameters()]
    return th.cat([p.detach().ravel() for p in parts]).numpy()


def test_actor_maximises_the_sum_of_both_values() -> None:
    without = make_model(action_l2=0.1, auxiliary={**UP, "weight": 0.0})
    with_it = make_model(action_l2=0.1, auxiliary=UP)
    for model in (without, with_it):
        model.learn(1200, log_interval=None)  # type: ignore[arg-type]
    assert heights(with_it) > 0.8 > 0.5 > heights(without)


def test_critic_learns_the_discounted_sum_within_the_range_of_its_reward() -> None:
    model = make_model(auxiliary={**UP, "weight": 0.0}, learning_rate=3e-3, gamma=0.5)
    model.learn(1200, log_interval=None)  # type: ignore[arg-type]
    critic = model.auxiliary_critic
    assert critic is not None
    assert critic.bounds == (0.0, pytest.approx(4.0))
    model.train(300, 64)
    data = model.replay_buffer.sample(500)  # type: ignore[union-attr]
    features = model.actor.features_extractor
    with th.no_grad():
        x, next_x = features(data.observations), features(data.next_observations)
        q = critic.q_networks[0](th.cat([x, data.actions], dim=1))
        next_actions = model.actor.mu(next_x)
        next_q = critic.q_networks[0](th.cat([next_x, next_actions], dim=1))
    wanted = (1.0 + data.actions[:, 2:] + 0.5 * next_q).clamp(0.0, 4.0)
    assert float((q - wanted).abs().mean()) < 0.2 < float(q.std())


def test_main_critic_does_not_know_of_it() -> None:
    """With an actor that ignores the second critic everything else is learned as without one."""
    plain = make_model()
    beside = make_model(auxiliary={**UP, "weight": 0.0})
    for model in (plain, beside):
        model.learn(800, log_interval=None)  # type: ignore[arg-type]
    for a, b in zip(plain.policy.parameters(), beside.policy.parameters(), strict=True):
        assert th.equal(a, b)


@pytest.mark.parametrize("auxiliary", [UP, {"name": "rnd", "hidden": [16]}], ids=["up", "rnd"])
def test_training_state_is_complete(auxiliary: dict[str, Any]) -> None:
    model = make_model(auxiliary=auxiliary, target_update_interval=3)
    model.learn(800, log_interval=None)  # type: ignore[arg-type]
    other = make_model(auxiliary=auxiliary, target_update_interval=3, seed=1)
    other.learn(80, log_interval=None)  # type: ignore[arg-type]
    other.replay_buffer = model.replay_buffer
    assert not np.array_equal(weights(model), weights(other))
    other.load_training_state(copy.deepcopy(model.training_state()))
    rng = model.replay_buffer.rng.bit_generator.state  # type: ignore[union-attr]
    for each in (model, other):
        each.replay_buffer.rng.bit_generator.state = rng  # type: ignore[union-attr]
        each.train(5, 64)
    np.testing.assert_array_equal(weights(model), weights(other))


@pytest.mark.parametrize("auxiliary", [UP, {"name": "rnd", "hidden": [16]}], ids=["up", "rnd"])
def test_sb3_saves_and_loads_it(auxiliary: dict[str, Any], tmp_path: Any) -> None:
    model = make_model(auxiliary=auxiliary)
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=model.env)
    np.testing.assert_array_equal(weights(loaded), weights(model))
    assert loaded.auxiliary_critic is not None and model.auxiliary_critic is not None
    for (name, a), b in zip(
        model.auxiliary_critic.optimizers.items(),
        loaded.auxiliary_critic.optimizers.values(),
        strict=True,
    ):
        steps = [o.state_dict()["state"][0]["step"] for o in (a, b)]
        assert steps[0] == steps[1] > 0, name
    loaded.learn(80, log_interval=None)  # type: ignore[arg-type]


def test_log_has_means_of_an_update_phase() -> None:
    model = make_model(auxiliary=UP)
    model.learn(800, log_interval=None)  # type: ignore[arg-type]
    model.train(20, 64)
    logged = model.logger.name_to_value
    assert 0.0 <= logged["up/reward"] <= 2.0
    assert {"up/q_mean", "up/critic_loss", "train/reward_mean"} <= set(logged)
    assert -1.0 <= logged["train/reward_mean"] <= 0.0


@pytest.mark.parametrize(
    ("auxiliary", "sentence"),
    [
        ({"name": "rdn"}, "auxiliary has no reward 'rdn'; did you mean 'rnd'"),
        ({"weight": 1.0}, "give a mapping with a name"),
        ("rnd", "auxiliary must be a mapping, not 'rnd'"),
        ({"name": "rnd", "max_bonis": 1}, "no setting 'max_bonis'; did you mean 'max_bonus'"),
        ({"name": "rnd", "n_features": 1}, r"auxiliary \(rnd\) has no setting 'n_features'"),
        ({"name": "rnd", "weight": -1.0}, "weight is -1.0; it must lie in"),
        ({"name": "rnd", "learning_rate": 0.0}, "learning_rate is 0.0; it must lie in"),
        ({"name": "rnd", "n_outputs": 0}, "n_outputs is 0; it must be at least 1"),
    ],
)
def test_bad_settings_are_one_sentence(auxiliary: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make_model(auxiliary=auxiliary)


def test_normalised_environments_are_refused() -> None:
    env = VecNormalize(DummyVecEnv([PointEnv]))
    with pytest.raises(ValueError, match="leave VecNormalize"):
        HerDDPG("MultiInputPolicy", env, auxiliary=UP, **TINY)


def test_means_are_of_the_updates_that_had_a_value() -> None:
    critic = make_model(auxiliary=UP, policy_delay=4).auxiliary_critic
    assert critic is not None
    for number in range(1, 9):
        critic._log(reward=th.tensor(float(number)))
        if number % 4 == 0:  # when the actor's turn comes
            critic._log(q_mean=th.tensor(-2.0))
    assert critic.take_log() == {"up/reward": 4.5, "up/q_mean": -2.0}
    assert critic.take_log() == {}


def test_a_reward_that_takes_no_features_is_refused_with_what_it_lacks() -> None:
    class Poor(AuxiliaryReward):
        name: ClassVar[str] = "poor"
        reward_range = (0.0, 1.0)

    class Open(Poor):
        def __init__(self, **given: Any) -> None:
            super().__init__()

    class Closed(Poor):
        def __init__(self) -> None:
            super().__init__()

    for reward in (Poor, Closed):
        with pytest.raises(
            ValueError, match=f"{reward.__name__} must take the argument 'n_features'"
        ):
            make_model(auxiliary={"name": reward})
    make_model(auxiliary={"name": Open})


def test_a_state_of_graphs_on_cuda_goes_on_without_them() -> None:
    networks = {"net_arch": [8], "optimizer_kwargs": {"fused": False}}
    model, other = (make_model(policy_kwargs=networks) for _ in range(2))
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    state = copy.deepcopy(model.training_state())
    for part in ("actor_optimizer", "critic_optimizer"):
        for group in state[part]["param_groups"]:
            group["capturable"] = True
    other.load_training_state(state)
    other.replay_buffer.load_state_dict(model.replay_buffer.state_dict())  # type: ignore[union-attr]
    other.set_logger(model.logger)
    other.train(1, 16)
    assert other.policy.actor.optimizer.param_groups[0]["capturable"] is False
