"""`inspect` says what is found in a task of others and draws it, or why it cannot, in one line."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import arm_and_wall
import gymnasium as gym
import imageio.v3 as imageio
import moving_wall
import numpy as np
import pytest
from tiny_runs import config, quiet

from sb3_follow_object.any_task import derived as looking
from sb3_follow_object.any_task.tasks import kept_as
from sb3_follow_object.command import inspecting
from sb3_follow_object.command.cli import main
from sb3_follow_object.command.pictures import draw_task
from sb3_follow_object.common.cache import CACHE_VARIABLE
from sb3_follow_object.runs.predictor_cache import learn_predictor

ARM = f"arm_and_wall:{arm_and_wall.ARM}"


@pytest.fixture(autouse=True)
def few_resets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(looking, "N_RESETS", 60)
    monkeypatch.setattr(looking, "_LOOKED_AT", {})
    monkeypatch.setattr(inspecting, "_SECONDS", 0.01)


def test_it_says_what_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "--env", ARM]) == 0
    told = capsys.readouterr()
    facts = dict(line.split("  ", 1) for line in told.out.splitlines())
    facts = {name: words.strip() for name, words in facts.items()}
    assert facts["object"] == "box (off by 0.00 mm at most; nothing else can move)"
    assert facts["reached"] == "within 50 mm"
    assert facts["effector"] == "observation[0:3], 2 mm off the fingertips' middle"
    assert re.fullmatch(
        r"2\d mm a step at most: \d steps to the object and 2\d to its goal where they are "
        "farthest, of 50",
        facts["speed"],
    )
    assert facts["moves"].startswith("on its surface")
    assert facts["episodes"] == "50 steps; the object's 50"
    assert "where 60 episodes of ArmAndWall-v0 begin is recorded, once" in told.err


class Silent(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Its observations do not tell where the stick's end is."""

    def _observation(self) -> Any:
        now = super()._observation()
        return {**now, "observation": np.concatenate([np.zeros(3), now["observation"][3:]])}


gym.register("Silent-v0", Silent, max_episode_steps=50)


def test_it_says_how_to_tell_an_effector(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "--env", "Silent-v0"]) == 0
    remedy = "effector=fingertips of RobotTask or FollowObject tells where they are"
    told = capsys.readouterr().out
    assert re.search(f"^effector .*; {remedy}$", told, re.MULTILINE)


class Reusing(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Gives the same arrays with each observation."""

    told: dict[str, np.ndarray] | None = None

    def _observation(self) -> Any:
        now = super()._observation()
        if self.told is None:
            self.told = now
        for key, value in now.items():
            self.told[key][:] = value
        return self.told


gym.register("Reusing-v0", Reusing, max_episode_steps=50)


def test_arrays_that_an_environment_reuses_make_no_difference(
    capsys: pytest.CaptureFixture[str],
) -> None:
    told = []
    for env_id in ("Reusing-v0", ARM):
        assert main(["inspect", "--env", env_id]) == 0
        lines = capsys.readouterr().out.splitlines()
        told.append([line for line in lines if line.startswith(("speed", "robot", "goal"))])
    assert told[0] == told[1]
    assert told[0][1].split(None, 1) == ["robot", "upper arm"]


class Slow(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Does what it is told at a third of the speed."""

    def step(self, action: np.ndarray) -> Any:
        return super().step(action / 3.0)


gym.register("Slow-v0", Slow, max_episode_steps=50)


def test_a_robot_without_the_time_to_get_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "--env", "Slow-v0"]) == 0
    (line,) = [each for each in capsys.readouterr().out.splitlines() if each.startswith("speed")]
    assert line.endswith("too slow: make episodes longer, or do each action more than once")


class Unbounded(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Takes any number for an action."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (3,))


gym.register("Unbounded-v0", Unbounded, max_episode_steps=50)


def test_actions_without_bounds_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "--env", "Unbounded-v0"]) == 2
    assert "'Unbounded-v0': the action space must have finite bounds" in capsys.readouterr().err


