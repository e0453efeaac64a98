"""What a command finds around it: screens, encoders, terminals, folders. None costs a result."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import tiny_runs as runs
from cli_runs import TINY_NETWORKS, TINY_TESTS
from read_only import read_only_copy

from sb3_follow_object.command.cli import main
from sb3_follow_object.common import extras
from sb3_follow_object.comparison import compare, figures
from sb3_follow_object.runs import experiment, stages
from sb3_follow_object.runs.progress import ProgressBar, Terminal

PICTURES = ("curve.png", "task.png", "video.mp4")
SUPPORT = str(Path(__file__).parents[1] / "support")
OF_GRAPHICS = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, without the pictures that its end draws."""
    folder = tmp_path_factory.mktemp("surroundings") / "run"
    words = ["train", "--env", runs.TASK, "--method", "her", "--steps", "800", "--n-envs", "2"]
    words += ["--threads", "1", "--quiet", "--run", str(folder), "--set"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "off")
        assert main([*words, *TINY_NETWORKS, *TINY_TESTS[1:]]) == 0
    (folder / "curve.png").unlink()
    return folder


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def command(*words: object, module: str = "sb3_follow_object", **variables: str) -> tuple:
    """The exit status, output and errors of a command in a process of its own."""
    env = {name: value for name, value in os.environ.items() if name not in OF_GRAPHICS}
    done = subprocess.run(
        [sys.executable, "-m", module, *map(str, words)],
        env={**env, **variables},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout, done.stderr


def holds(folder: Path) -> set[str]:
    return {name for name in PICTURES if (folder / name).exists()}


@pytest.mark.usefixtures("can_draw")
def test_a_dead_screen_costs_no_picture(run: Path) -> None:
    films = {"module": "short_films", "PYTHONPATH": SUPPORT}
    status, out, err = command("train", "--resume", "--run", run, DISPLAY=":99", **films)
    assert status == 0 and holds(run) == set(PICTURES)
    assert "0.000 of 8" in out and "left out" not in out
    assert "glfw does not draw here (X11: Failed to open display :99); drawing with" in err


def test_what_cannot_be_drawn_is_left_out_after_the_table(run: Path) -> None:
    words = ("train", "--resume", "--run", run)
    status, out, _ = command(*words, DISPLAY=":99", MUJOCO_GL="GLFW", MPLBACKEND="none-such")
    assert status == 0 and holds(run) == set()
    table, _, left_out = out.partition("left out curve.png: matplotlib cannot be imported: ")
    assert "0.000 of 8" in table
    assert "left out task.png, video.mp4: MUJOCO_GL=GLFW does not draw here (X11: Fail" in left_out
    status, out, err = command("watch", run, DISPLAY=":99", MUJOCO_GL="GLFW")
    assert (status, out) == (2, "")
    assert (
        err.startswith("sb3-follow-object: MUJOCO_GL=GLFW does not draw") and "\n" not in err[:-1]
    )


@pytest.mark.usefixtures("can_draw")
def test_an_encoder_that_is_not_there_costs_the_film_alone(run: Path) -> None:
    gone = {"IMAGEIO_FFMPEG_EXE": "/no/such/ffmpeg", "MUJOCO_GL": os.environ["MUJOCO_GL"]}
    status, out, _ = command("train", "--resume", "--run", run, **gone)
    assert status == 0 and holds(run) == {"curve.png", "task.png"}
    assert "left out video.mp4: No such file or directory: /no/such/ffmpeg" in out
    assert not [path for path in run.iterdir() if path.name.startswith(".video")]


@pytest.mark.parametrize(
    "variables",
    [
        {"COLUMNS": "1", "LC_ALL": "C", "LANG": ""},
        {
            "COLUMNS": "0",
            "TERM": "dumb",
            "PYTHONIOENCODING": "ascii",
            "HOME": "/no/home",
            "XDG_CACHE_HOME": "/proc/no",
            "MPLCONFIGDIR": "/proc/no",
            "TMPDIR": "/no/tmp",
        },
    ],
)
def test_odd_terminals_and_homes_show_the_same_table(
    variables: dict[str, str], finished: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "rün"))
    words = ("train", "--resume", "--run", folder)
    status, out, _ = command(*words, MUJOCO_GL="off", **variables)
    assert status == 0 and holds(folder) == {"curve.png"}
    (row,) = (line for line in out.splitlines() if "0.000 of 8" in line)
    assert row[1:].split()[::2][:3] == ["PushSideGap", "her", "0"]
    assert "is finished already" in out


@pytest.mark.parametrize("where", [">&-", ">&- 2>&-", ">/dev/full", "to nobody"])
def test_output_that_goes_nowhere_is_no_failure(where: str, run: Path) -> None:
    line = f'"{sys.executable}" -m sb3_follow_object train --resume --run "{run}"'
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        ["sh", "-c", line if where == "to nobody" else f"{line} {where}"],
        env={**os.environ, "MUJOCO_GL": "off"},
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(write)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    assert holds(run) == {"curve.png"}


def test_a_run_goes_on_without_a_reader() -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    with ProgressBar(100) as bar:
        bar._console = Terminal(file=Gone())
        for _ in range(2):
            bar.say("nobody hears this")
            bar.update({"env_steps": 5, "success_rate": None, "k_max": None})


