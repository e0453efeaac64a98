"""Graphics libraries are tried, not believed: no driver and no dead screen ends a process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from sb3_follow_object.envs import graphics

DRAW_TWICE = """
import gymnasium as gym, sb3_follow_object
env = gym.make("FollowObject/PnPShelf-v0", render_mode={mode!r}).unwrapped
for attempt in range(2):
    try:
        env.reset(seed=0)
        print("drew", env.render().shape)
    except RuntimeError as error:
        print("RuntimeError:", error)
env.close()
print("alive")
"""


def draw_twice(mode: str = "rgb_array", **variables: str) -> tuple[list[str], str]:
    """The lines that a process prints which draws twice, and its standard error."""
    env = {name: value for name, value in os.environ.items() if name not in SURROUNDINGS}
    done = subprocess.run(
        [sys.executable, "-c", DRAW_TWICE.format(mode=mode)],
        env={**env, **variables},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    *lines, last = done.stdout.splitlines()
    assert last == "alive" and len(lines) == 2
    return lines, done.stderr


SURROUNDINGS = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"}
DREW = "drew (480, 480, 3)"


@pytest.mark.usefixtures("can_draw")
def test_a_dead_screen_is_passed_over_with_a_sentence() -> None:
    lines, err = draw_twice(DISPLAY=":99")
    assert lines == [DREW, DREW]
    assert "glfw does not draw here (X11: Failed to open display :99); drawing with " in err
    assert err.count("does not draw here") == 1


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("named", ["", "  ", " {} ", "on", "TRUE"])
def test_mujoco_gl_is_read_as_mujoco_reads_it(named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    working = os.environ["MUJOCO_GL"]
    monkeypatch.setenv("MUJOCO_GL", named.format(working.upper()))
    monkeypatch.delenv("DISPLAY", raising=False)
    assert graphics.find_graphics() == working


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("named", ["glfw", "GLX", "bogus", "no such", "../x"])
def test_a_named_library_that_does_not_work_is_refused_with_one_that_does(
    named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    working = os.environ["MUJOCO_GL"]
    monkeypatch.setenv("MUJOCO_GL", named)
    monkeypatch.setenv("DISPLAY", ":99")
    with pytest.raises(RuntimeError) as error:
        graphics.find_graphics()
    assert str(error.value).startswith(f"MUJOCO_GL={named} does not draw here (")
    assert str(error.value).endswith(f"; {working} does: set MUJOCO_GL={working} or unset it.")


def test_drawing_that_is_switched_off_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", " Off ")
    with pytest.raises(RuntimeError, match="MUJOCO_GL= Off  switches drawing off; unset it"):
        graphics.find_graphics()


@pytest.mark.parametrize("display", [{"DISPLAY": ":99"}, {}])
def test_a_window_without_a_screen_is_an_error_and_the_process_lives(
    display: dict[str, str],
) -> None:
    lines, _ = draw_twice("human", **display)
    for line in lines:
        assert line.startswith("RuntimeError: No window can be opened here (X11: ")
        assert line.endswith("); use render_mode='rgb_array', or a screen.")


def test_physics_needs_no_library_of_mujoco_gl() -> None:
    """Importing mujoco fails with what the libraries that it names raise."""
    code = "import gymnasium as gym, sb3_follow_object, os\n"
    code += "gym.make('FollowObject/PnPShelf-v0').reset(seed=0)\n"
    code += "print(os.environ['MUJOCO_GL'], os.environ.get('PYOPENGL_PLATFORM'))"
    for named in ("bogus", "wgl"):  # of another system
        env = {name: value for name, value in os.environ.items() if name not in SURROUNDINGS}
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**env, "MUJOCO_GL": named},
            capture_output=True,
            text=True,
        )
        assert (done.returncode, done.stdout) == (0, f"{named} None\n"), done.stderr


# Trials


@pytest.fixture
def fresh_trials(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No library has been tried; MUJOCO_GL names none, and there is a screen."""
    for name in SURROUNDINGS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":99")
    graphics._try.cache_clear()
    yield
    graphics._try.cache_clear()


@pytest.mark.usefixtures("fresh_trials")
@pytest.mark.parametrize(
    ("trial", "reason"),
    [
        ("import os; os.abort()", "it ends the process by SIGABRT"),
        ("import os; os.kill(os.getpid(), 11)", "it ends the process by SIGSEGV"),
        ("import time; time.sleep(30)", "it has drawn nothing in 1 s"),
        ("raise SystemExit(3)", "exit status 3"),
        ("import mujoco\nraise mujoco.FatalError('gladLoadGL error')", "gladLoadGL error"),
    ],
)
def test_however_a_library_fails_it_is_told(
    trial: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graphics, "_TRIAL", trial)
    monkeypatch.setattr(graphics, "_TRIAL_SECONDS", 1.0 if "sleep" in trial else 60.0)
    for _ in range(2):
        with pytest.raises(RuntimeError, match=f"There is no OpenGL.*{reason}.*libegl1") as error:
            graphics.find_graphics()
    for library in ("glfw", "egl", "osmesa"):
        assert f"{library}: " in str(error.value)


@pytest.mark.usefixtures("fresh_trials")
def test_a_library_is_tried_once_while_nothing_around_it_changes(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tried = []

    def run(command: list[str], env: dict[str, str], **rest: object) -> object:
        tried.append((env["MUJOCO_GL"], env["DISPLAY"]))
        failed = env["MUJOCO_GL"] != "osmesa"
        return subprocess.CompletedProcess(command, int(failed), "", "no such library\n")

    monkeypatch.setattr(graphics.subprocess, "run", run)
    graphics._note_once.cache_clear()
    assert graphics.find_graphics() == graphics.find_graphics() == "osmesa"
    assert tried == [("glfw", ":99"), ("egl", ":99"), ("osmesa", ":99")]
    assert caplog.messages == [
        f"{library} does not draw here (no such library); drawing with osmesa"
        for library in ("glfw", "egl")
    ]
    monkeypatch.setenv("DISPLAY", ":98")
    assert graphics.find_graphics() == "osmesa"
    assert len(tried) == 6


@pytest.mark.usefixtures("fresh_trials")
def test_a_trial_that_could_not_be_made_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", "/no/such/python")
        assert graphics.why_not("egl") == "it cannot be tried: No such file or directory: " + (
            "/no/such/python"
        )
    monkeypatch.setattr(graphics, "_TRIAL", "")
    assert graphics.why_not("egl") is None


@pytest.mark.usefixtures("fresh_trials")
def test_what_an_import_that_failed_left_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> None:
        os.environ["PYOPENGL_PLATFORM"] = "egl"
        monkeypatch.setitem(sys.modules, "OpenGL.of_this_test", sys)
        raise AttributeError("no libEGL")

    monkeypatch.setattr(graphics, "find_graphics", lambda: "egl")
    monkeypatch.setattr(graphics, "import_module", load)
    # What the test makes this process forget is put back after it.
    for name in [name for name in sys.modules if name.startswith(("OpenGL", "mujoco.egl"))]:
        monkeypatch.setitem(sys.modules, name, sys.modules[name])
    with pytest.raises(RuntimeError, match=r"egl draws in a process of its own, but not in this"):
        graphics.open_graphics(8)
    assert "OpenGL.of_this_test" not in sys.modules
    assert "PYOPENGL_PLATFORM" not in os.environ