def test_a_goal_as_high_as_the_start_is_no_minus_above_it() -> None:
    starts = np.array([[0.0, 0.0, 0.425], [0.1, 0.0, 0.425]])
    resets = SimpleNamespace(starts=starts, goals=starts + np.array([0.3, 0.0, -1e-6]))
    told = inspecting._goal(SimpleNamespace(resets=resets))
    assert told.endswith(" m from the start, 0.00 to 0.00 m above it")


def test_it_says_what_stands_elsewhere_and_what_of_it_is_seen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["inspect", "--env", f"moving_wall:{moving_wall.WALL}"]) == 0
    told = capsys.readouterr().out
    expected = "wall (x, y): seen by nu and F_phi; paint, target: need not be seen"
    assert any(line.split("  ", 1)[1].strip() == expected for line in told.splitlines())


def test_it_draws_starts_and_goals(can_draw: None, tmp_path: Path) -> None:
    out = tmp_path / "arm.png"
    assert main(["inspect", "--env", ARM, "--out", str(out)]) == 0
    image = imageio.imread(out).astype(int)
    assert image.shape == (480, 480, 3)
    red, green, blue = (image[..., channel] for channel in range(3))
    assert ((red > 2 * green) & (red > 2 * blue) & (red > 40)).sum() > 100, "goals"
    assert ((blue > 2 * red) & (blue > 40)).sum() > 100, "starts"


def test_it_draws_imagined_goals_where_there_is_an_f_phi(
    can_draw: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predictor = learn_predictor(config(env_id=ARM), tmp_path / "phi", quiet)
    command = ["inspect", "--env", ARM, "--out", str(tmp_path / "arm.png")]
    assert main(command) == 0
    assert imageio.imread(tmp_path / "arm.png").shape == (480, 480, 3)
    assert main([*command, "--predictor", str(tmp_path / "phi")]) == 0
    assert imageio.imread(tmp_path / "arm.png").shape == (480, 4 * 480, 3)
    predictor.save(tmp_path / "cache" / arm_and_wall.ARM / kept_as(arm_and_wall.ARM))
    assert main(command) == 0
    assert imageio.imread(tmp_path / "arm.png").shape == (480, 4 * 480, 3)
    assert main([*command, "--predictor", str(tmp_path)]) == 2
    assert "predictor" in capsys.readouterr().err


def test_what_the_picture_lacks_is_told_before_anything_is_looked_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspecting, "inspect", pytest.fail)
    missing = str(tmp_path / "phi")
    for words, sentence in (
        (["--out", "arm.jpg"], "arm.jpg does not end in .png"),
        (["--predictor", missing], "--predictor is for the picture; say with --out FILE.png"),
        (["--out", "arm.png", "--predictor", missing], f"Cannot read {missing}/predictor.json"),
    ):
        assert main(["inspect", "--env", ARM, *words]) == 2
        assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env_id", "sentence"),
    [
        ("FetchReach-v4", "'FetchReach-v4': the achieved goal is a point of the robot itself"),
        ("FollowObject/PnPShelf-v0", "'FollowObject/PnPShelf-v0' is a task of this package;"),
        ("own_tasks:FollowObject/PushPast-v0", "is a task of register_task; inspect is for those"),
        ("Nowhere-v0", "there is no environment 'Nowhere-v0'"),
        ("nowhere:Arm-v0", "names a module that cannot be imported"),
    ],
)
def test_why_nothing_is_found_is_one_line(
    env_id: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", "--env", env_id]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and sentence in told.err


def test_an_environment_that_draws_nothing_is_filmed_all_the_same(
    can_draw: None, tmp_path: Path
) -> None:
    out = tmp_path / "task.png"
    draw_task(ARM, out)
    image = imageio.imread(out).astype(int)
    assert image.shape == (480, 480, 3) and image.max() > 40
