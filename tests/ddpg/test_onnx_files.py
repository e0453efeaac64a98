"""ONNX files act as `predict` does: normaliser, averaged weights and clipping inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import onnxruntime
import pytest
import torch as th
import toy
from gymnasium import spaces
from sb3_contrib import TQC
from small_models import make_model
from stable_baselines3 import DQN, PPO, SAC, TD3

from sb3_follow_object import HerDDPG, LayerNormReLU, load_actor, make_vec, save_actor
from sb3_follow_object.ddpg import onnx_files
from sb3_follow_object.ddpg.onnx_files import export_onnx

TASK = "FollowObject/PushSideGap-v0"


def tiny() -> dict[str, Any]:
    return {"policy_kwargs": {"net_arch": [8]}}  # a new one: SB3 writes into it


def actions_of(file: Path, obs: dict[str, np.ndarray]) -> Any:
    session = onnxruntime.InferenceSession(file)
    given = {name: value.astype(np.float32) for name, value in obs.items()}
    return session.run(None, given)[0]


@pytest.fixture
def normalising() -> HerDDPG:
    model = HerDDPG("MultiInputPolicy", make_vec(TASK, 2, 1), **tiny(), buffer_size=2000)
    n = model.policy.actor.features_extractor.features_dim
    model.policy.set_moments(th.linspace(-1.0, 1.0, n), th.linspace(0.01, 2.0, n))
    with th.no_grad():  # predict asks the averaged actor
        model.policy.actor_average.mu[0].weight.mul_(3.0)
    return model


@pytest.mark.parametrize("n", [1, 5])
def test_actions_are_those_of_predict_in_batches_of_any_size(
    normalising: HerDDPG, n: int, tmp_path: Path
) -> None:
    file = tmp_path / "policy.onnx"
    assert export_onnx(normalising, file) <= 1e-5
    env = make_vec(TASK, n, 1, seed=3)
    obs = env.reset()
    obs["observation"][0] = 1e4  # clipped to 5 standard deviations
    wanted, _ = normalising.predict(obs, deterministic=True)
    np.testing.assert_allclose(actions_of(file, obs), wanted, atol=1e-5)


def test_saved_actor_has_the_same_file_as_its_model(normalising: HerDDPG, tmp_path: Path) -> None:
    env = normalising.get_env()
    save_actor(tmp_path / "policy.safetensors", normalising.policy.actor_average, TASK)
    actor, _ = load_actor(tmp_path / "policy.safetensors", env.observation_space, env.action_space)
    export_onnx(actor, tmp_path / "actor.onnx")
    export_onnx(normalising, tmp_path / "model.onnx")
    obs = env.reset()
    first, second = (actions_of(tmp_path / f"{name}.onnx", obs) for name in ("actor", "model"))
    np.testing.assert_array_equal(first, second)


def test_every_key_of_the_observation_is_an_input(normalising: HerDDPG, tmp_path: Path) -> None:
    export_onnx(normalising, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    inputs = {value.name: (value.shape, value.type) for value in session.get_inputs()}
    assert inputs == {
        "achieved_goal": (["batch", 3], "tensor(float)"),
        "desired_goal": (["batch", 3], "tensor(float)"),
        "observation": (["batch", 25], "tensor(float)"),
    }
    (output,) = session.get_outputs()
    assert (output.name, output.shape) == ("action", ["batch", 4])


@pytest.mark.parametrize("algorithm", [SAC, TD3, PPO])
def test_stock_algorithms_on_goal_environments(algorithm: type, tmp_path: Path) -> None:
    small = {} if algorithm is PPO else {"buffer_size": 100}
    model = algorithm("MultiInputPolicy", make_vec(TASK, 1, 1), **tiny(), **small)
    assert export_onnx(model, tmp_path / "policy.onnx") <= 1e-5


@pytest.mark.parametrize("algorithm", [SAC, TQC])
def test_networks_with_our_activation_are_written(algorithm: Any, tmp_path: Path) -> None:
    networks = {"net_arch": [8], "activation_fn": LayerNormReLU}
    env = make_vec(TASK, 1, 1)
    model = algorithm("MultiInputPolicy", env, policy_kwargs=networks, buffer_size=100)
    assert export_onnx(model, tmp_path / "policy.onnx") <= 1e-5


def test_a_policy_that_cannot_be_copied_is_refused(tmp_path: Path) -> None:
    model = PPO("MultiInputPolicy", toy.PointEnv(), use_sde=True, **tiny())
    with pytest.raises(ValueError, match="MultiInputActorCriticPolicy cannot be written as ONNX"):
        export_onnx(model, tmp_path / "policy.onnx")


class Wide(toy.PointEnv):
    """Actions that are not in [-1, 1]."""

    def __init__(self) -> None:
        super().__init__()
        n = self.action_space.shape[0]
        self.action_space = spaces.Box(np.float32(-3.0), np.float32(1.0), (n,))


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_actions_keep_to_their_bounds(algorithm: type, tmp_path: Path) -> None:
    small = {} if algorithm is PPO else {"buffer_size": 100}
    model = algorithm("MultiInputPolicy", Wide(), **tiny(), **small)
    with th.no_grad():
        head = model.actor.mu if algorithm is SAC else model.policy.action_net
        head.bias.fill_(-50.0)  # far outside
    export_onnx(model, tmp_path / "policy.onnx")
    obs, _ = Wide().reset(seed=0)
    actions = actions_of(tmp_path / "policy.onnx", {k: v[None] for k, v in obs.items()})
    np.testing.assert_allclose(actions, np.full_like(actions, -3.0))


def test_discrete_actions_and_observations_without_keys(tmp_path: Path) -> None:
    model = DQN("MlpPolicy", "CartPole-v1", **tiny(), buffer_size=100)
    assert export_onnx(model, tmp_path / "policy.onnx") == 0.0
    obs = gym.make("CartPole-v1").reset(seed=0)[0]
    wanted, _ = model.predict(obs, deterministic=True)
    assert actions_of(tmp_path / "policy.onnx", {"observation": obs[None]})[0] == wanted


def test_exporting_changes_no_model(tmp_path: Path) -> None:
    model = make_model(2, buffer_size=400)
    model.policy.set_training_mode(True)
    state = th.random.get_rng_state()
    export_onnx(model, tmp_path / "policy.onnx")
    assert model.policy.training
    assert (th.random.get_rng_state() == state).all()


def test_file_that_acts_otherwise_is_not_written(
    normalising: HerDDPG, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_files, "_difference", lambda *args: 2e-5)
    with pytest.raises(ValueError, match="acts otherwise than predict"):
        export_onnx(normalising, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_what_has_no_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="takes an SB3 algorithm or policy that exists, not None"):
        export_onnx(None, tmp_path / "policy.onnx")


def test_an_input_named_as_the_output_is_refused(tmp_path: Path) -> None:
    class Repeats(toy.PointEnv):
        def __init__(self) -> None:
            super().__init__()
            entries = dict(self.observation_space.spaces)  # type: ignore[attr-defined]
            entries["action"] = entries["observation"]
            self.observation_space = spaces.Dict(entries)

        def _observe(self) -> dict[str, np.ndarray]:
            obs = super()._observe()
            return {**obs, "action": obs["observation"]}

    with pytest.raises(ValueError, match="the observation has a key 'action'"):
        export_onnx(SAC("MultiInputPolicy", Repeats(), **tiny()), tmp_path / "policy.onnx")