@pytest.mark.parametrize("module", ["sb3_follow_object", "sb3_follow_object.command.cli"])
def test_modules_are_the_command(module: str) -> None:
    status, out, _ = command("--help", module=module)
    assert status == 0 and out.startswith("usage: sb3-follow-object [-h] [--version]")
    status, out, err = command(module=module)
    assert (status, out) == (2, "") and err.startswith("sb3-follow-object: the following argum")


# Folders that can only be read


def test_a_read_only_run_is_tested_and_never_written(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with read_only_copy(run) as folder:
        before = sorted(folder.rglob("*"))
        assert main(["evaluate", str(folder), "--episodes", "2", "--json"]) == 0
        other = ["--env", "FollowObject/PushMiddleGap-v0"]
        assert main(["evaluate", str(folder), "--episodes", "2", "--json", *other]) == 0
        printed = capsys.readouterr()
        assert printed.out.count('"success_rate": 0.0') == 2
        assert printed.err == (
            f"sb3-follow-object: the figure is not kept in {folder}: Permission denied\n"
        )
        for words, name in ((["watch"], "video.mp4"), (["plot"], "curve.png")):
            assert main([*words, str(folder)]) == 2
            err = capsys.readouterr().err
            assert err == f"sb3-follow-object: Permission denied: {folder}/{name}\n"
        assert main(["train", "--resume", "--run", str(folder)]) == 0
        assert "is finished already" in capsys.readouterr().out
        assert sorted(folder.rglob("*")) == before


@pytest.mark.usefixtures("can_draw")
def test_a_run_is_filmed_and_drawn_elsewhere_without_a_write(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in (run, *run.rglob("*"))}
    film, curve = tmp_path / "film.mp4", tmp_path / "curve.png"
    assert main(["watch", str(run), "--episodes", "1", "--out", str(film)]) == 0
    assert main(["plot", str(run), "--out", str(curve)]) == 0
    assert film.exists() and curve.exists()
    assert {path: path.stat().st_mtime_ns for path in (run, *run.rglob("*"))} == before


@pytest.mark.usefixtures("can_draw")
def test_a_name_may_be_as_long_as_the_disk_takes(run: Path, tmp_path: Path) -> None:
    film, curve = (tmp_path / ("x" * 251 + ending) for ending in (".mp4", ".png"))
    assert main(["watch", str(run), "--episodes", "1", "--out", str(film)]) == 0
    assert main(["plot", str(run), "--out", str(curve)]) == 0
    assert film.exists() and curve.exists()


def test_a_run_may_have_a_name_that_is_no_text(tmp_path: Path) -> None:
    folder = tmp_path / "odd\udcff\nname"
    words = ("train", "--env", runs.TASK, "--method", "her", "--steps", 200, "--n-envs", 2)
    words += ("--threads", 1, "--quiet", "--set", *TINY_NETWORKS, *TINY_TESTS[1:])
    assert command(*words, "--run", folder, MUJOCO_GL="off")[0] == 0
    noted = json.loads((folder / "result.json").read_text())["command"]
    assert noted == (folder / "command.txt").read_text()[:-1]
    assert noted.endswith(r"/odd\xff\x0aname'")


# Libraries that are there and do not work


def test_a_broken_package_is_not_called_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(error: Exception) -> Callable[[str], None]:
        def load(module: str) -> None:
            raise error

        return load

    for error in (
        ImportError("libstdc++.so.6: version not found"),
        ModuleNotFoundError("No module named 'kiwisolver'", name="kiwisolver"),
        AttributeError("module 'numpy' has no attribute 'core'"),
    ):
        monkeypatch.setattr(extras, "import_module", broken(error))
        with pytest.raises(extras.MissingExtra) as told:
            extras.need("matplotlib.figure", "plots")
        assert str(told.value) == f"matplotlib cannot be imported: {error}"


def test_figures_that_cannot_be_drawn_cost_no_comparison(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError("no fonts")

    monkeypatch.setattr(figures, "draw_results", fail)
    told: list[str] = []
    shutil.copytree(run, tmp_path / "results" / "PushSideGap-her-0")
    compare.write_report(tmp_path / "results", told.append)
    assert told == ["left out the figures: no fonts"]
    assert (tmp_path / "results" / "table.md").exists()


def test_a_broken_tensorboard_costs_its_log_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = stages.make_output_format

    def fail(kind: str, *arguments: str) -> object:
        if kind == "tensorboard":
            raise TypeError("Descriptors cannot be created directly")
        return make(kind, *arguments)

    monkeypatch.setattr(stages, "make_output_format", fail)
    told: list[str] = []
    logger = stages._logger(tmp_path, 0, told.append)
    assert [path.name for path in tmp_path.iterdir()] == ["progress_0.csv"]
    assert told == ["left out the log for TensorBoard: Descriptors cannot be created directly"]
    logger.close()


def test_a_device_that_is_not_there_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    told: list[str] = []
    settings = {"imagine": False, "algorithm": {**runs.TINY["algorithm"], "device": "cuda"}}
    config = runs.config(method="her", total_timesteps=200, settings=settings)
    experiment.train(config, tmp_path / "run", report=told.append)
    assert "there is no device 'cuda' here: the robot learns on the CPU" in told
