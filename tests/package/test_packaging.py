"""The wheel holds the whole tree under one name, and a stranger's script runs with it."""

import zipfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from tree import PACKAGES, ROOT, run

import sb3_follow_object

USER_SCRIPT = """
import gymnasium as gym
from sb3_follow_object import FollowObject

task = "FollowObject/PushSideGap-v0"
small = {"batch_size": 64, "policy_kwargs": {"net_arch": [64]}}
stages = {"object_timesteps": 800, "n_paths": 16, "predictor_fit": {"epochs": 1}}
run = FollowObject(task, n_envs=2, algorithm=small, object_algorithm=small, **stages)
run.learn(2000)
run.save("saved")
env = gym.make(task)
obs, _ = env.reset(seed=0)
obs, reward, *_ = env.step(FollowObject.load("saved").predict(obs)[0])
"""

MAKE_BY_MODULE = """
import gymnasium as gym

env = gym.make("sb3_follow_object:FollowObject/PnPShelf-v0")
obs, info = env.reset(seed=0)
obs, reward, _, _, info = env.step(env.action_space.sample())
assert reward == env.unwrapped.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
"""


@pytest.mark.parametrize("python", ["3.10.0", "3.11.2", "3.12.0", "3.13.0", "3.14.0"])
def test_no_pin_asks_a_python_for_what_it_cannot_install(python: str) -> None:
    """Debian 12 has 3.11.2; a pin that a Python is too old for makes pip refuse the whole."""
    here = {"python_full_version": python, "python_version": python.rpartition(".")[0]}
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    for pin in pins:
        if pin.marker is not None and not pin.marker.evaluate(here):
            continue
        try:
            wanted = metadata(pin.name).get("Requires-Python", "")
        except PackageNotFoundError:  # of the extra `bench`
            continue
        assert python in SpecifierSet(wanted), f"{pin} needs Python {wanted}"


def test_wheel_holds_every_file_of_the_tree_under_one_name(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    shipped = {name for name in names if ".dist-info/" not in name}
    expected = {
        f"{package}/{file.relative_to(folder).as_posix()}"
        for package, folder in PACKAGES.items()
        for pattern in (
            "**/*.py",
            "**/*.yml",
            "**/*.xml",
            "**/*.html",
            "**/*.safetensors",
            "**/py.typed",
        )
        for file in folder.glob(pattern)
    }
    assert shipped == expected
    assert {name.split("/")[0] for name in shipped} == {"sb3_follow_object"}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory, bare_python: Callable[..., Path]) -> Path:
    """An environment in which a stranger installed the wheel."""
    return bare_python(tmp_path_factory.mktemp("user") / "venv")


def test_installed_package_is_not_the_tree_and_is_light_to_import(
    python: Path, tmp_path: Path
) -> None:
    code = "import sys, sb3_follow_object; print(sb3_follow_object.__file__, *sys.modules)"
    file, *modules = run([str(python), "-I", "-c", code], cwd=tmp_path).split()
    assert Path(file).is_relative_to(python.parents[1])
    # mujoco reads MUJOCO_GL when it is imported, so a program must be able to set it after us.
    assert not {"torch", "mujoco"} & set(modules)


@pytest.mark.parametrize("script", [MAKE_BY_MODULE, USER_SCRIPT], ids=["make", "learn"])
def test_user_script_runs_from_another_folder(script: str, python: Path, tmp_path: Path) -> None:
    run([str(python), "-I", "-W", "error::UserWarning", "-c", script], cwd=tmp_path)


@pytest.mark.parametrize("name", sb3_follow_object.__all__)
def test_every_public_name_exists(name: str) -> None:
    assert getattr(sb3_follow_object, name) is not None


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Curiculum"):
        sb3_follow_object.Curiculum  # noqa: B018


def test_command_is_installed(python: Path, tmp_path: Path) -> None:
    assert "train" in run([str(python.parent / "sb3-follow-object"), "--help"], cwd=tmp_path)
