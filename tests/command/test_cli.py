"""The command line: a run from start to pictures, and one sentence for every bad input."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import TINY
from short_films import record_an_episode

from sb3_follow_object.any_task.tasks import kept_as
from sb3_follow_object.command import pictures
from sb3_follow_object.command.cli import _print_table, main
from sb3_follow_object.common import extras
from sb3_follow_object.common.files import LOCK, lock
from sb3_follow_object.common.reports import Trouble
from sb3_follow_object.envs import physics_id
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.runs import predictor_cache, progress
from sb3_follow_object.runs.checkpoints import Checkpoints
from sb3_follow_object.runs.predictor_cache import (
    CACHE_VARIABLE,
    OF_OBJECT_STAGE,
    get_predictor,
)
from sb3_follow_object.runs.progress import ProgressBar, Terminal
from sb3_follow_object.runs.run_folder import check_empty

TASK = "FollowObject/PushSideGap-v0"
START = ["train", "--env", TASK, "--steps", "2200", "--n-envs", "2", "--threads", "1"]
START += ["--seed", "3", "--set", *TINY]


def run(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str, str]:
    """Run a command line; return its exit status and what it printed."""
    try:
        status = main([str(word) for word in argv])
    except SystemExit as stop:  # argparse
        status = int(stop.code or 0)
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def refusal(capsys: pytest.CaptureFixture[str], *argv: object) -> str:
    """Run a command line that must be refused in one line; return the line."""
    status, out, err = run(capsys, *argv)
    assert (status, out) == (2, "")
    assert err.startswith("sb3-follow-object: ")
    assert err.count("\n") == 1
    return err


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was interrupted once and then finished."""
    folder = tmp_path_factory.mktemp("runs") / "fo"
    rollouts: list[dict[str, Any]] = []

    def interrupt(self: ProgressBar, figures: dict[str, Any]) -> None:
        rollouts.append(figures)
        if len(rollouts) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ProgressBar, "update", interrupt)
        patch.setattr(pictures, "record", record_an_episode)
        assert main([*START, "--run", str(folder)]) == 130
        assert not (folder / "result.json").exists()
        assert main(["train", "--run", str(folder), "--resume"]) == 0
    steps = [figures["env_steps"] for figures in rollouts]
    assert steps == sorted(set(steps)), "a rollout was done twice"
    return folder


@pytest.mark.usefixtures("can_draw")
def test_run_folder_holds_all_that_was_promised(finished: Path) -> None:
    names = {file.name for file in finished.iterdir()}
    assert {"config.json", "versions.json", "result.json", "evaluations.csv"} <= names
    assert {"policy.safetensors", "predictor"} <= names
    assert "object_networks.safetensors" not in names, "only SLDR needs them"
    assert {"curve.png", "task.png", "imagined.png", "video.mp4"} <= names
    assert not [name for name in names if name.startswith("checkpoint")]
    assert {name for name in names if name.startswith(".")} == {".lock"}, "half-written files"
    result = json.loads((finished / "result.json").read_text())
    assert result["env_steps"] >= 2200
    assert result["command"] == shlex.join(["sb3-follow-object", *START, "--run", str(finished)])


def test_evaluation_repeats_the_final_test(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, "evaluate", finished, "--episodes", 8, "--json")
    assert (status, err) == (0, "")
    result = json.loads((finished / "result.json").read_text())
    assert json.loads(out) == {
        "env": TASK,
        "method": "fo",
        "seed": 3,
        "episodes": 8,
        "success_rate": result["success_rate"],
        "reached_rate": json.loads(out)["reached_rate"],
        "env_steps": result["env_steps"],
    }
    assert json.loads(out)["reached_rate"] >= result["success_rate"]


