"""The range of mujoco releases that the package asks for is one in which it works."""

import zipfile
from collections.abc import Callable
from email import message_from_bytes
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from tree import ROOT, run

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


@pytest.fixture
def mujoco(wheel: Path) -> Requirement:
    """What the wheel asks for: an installed tree may still tell an older range."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = message_from_bytes(archive.read(name))
    asked = [Requirement(line) for line in metadata.get_all("Requires-Dist", [])]
    return next(requirement for requirement in asked if requirement.name == "mujoco")


def test_installed_mujoco_lies_in_the_range(mujoco: Requirement) -> None:
    assert version("mujoco") in mujoco.specifier


@pytest.mark.mujoco_range
@pytest.mark.parametrize("end", ["lowest", "highest"])
def test_environments_run_at_both_ends_of_the_range(
    end: str, mujoco: Requirement, tmp_path: Path, bare_python: Callable[..., Path]
) -> None:
    wanted = str(mujoco)
    if end == "lowest":
        low = next(part.version for part in mujoco.specifier if part.operator == ">=")
        wanted = f"mujoco=={low}"
    python = bare_python(tmp_path / "venv", wanted)
    output = run([str(python), "-I", "-c", SMOKE], cwd=tmp_path)
    assert output.splitlines()[-1] in Requirement(wanted).specifier
    # importlib: the tests must meet the installed package, not the tree beside them.
    pytest_here = [str(python), "-I", "-m", "pytest", "-q", "--import-mode=importlib"]
    parity = [
        str(ROOT / "tests" / "envs" / "test_physics.py"),
        "-k",
        "parity",
        "-p",
        "no:cacheprovider",
    ]
    assert "2 passed" in run([*pytest_here, *parity], cwd=tmp_path)
