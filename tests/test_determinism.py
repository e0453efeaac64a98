"""Same seed, same result: on two runs, with one and several copies, with one and two threads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tiny_runs as runs


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
