"""Flags that mean the same as settings, and numbers as they are written."""

from __future__ import annotations

import json
import os
import subprocess
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from sb3_follow_object.command import cli
from sb3_follow_object.command.arguments import make_absolute, overrides_of, shell_line
from sb3_follow_object.command.cli_options import make_parser
from sb3_follow_object.settings.presets import run_config
from sb3_follow_object.settings.run_config import RunConfig

TASK = "FollowObject/PnPShelf-v0"


def parsed(*words: str) -> Namespace:
    return make_parser(cli._COMMANDS).parse_args(["train", "--run", "R", *words])


@pytest.mark.parametrize(
    ("text", "steps"),
    [("1000000", 10**6), ("1e6", 10**6), ("1_000_000", 10**6), ("2.5e3", 2500), ("3.0", 3)],
)
def test_steps_are_read_as_people_write_whole_numbers(text: str, steps: int) -> None:
    read = parsed("--steps", text).steps
    assert read == steps and isinstance(read, int)


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        (["--steps", "2000", "--set", "n_timesteps=2e3"], {"n_timesteps": 2000}),
        (["--n-envs", "4", "--set", "n_envs=4"], {"n_envs": 4}),
        (["--threads", "2"], {"n_threads": 2, "torch_threads": 2}),
        # As the commands that a comparison notes: a setting may be finer than its flag.
        (
            ["--threads", "2", "--set", "n_threads=4"],
            {"n_threads": 4, "torch_threads": 2},
        ),
        (["--set", "n_envs=4", "tau=0.1"], {"n_envs": 4, "tau": 0.1}),
    ],
)
def test_flags_and_settings_that_agree_are_taken(
    words: list[str], settings: dict[str, Any]
) -> None:
    assert overrides_of(parsed(*words)) == settings


def kept_run(folder: Path, config: RunConfig) -> Path:
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(asdict(config)))
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["--env", f"sb3_follow_object:{TASK}"],
        ["--env", TASK, "--threads", "2", "--set", "torch_threads=1"],
        ["--env", TASK, "--threads", "2", "--set", "n_threads=1"],
    ],
    ids=["module before the id", "one thread of torch", "one thread of the simulation"],
)
def test_the_words_that_started_a_run_resume_it(words: list[str], tmp_path: Path) -> None:
    args = parsed("--resume-or-start", *words)
    config = cli._config(args)
    args.run = kept_run(tmp_path / "run", config)
    assert cli._resumed_config(args) == config
    again = parsed("--resume", "--threads", "3")
    again.run = args.run
    with pytest.raises(ValueError, match="not 3"):
        cli._resumed_config(again)


def test_paths_stay_those_that_were_given_when_an_environment_changes_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    args = make_parser(cli._COMMANDS).parse_args(["plot", "a", "b/c", "--out", "curve.png"])
    make_absolute(args)
    assert args.runs == [tmp_path / "a", tmp_path / "b" / "c"]
    assert args.out == tmp_path / "curve.png"


def test_a_resumed_run_may_be_told_the_copies_that_it_has_by_default(tmp_path: Path) -> None:
    config = RunConfig(TASK, "her", settings={"imagine": False})
    run = kept_run(tmp_path / "run", config)
    args = parsed("--resume", "--n-envs", "16")
    args.run = run
    assert cli._resumed_config(args) == config
    args.n_envs = 8
    with pytest.raises(ValueError, match="has --n-envs 16, not 8"):
        cli._resumed_config(args)


def test_a_resumed_runs_steps_can_be_set_either_way(tmp_path: Path) -> None:
    run = kept_run(tmp_path / "run", run_config(TASK))
    for words in (["--steps", "5000"], ["--set", "n_timesteps=5000"]):
        args = parsed("--resume", *words)
        args.run = run
        assert cli._resumed_config(args).total_timesteps == 5000


def test_noted_commands_are_a_line_of_plain_letters_that_bash_reads_back() -> None:
    words = ["echo", "a'b", "two\nlines\r", "\udcff\x01\\'", "ü x", "k=[1, 2]", "\u2028"]
    line = shell_line(words)
    assert line.isprintable() and "\n" not in line
    line.encode()  # no bytes that are no text
    done = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], capture_output=True, check=True)
    assert done.stdout.split(b"\0")[:-1] == [os.fsencode(word) for word in words]
