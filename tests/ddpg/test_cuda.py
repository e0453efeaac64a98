"""What only a GPU can show: graphs take the steps that Python takes, replay lies by the learner.

Skipped where PyTorch sees no CUDA device. The other tests are meant for the CPU.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from small_buffers import fill, make_buffer, make_env
from small_models import assert_resumes_exactly, make_model, success_rate, weights
from tiny_runs import bare_run
from toy import paths

from sb3_follow_object.ddpg.actor_files import load_actor, save_actor
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.ddpg.updates import Updates
from sb3_follow_object.envs import physics_id
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.replay.device_replay import DeviceReplay

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a CUDA device")

CUDA = "cuda"

MIRROR = {"axis": 0, "at": 0.0, "positions": [0], "actions": [0]}
DEFAULT: dict[str, Any] = {  # of the default preset, what the steps and the draws depend on
    "policy_delay": 2,
    "hindsight_bound": True,
    "average_decay": 0.9996,
    "tau": 0.01,
    "policy_kwargs": {"net_arch": [32, 32], "critic_layer_norm": True, "mirrors": [MIRROR]},
}


def trained(steps: int = 400, **kwargs: Any) -> HerDDPG:
    model = make_model(device=CUDA, **kwargs)
    model.learn(steps, log_interval=None)  # type: ignore[arg-type]
    return model


def without_graphs(model: HerDDPG) -> HerDDPG:
    """Let the steps run one by one, with the same optimiser kernels."""
    updates = model._updates

    def run(inputs: dict[str, th.Tensor], batch_size: int) -> th.Tensor:
        updates._n_calls = 0  # for ever warming up
        return Updates._run_on_cuda(updates, inputs, batch_size)

    updates._run_on_cuda = run  # type: ignore[method-assign]
    return model


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"hindsight_bound": True, "matmul_precision": "medium", "average_decay": 0.99},
        {
            "target_update_interval": 4,
            "policy_kwargs": {"net_arch": [64], "critic_layer_norm": True},
        },
        DEFAULT,
    ],
)
def test_graphs_take_the_same_steps_to_the_last_bit(kwargs: dict[str, Any]) -> None:
    graphs, plain = make_model(device=CUDA, **kwargs), make_model(device=CUDA, **kwargs)
    without_graphs(plain)
    for model in (graphs, plain):
        model.learn(1200, log_interval=None)  # type: ignore[arg-type]
    assert graphs._updates._graphs and not plain._updates._graphs
    assert graphs._n_updates == plain._n_updates > 0
    assert th.equal(weights(graphs), weights(plain))


@pytest.mark.parametrize("gradient_steps", [40, 80])
def test_one_graph_serves_all_where_targets_move_seldom(gradient_steps: int) -> None:
    """The authors' setting; two chunks a call move the targets at the same place of theirs."""
    model = trained(1200, gradient_steps=gradient_steps, batch_size=4864, target_update_interval=40)
    assert len(model._updates._graphs) == 1


@pytest.mark.parametrize("kwargs", [{}, DEFAULT])
def test_same_seed_same_weights(kwargs: dict[str, Any]) -> None:
    first, again = (trained(2000, **kwargs) for _ in range(2))
    assert first._updates._graphs
    assert th.equal(weights(first), weights(again))
    assert not th.equal(weights(first), weights(trained(2000, seed=1, **kwargs)))


@pytest.mark.parametrize("kwargs", [{}, DEFAULT])
def test_resumed_training_equals_uninterrupted(kwargs: dict[str, Any]) -> None:
    for model in assert_resumes_exactly(6, device=CUDA, **kwargs):
        assert model._updates._graphs


@pytest.mark.parametrize("kwargs", [{}, DEFAULT])
def test_training_goes_on_on_the_other_device(kwargs: dict[str, Any]) -> None:
    there, here = trained(1200, **kwargs), make_model(device="cpu", seed=1, **kwargs)
    assert there._updates._graphs
    for model, other in ((there, here), (here, make_model(device=CUDA, seed=2, **kwargs))):
        other.set_logger(there.logger)
        other.load_training_state(copy.deepcopy(model.training_state()))
        other.replay_buffer.load_state_dict(  # type: ignore[union-attr]
            copy.deepcopy(model.replay_buffer.state_dict())  # type: ignore[union-attr]
        )
        assert th.equal(weights(other).cpu(), weights(model).cpu())
        before = weights(other).clone()
        for _ in range(6):
            other.train(5, 64)
        assert weights(other).isfinite().all() and not th.equal(weights(other), before)
    assert other._updates._graphs


