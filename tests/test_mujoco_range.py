"""The range of mujoco releases that the package asks for is one in which it works."""

from collections.abc import Callable
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from tree import run

MUJOCO = next(
    requirement
    for requirement in map(Requirement, requires("sb3-follow-object") or ())
    if requirement.name == "mujoco"
)
LOWEST = next(part.version for part in MUJOCO.specifier if part.operator == ">=")

SMOKE = """
import gymnasium as gym
import gymnasium_robotics
import mujoco
import numpy as np

import sb3_follow_object

gym.register_envs(gymnasium_robotics)
ids = ["FetchPickAndPlace-v4", "FetchPush-v4"]
ids += [env_id for env_id in gym.registry if env_id.startswith("FollowObject/")]
assert len(ids) > 8, ids
for env_id in ids:
    env = gym.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(10):
        obs, *_ = env.step(env.action_space.sample())
    assert all(np.isfinite(part).all() for part in obs.values()), env_id
    env.close()
print(mujoco.__version__)
"""


def test_installed_mujoco_lies_in_the_range() -> None:
    assert version("mujoco") in MUJOCO.specifier


@pytest.mark.mujoco_range
@pytest.mark.parametrize("release", [f"mujoco=={LOWEST}", str(MUJOCO)])
def test_environments_run_at_both_ends_of_the_range(
    release: str, tmp_path: Path, bare_python: Callable[..., Path]
) -> None:
    python = bare_python(tmp_path / "venv", release)
    output = run([str(python), "-I", "-c", SMOKE], cwd=tmp_path)
    assert output.splitlines()[-1] in Requirement(release).specifier
