"""Same seed, same result: on two runs, with one and several copies, with any number of threads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tiny_runs as runs
import torch as th
from torch import nn

from sb3_follow_object.common.torch_helpers import threads_at
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.ddpg.layer_norm import LayerNorm
from sb3_follow_object.envs import make_vec
from sb3_follow_object.settings.presets import run_config


def outcome(folder: Path, seed: int = 0, **settings: Any) -> dict[str, Any]:
    """A short run of DDPG + HER; what it left."""
    config = runs.config(
        settings={"imagine": False, **settings},
        method="her",
        seed=seed,
        total_timesteps=800,
        eval_every=300,
        checkpoint_minutes=5.0,
    )
    runs.run(folder, config=config)
    return runs.outcome(folder)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_run_depends_on_its_seed_alone(n_envs: int, tmp_path: Path) -> None:
    first = outcome(tmp_path / "first", n_envs=n_envs, n_threads=1)
    again = outcome(tmp_path / "again", n_envs=n_envs, n_threads=1)
    assert again == first
    assert len(first["evaluations"]) > 2
    threaded = outcome(tmp_path / "threaded", n_envs=n_envs, n_threads=2)
    assert threaded == first
    other = outcome(tmp_path / "other", seed=1, n_envs=n_envs, n_threads=1)
    assert other["policy.safetensors"] != first["policy.safetensors"]
    # Settings that were given are not written into.
    assert runs.SMALL_NET["policy_kwargs"] == {"net_arch": [8]}


@pytest.mark.parametrize(
    ("method", "batch_size", "n_threads"), [("her", 128, 2), ("rnd", 128, 3), ("her", 1024, 2)]
)
def test_threads_of_gradient_steps_change_no_bit(
    method: str, batch_size: int, n_threads: int
) -> None:
    task = "FollowObject/PnPShelf-v0"
    settings = run_config(task, method=method).settings["algorithm"]
    weights = []
    for threads in (1, n_threads):
        env = make_vec(task, 2, 1)
        small = {"learning_starts": 0, "gradient_steps": 5, "buffer_size": 2000}
        small |= {"update_threads": threads, "batch_size": batch_size}
        model = HerDDPG(env=env, seed=3, **(settings | small))
        model.learn(200)
        assert model._n_updates == 10
        weights.append([*model.policy.parameters()])
        env.close()
    assert all(map(th.equal, *weights))


@pytest.mark.parametrize("n_threads", [1, 2, 3])
@pytest.mark.parametrize("learns_input", [True, False])
def test_layer_norm_has_the_gradients_of_one_thread(n_threads: int, learns_input: bool) -> None:
    grad = th.randn(256, 256, generator=th.Generator().manual_seed(1))
    results = []
    for layer, threads in ((nn.LayerNorm(256), 1), (LayerNorm(256), n_threads)):
        x = th.randn(256, 256, generator=th.Generator().manual_seed(2), requires_grad=learns_input)
        with threads_at(threads):
            y = layer(x)
            y.backward(grad)
        results.append([y, layer.weight.grad, layer.bias.grad, *[x.grad] * learns_input])
    assert all(map(th.equal, *results))
