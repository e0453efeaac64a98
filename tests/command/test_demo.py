"""`demo` plays the policies that came with the package, from an installed wheel too."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tree import run

from sb3_follow_object.command import demo
from sb3_follow_object.command.cli import main
from sb3_follow_object.ddpg.actor_files import load_actor
from sb3_follow_object.envs import TASKS, make_vec
from sb3_follow_object.runs.evaluation import evaluate


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_policy(task: str) -> None:
    env_id = f"FollowObject/{task}-v0"
    assert demo.demo_policy(task) == demo.demo_policy(env_id)
    env = make_vec(env_id, 1, 1)
    _, trained_for = load_actor(demo.demo_policy(task), env.observation_space, env.action_space)
    assert trained_for == env_id


def test_policies_are_small_together_and_reach_their_goals() -> None:
    assert sum(file.stat().st_size for file in demo.POLICIES.iterdir()) <= 6_000_000
    assert evaluate(demo.demo_policy("PnPShelf"), "FollowObject/PnPShelf-v0", 38).success_rate > 0.9


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["demo", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


def test_what_cannot_be_played_is_refused_in_a_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert "did you mean 'PnPShelf'?" in refusal(capsys, "PnpShelf")
    assert "episodes is 0; it must be at least 1" in refusal(capsys, "--episodes", "0")
    assert "does not end in .mp4" in refusal(capsys, "--out", str(tmp_path / "film.png"))
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("can_draw")
def test_installed_wheel_films_a_success_where_there_is_no_display(
    tmp_path: Path, bare_python: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    python = bare_python(tmp_path / "venv")
    command = [str(python.parent / "sb3-follow-object"), "demo", "--episodes", "1"]
    printed = run(command, cwd=tmp_path).splitlines()
    assert printed[1:] == ["episode 1 of 1: success", "demo-PnPShelf.mp4", "success 1.00 of 1"]
    assert (tmp_path / "demo-PnPShelf.mp4").stat().st_size > 10_000


def test_frames_are_not_shown_faster_than_they_are_simulated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, slept = [10.0], []

    def sleep(seconds: float) -> None:
        slept.append(round(seconds, 3))
        clock[0] += seconds

    monkeypatch.setattr(demo.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(demo.time, "sleep", sleep)

    class Env:
        metadata = {"render_fps": 25}
        window_closed = False

        @property
        def unwrapped(self) -> Env:
            return self

    pace = demo._Pace()
    for took in (0.0, 0.01, 0.1, 0.0):
        clock[0] += took
        pace(Env())
    assert slept == [0.0, 0.03, 0.0, 0.04]


def test_help_does_not_wait_for_torch() -> None:
    code = "import sys; from sb3_follow_object.command.cli_options import make_parser\n"
    code += "from sb3_follow_object.command import cli; make_parser(cli._COMMANDS)\n"
    code += "assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