def test_a_learning_rate_that_changes_reaches_the_graph() -> None:
    model = trained(learning_rate=lambda left: 1e-3 if left > 0.5 else 0.0)
    model._current_progress_remaining = 0.2
    before = copy.deepcopy(model.actor.state_dict())
    for _ in range(3):
        model.train(5, 64)
    assert all(th.equal(before[name], value) for name, value in model.actor.state_dict().items())


def test_learns_to_reach() -> None:
    model = make_model(device=CUDA, policy_kwargs={"net_arch": [64, 64]})
    before = success_rate(model)
    model.learn(4000, log_interval=None)  # type: ignore[arg-type]
    assert before < 0.5
    assert success_rate(model) > 0.9


def test_relabelled_rewards_are_the_environments() -> None:
    env = make_env()
    buffer = make_buffer(env, min_goal_distance=0.05, moved_ratio=0.5)
    fill([buffer], env, 200)
    replay = DeviceReplay(buffer, th.device(CUDA), 0)
    replay.refresh(buffer)
    samples, _ = replay.sample_with_steps(5000)
    assert samples.rewards.device.type == CUDA
    reached, goals, rewards = (
        tensor.cpu().numpy()
        for tensor in (
            samples.next_observations["achieved_goal"],
            samples.observations["desired_goal"],
            samples.rewards[:, 0],
        )
    )
    expected = env.env_method("compute_reward", reached, goals, [{}], indices=[0])[0]
    assert 0.01 < (expected == 0).mean() < 0.99
    assert (rewards == expected).all()


def test_an_auxiliary_reward_learns_beside(tmp_path: Path) -> None:
    model = trained(auxiliary={"name": "rnd", "hidden": [16]})
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=model.env, device=CUDA)
    assert th.equal(weights(loaded), weights(model))
    loaded.learn(80, log_interval=None)  # type: ignore[arg-type]
    assert not th.equal(weights(loaded), weights(model))


def test_f_phi_fitted_there_imagines_what_one_fitted_here_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ways, goals = paths(256)
    there = GoalPredictor.fit(ways, goals, env_id="Point-v0", physics="none", epochs=20)
    with monkeypatch.context() as patch:
        patch.setattr(th.cuda, "is_available", lambda: False)
        here = GoalPredictor.fit(ways, goals, env_id="Point-v0", physics="none", epochs=20)
    for predictor in (there, here):
        assert predictor.error_mm.mean() < 10.0
    distance = there.paths(ways[:, 0], goals) - here.paths(ways[:, 0], goals)
    assert 0.0 < abs(distance).max() < 0.03


def test_f_phi_imagines_there_what_it_does_here(tmp_path: Path) -> None:
    ways, goals = paths(64)
    predictor = GoalPredictor.fit(ways, goals, env_id="Point-v0", physics="none", epochs=2)
    here = predictor.paths(ways[:, 0], goals)
    there = predictor.to(CUDA).paths(ways[:, 0], goals)
    assert abs(there - here).max() < 1e-4
    predictor.save(tmp_path)
    again = GoalPredictor.load(tmp_path)
    assert again.device.type == "cpu"
    assert (again.paths(ways[:, 0], goals) == here).all()


def test_a_run_imagines_where_it_learns() -> None:
    task = "FollowObject/PnPShelf-v0"
    ways = np.random.default_rng(0).uniform(size=(8, 51, 3))
    facts = {"env_id": task, "physics": physics_id(task)}
    predictor = GoalPredictor.fit(ways, ways[:, -1], epochs=1, **facts)
    run = bare_run(task, n_envs=2, n_threads=1, predictor=predictor, algorithm={"device": CUDA})
    model = run.prepare()
    assert predictor.device == model.device
    assert np.isfinite(run.env.reset()["desired_goal"]).all()  # type: ignore[call-overload]
    run.close()


@pytest.mark.parametrize("kwargs", [{}, DEFAULT])
def test_an_actor_saved_there_plays_on_the_cpu(tmp_path: Path, kwargs: dict[str, Any]) -> None:
    model = trained(**kwargs)
    save_actor(tmp_path / "policy.safetensors", model.policy.actor_average, "Point-v0")
    assert model.env is not None
    spaces = model.observation_space, model.action_space
    actor, _ = load_actor(tmp_path / "policy.safetensors", *spaces)  # type: ignore[arg-type]
    obs = model.env.reset()
    there, here = (each.predict(obs, deterministic=True)[0] for each in (model, actor))
    assert there == pytest.approx(here, abs=1e-5)