def test_evaluation_is_a_table_of_a_line_in_eighty_columns(
    finished: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    status, out, _ = run(capsys, "evaluate", finished, "--episodes", 4)
    assert status == 0
    (row,) = (line for line in out.splitlines() if TASK in line)
    steps = json.loads((finished / "result.json").read_text())["env_steps"]
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[:4] == [TASK, "fo", "3", f"{steps:,}"]
    assert cells[4].endswith(" of 4")
    assert out.splitlines()[-1].startswith("reached at any step: ")


def test_task_named_with_its_module_is_no_other_task(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    same = f"sb3_follow_object:{TASK}"
    status, out, _ = run(capsys, "evaluate", finished, "--episodes", 2, "--json", "--env", same)
    assert status == 0 and "reached_rate" in json.loads(out)
    assert not (finished / "cross_tests.json").exists()


def test_policy_and_config_alone_can_be_evaluated(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("policy.safetensors", "config.json"):
        shutil.copy(finished / name, tmp_path)
    status, out, _ = run(capsys, "evaluate", tmp_path, "--episodes", 2, "--json")
    assert status == 0
    assert json.loads(out)["env_steps"] is None


def test_finished_run_is_left_as_it_is(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {file: file.read_bytes() for file in finished.iterdir() if file.is_file()}
    status, out, _ = run(capsys, "train", "--run", finished, "--resume-or-start", "--env", TASK)
    assert status == 0
    assert "finished already" in out
    assert {file: file.read_bytes() for file in finished.iterdir() if file.is_file()} == before


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--seed", "4"], "has --seed 3, not 4"),
        (["--env", "FollowObject/PnPShelf-v0"], f"has --env {TASK}, not FollowObject/PnPShelf-v0"),
        (["--method", "her"], "has --method fo, not her"),
        (["--set", "curriculum.p=0.9"], "settings.curriculum.p"),
        (["--steps", "9000"], "kept no checkpoint to go on from"),
    ],
)
def test_resuming_changes_nothing(
    finished: Path, capsys: pytest.CaptureFixture[str], flags: list[str], sentence: str
) -> None:
    words = [*START[: -len(TINY)], *TINY] if "--set" in flags else ["train"]
    words = [*words, *flags[1:]] if "--set" in flags else [*words, *flags]
    err = refusal(capsys, *words, "--run", finished, "--resume")
    assert sentence in err


def test_a_result_of_before_that_lacks_figures_is_shown(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    result = json.loads((folder / "result.json").read_text())
    for name in ("k_max", "task", "episodes"):
        del result[name]
    (folder / "result.json").write_text(json.dumps(result))
    status, out, _ = run(capsys, "train", "--run", folder, "--resume")
    assert status == 0 and " of ?" in out


def test_folder_of_another_run_is_not_written_over(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "is not empty" in refusal(capsys, *START, "--run", finished)
    assert "is not empty" in refusal(capsys, *START, "--run", finished / "config.json")
    assert "is not empty" in refusal(capsys, "predictor", "--env", TASK, "--out", finished)


def test_predictor_of_another_task_is_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(finished / "predictor", tmp_path / "predictor")
    other = "FollowObject/PnPShelf-v0"
    with pytest.raises(ValueError, match="was made for env_id"):
        get_predictor(other, tmp_path / "predictor")
    config = json.loads((finished / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "env_id": other}))
    shutil.copy(finished / "object_stage.json", tmp_path)
    err = refusal(capsys, "train", "--run", tmp_path, "--resume")
    assert f"was made for env_id '{TASK}', not for '{other}'" in err


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--env", "FollowObject/PushSidegap-v0"], f"did you mean '{TASK}'"),
        (["--env", "CartPole-v1"], "'CartPole-v1' has no goals"),
        (["--env", "FetchReach-v4"], "'FetchReach-v4': the achieved goal is a point of the robot"),
        ([], "say which task to train with --env"),
        (["--env", TASK, "--set", "batchsize=3"], "did you mean 'batch_size'"),
        (["--env", TASK, "--set", "batch_size"], "write key=value"),
        (["--env", TASK, "--set", "curriculum.k_max=51", "curriculum.levels=time"], "at most 50"),
        (["--env", TASK, "--set", "curriculum.p=1.5"], "p is 1.5; it must lie in [0, 1]"),
        (["--env", TASK, "--set", "curriculum.threshold=-1"], "threshold is -1; it must lie in"),
        (["--env", TASK, "--n-envs", "0"], "n_envs is 0; it must be at least 1"),
        (["--env", TASK, "--steps", "0"], "n_timesteps is 0; it must be at least 1"),
        (["--env", TASK, "--seed", "-1"], "seed is -1; it must be at least 0"),
        (["--env", TASK, "--set", "replay_buffer_kwargs.moved_ratio=2"], "moved_ratio is 2"),
        (["--env", TASK, "--set", "object_algorithm.random_action_prob=2"], "random_action_prob"),
        (["--env", TASK, "--config", "none.yml"], "none.yml cannot be read"),
        (["--env", TASK, "--resume"], "holds no run"),
        (
            ["--env", TASK, "--method", "rnd", "--set", "auxiliary.hidden=[0]"],
            "hidden must be 1 to 16 whole numbers",
        ),
        (["--env", TASK, "--method", "rnd", "--set", "auxiliary.name=rdn"], "did you mean 'rnd'"),
        (["--env", TASK, "--method", "sldr", "--set", "auxiliary.hidden=[8]"], "'hidden'"),
        (["--env", TASK, "--method", "cher", "--set", "replay_buffer_kwargs.cher.picks=0"], "cher"),
        (["--env", "FetchReach-v4", "--method", "sldr"], "'FetchReach-v4' is not a task of this"),
        (["--env", TASK, "--colour"], "unrecognized arguments: --colour"),
        (["--env", TASK, "--method", "magic"], "invalid choice: 'magic'"),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], sentence: str
) -> None:
    folder = tmp_path / "run"
    assert sentence in refusal(capsys, "train", "--run", folder, *flags)
    assert not folder.exists()


@pytest.mark.parametrize("command", ["evaluate", "watch", "plot"])
def test_folder_without_a_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert "holds no run" in refusal(capsys, command, tmp_path)
    assert not list(tmp_path.iterdir())


def test_damaged_policy_is_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(finished / "config.json", tmp_path)
    assert "there is no file" in refusal(capsys, "evaluate", tmp_path)
    half = (finished / "policy.safetensors").read_bytes()[:100]
    (tmp_path / "policy.safetensors").write_bytes(half)
    assert "is not a whole checkpoint" in refusal(capsys, "evaluate", tmp_path)
    assert "episodes is 0" in refusal(capsys, "watch", finished, "--episodes", 0)
    assert "n_episodes is 0" in refusal(capsys, "evaluate", finished, "--episodes", 0)


@pytest.mark.usefixtures("can_draw")
def test_watch_and_plot_write_where_they_are_told(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = tmp_path / "video.mp4"
    status, out, _ = run(capsys, "watch", finished, "--episodes", 1, "--out", video)
    assert (status, video.read_bytes()[4:8]) == (0, b"ftyp")
    assert out.startswith(f"{video}: success ") and out.endswith(" of 1\n")
    figure = tmp_path / "curve.png"
    assert run(capsys, "plot", finished, finished, "--out", figure)[0] == 0
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_pictures_without_the_extras_are_left_out_with_a_sentence(
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(module, name=module.partition(".")[0])

    folder = tmp_path / "run"
    shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("*.png", "*.mp4"))
    monkeypatch.setattr(extras, "import_module", missing)
    status, out, _ = run(capsys, "train", "--run", folder, "--resume")
    assert status == 0
    assert "left out curve.png: matplotlib is not installed" in out
    assert "pip install 'sb3-follow-object[plots]'" in out
    assert "video.mp4: imageio is not installed" in out
    err = refusal(capsys, "watch", folder)
    assert "pip install 'sb3-follow-object[video]'" in err


def test_predictor_is_learned_once_and_then_taken_from_the_cache(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    folder = tmp_path / TASK / kept_as(TASK)
    own = [text for text in TINY if text.split("=")[0].split(".")[0] in OF_OBJECT_STAGE]
    words = ["predictor", "--env", TASK, "--seed", 1, "--out", folder, "--set", *own]
    folder.mkdir(parents=True)
    (folder / LOCK).touch()  # as one leaves that was interrupted
    assert run(capsys, *words)[0] == 0
    start, goal = np.array([[1.3, 0.7, 0.425]]), np.array([[1.3, 0.9, 0.425]])
    kept = GoalPredictor.load(folder, env_id=TASK, physics=physics_id(TASK))
    cached = get_predictor(TASK, report=pytest.fail)
    np.testing.assert_array_equal(cached.paths(start, goal), kept.paths(start, goal))
    with pytest.raises(ValueError, match="CartPole"):
        get_predictor("CartPole-v1")


def test_predictor_sees_that_it_cannot_write_before_it_learns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictor_cache, "learn_predictor", pytest.fail)
    (tmp_path / "file").touch()
    words = ["predictor", "--env", TASK, "--out"]
    assert "Not a directory" in refusal(capsys, *words, tmp_path / "file" / "phi")
    (tmp_path / "held").mkdir()
    with lock(tmp_path / "held", wait=False):
        assert "another process works in" in refusal(capsys, *words, tmp_path / "held")


def test_help_does_not_wait_for_torch() -> None:
    code = "import sys; from sb3_follow_object.command.cli import main\n"
    code += "try: main(['train', '--help'])\nexcept SystemExit: pass\n"
    code += "print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.splitlines()[-1].split())
    assert not {"torch", "mujoco", "stable_baselines3", "matplotlib"} & modules


def test_quiet_does_not_hide_trouble(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal(quiet=True)
    terminal.say("all is well")
    terminal.say(Trouble("the disk is full"))
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "the disk is full\n")


def test_the_speed_is_told_from_the_second_figure_on(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter((0.0, 100.0, 200.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    bar, told = ProgressBar(10_000, quiet=True), list[str]()
    monkeypatch.setattr(bar, "say", told.append)
    for steps in (1000, 3000):
        bar.update({"env_steps": steps, "success_rate": None, "k_max": 2})
    assert told == [
        "1,000/10,000 steps  success -  k_max 2",
        "3,000/10,000 steps  success -  k_max 2  20 steps/s",
    ]


def test_a_checkpoint_says_whose_steps_it_counts(tmp_path: Path) -> None:
    told: list[str] = []
    checkpoints = Checkpoints(tmp_path, 2, told.append)
    for steps, stage in ((16016, "object"), (25616, "robot")):
        checkpoints.write(steps, {"stage": stage})
    checkpoints.wait()
    assert told[0].startswith("checkpoint at 16016 env steps of the object's training: ")
    assert told[1].startswith("checkpoint at 25616 env steps: ")


def test_a_reader_who_has_gone_is_an_error_like_others() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as gone:
        with pytest.raises(OSError, match="nobody reads"):
            Terminal(file=gone).say("hello")
        with contextlib.suppress(BrokenPipeError):
            gone.close()


def test_what_a_start_left_does_not_bar_the_next(tmp_path: Path) -> None:
    """A full disk, or a kill, before the configuration was written."""
    for name in ("versions.json", "command.txt", ".config.json.abc.tmp", LOCK):
        (tmp_path / name).write_text("{}")
    check_empty(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="is not empty"):
        check_empty(tmp_path)


def test_tables_show_whole_names(capsys: pytest.CaptureFixture[str]) -> None:
    _print_table({"env": "FollowObject/PnPSimpleV2-v0" * 3, "command": "x" * 100, "success": 0.5})
    printed = capsys.readouterr().out
    assert "\u2026" not in printed
    assert printed.count("x") == 100
