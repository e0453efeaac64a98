"""Jobs in processes of their own: their failures, stops and ends."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fake_jobs import SETTINGS
from result_folders import finish

from sb3_follow_object.command import cli
from sb3_follow_object.common.files import lock
from sb3_follow_object.comparison import figures
from sb3_follow_object.comparison.cells import Settings, prepare
from sb3_follow_object.comparison.executors import LocalExecutor, Message
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.comparison.grid_display import GridDisplay
from sb3_follow_object.comparison.worker import TRAIN, Job, run_job
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.runs.run_folder import RESULT
from sb3_follow_object.settings.presets import load_config, parse_override

TINY = ["policy_kwargs.net_arch=[8]", "batch_size=16", "gradient_steps=2", "n_envs=2"]
TINY += ["eval_every=400", "n_eval_episodes=2", "n_final_episodes=2", "buffer_size=2000"]


def finished_job(executor: LocalExecutor) -> Message:
    """Wait for the only job's last message."""
    while True:
        for _, message in executor.messages(1.0):
            if {"finished", "stopped", "failed"} & set(message):
                return message


def test_worker_that_raises_or_dies_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = LocalExecutor(1, tmp_path / "logs")
    executor.start(Job(TRAIN, "raises", str(tmp_path / "none")))
    failure = finished_job(executor)["failed"]
    assert failure.startswith("ValueError: ")
    assert "holds no run" in failure
    assert "Traceback" in (tmp_path / "logs" / "raises.log").read_text()

    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho almost there >&2\nkill -9 $$\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    executor.start(Job(TRAIN, "dies", str(tmp_path)))
    expected = "killed by signal 9; the log's last line: almost there"
    assert finished_job(executor) == {"failed": expected}


def test_worker_stops_with_a_checkpoint_when_its_comparison_is_gone(tmp_path: Path) -> None:
    overrides = dict(parse_override(text) for text in TINY)
    (cell,) = plan(tmp_path, ["PushSideGap"], ["her"], [0], Settings(100_000, overrides=overrides))
    prepare(cell, None)
    executor = LocalExecutor(1, tmp_path / "logs")
    executor.start(Job(TRAIN, cell.name, str(cell.folder)))
    while not any("figures" in message for _, message in executor.messages(1.0)):
        pass
    child = executor._children[cell.name]
    child.stdin.close()  # type: ignore[union-attr]  # as the system does when a process dies
    assert finished_job(executor) == {"stopped": True}
    assert list(cell.folder.glob("checkpoint*"))


def test_real_run_is_stopped_resumed_and_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["compare", "--out", str(tmp_path), "--tasks", "PushSideGap", "--methods", "her"]
    words += ["--seeds", "5", "--steps", "600", "--jobs", "1", "--threads", "1", "--set", *TINY]
    update = GridDisplay.update

    def stop_at_once(self: GridDisplay, name: str, message: Message) -> None:
        update(self, name, message)
        if "figures" in message:
            monkeypatch.setattr(GridDisplay, "update", update)
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(GridDisplay, "update", stop_at_once)
    run = tmp_path / "PushSideGap-her-5"
    with monkeypatch.context() as patch:
        patch.setattr(figures, "draw_results", lambda *arguments: [])
        assert cli.main(words) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert not (run / RESULT).exists()
    assert list(run.glob("checkpoint*")), "it was stopped without a checkpoint"
    assert "unfinished" in (tmp_path / "table.md").read_text()
    assert cli.main(words) == 0
    assert list((tmp_path / "figures").glob("*.png"))
    printed = capsys.readouterr()
    assert "resumed at" in (tmp_path / "logs" / "PushSideGap-her-5.log").read_text()
    assert "| PushSideGap | " in printed.out
    result = json.loads((run / RESULT).read_text())
    assert result["env_steps"] == 600
    assert result["command"].startswith(f"sb3-follow-object train --run {run} --env")
    assert cli.main([*words, "--steps", "700"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    with lock(tmp_path, wait=False):
        assert cli.main(words) == 2
    assert f"another process works in {tmp_path}" in capsys.readouterr().err


def test_job_waits_for_the_worker_of_a_killed_comparison(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PushSideGap"], ["her"], [0], SETTINGS)
    prepare(cell, None)
    other = ExitStack()  # that worker: it has not heard yet that its comparison is gone
    other.enter_context(lock(cell.folder, wait=False))
    with pytest.raises(ValueError, match="another process works in"):
        train(load_config(cell.folder), cell.folder, resume=True, report=pytest.fail)

    def end() -> None:
        finish(cell.folder, env_steps=1000)
        other.close()

    threading.Timer(0.5, end).start()
    told: list[dict[str, Any]] = []
    run_job(Job(TRAIN, cell.name, str(cell.folder)), told.append)
    assert told == [{"say": f"{cell.folder} is finished already"}], "it looks after it waited"
