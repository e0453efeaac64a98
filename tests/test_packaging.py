"""The wheel holds the whole tree under one name, and a stranger's script runs with it."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import PACKAGES, run

pytestmark = pytest.mark.xdist_group("wheel")

USER_SCRIPT = """
import gymnasium as gym

env = gym.make("sb3_follow_object:FollowObject/PnPShelf-v0")
obs, info = env.reset(seed=0)
for _ in range(5):
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
assert env.unwrapped.compute_reward(obs["achieved_goal"], obs["desired_goal"], info) == reward
assert "is_success" in info
env.close()
"""


def test_wheel_holds_every_file_of_the_tree_under_one_name(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    shipped = {name for name in names if ".dist-info/" not in name}
    expected = {
        f"{package}/{file.relative_to(folder).as_posix()}"
        for package, folder in PACKAGES.items()
        for pattern in ("**/*.py", "**/*.yml", "**/*.xml", "**/py.typed")
        for file in folder.glob(pattern)
    }
    assert shipped == expected
    assert {name.split("/")[0] for name in shipped} == {"sb3_follow_object"}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory, bare_python: Callable[..., Path]) -> Path:
    """An environment in which a stranger installed the wheel."""
    return bare_python(tmp_path_factory.mktemp("user") / "venv")


def test_user_script_runs_with_the_installed_wheel(python: Path, tmp_path: Path) -> None:
    run([str(python), "-I", "-W", "error::UserWarning", "-c", USER_SCRIPT], cwd=tmp_path)


def test_installed_package_is_not_the_tree_and_is_light_to_import(
    python: Path, tmp_path: Path
) -> None:
    code = "import sys, sb3_follow_object; print(sb3_follow_object.__file__, *sys.modules)"
    file, *modules = run([str(python), "-I", "-c", code], cwd=tmp_path).split()
    assert Path(file).is_relative_to(python.parents[1])
    assert not {"torch", "mujoco"} & set(modules)
