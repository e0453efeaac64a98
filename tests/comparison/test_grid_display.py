"""What a comparison shows while it runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from sb3_follow_object.common.reports import Trouble
from sb3_follow_object.comparison.executors import Message
from sb3_follow_object.comparison.grid_display import GridDisplay
from sb3_follow_object.comparison.worker import STAGE, TRAIN, Job, run_job
from sb3_follow_object.runs import experiment


def test_remaining_time_follows_the_steps_of_this_call_alone() -> None:
    now = [0.0]
    display = GridDisplay(quiet=True, clock=lambda: now[0])
    display.expect("a", 1000, 400)
    display.expect("b", 1000, 0)
    assert display.remaining() is None
    display.started("a", TRAIN)
    for now[0], steps in ((10.0, 500), (20.0, 600)):
        figures = {"env_steps": steps, "success_rate": None, "k_max": None}
        display.update("a", {"figures": figures})
    assert display.remaining() == pytest.approx(1400 * 20.0 / 100)
    display.ended("a", finished=True)
    assert display.remaining() == pytest.approx(1000 * 20.0 / 100)


def test_what_a_finished_run_is_said_to_have_is_its_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    display, told = GridDisplay(), []
    monkeypatch.setattr(display, "say", told.append)
    for name, kind in (("a", TRAIN), ("object/a", STAGE)):
        display.expect(name, 1000, 0)
        display.started(name, kind)
    figures = {"env_steps": 1000, "success_rate": 0.5, "k_max": 25}
    display.update("a", {"figures": figures})
    for name in ("a", "object/a"):
        display.update(name, {"say": "checkpoint at 1000 env steps: 0.2 MB"})
        display.ended(name, finished=True)
    assert told[2:] == ["a: train finished, success 0.50, k_max 25", "object/a: stage finished"]


def test_what_looks_like_markup_is_shown_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich draws as on a terminal
    monkeypatch.setenv("TERM", "xterm")
    with GridDisplay() as display:
        display.expect("run[/a]", 1000, 0)
        display.started("run[/a]", TRAIN)
        display.update("run[/a]", {"say": "wrote odd[/z]"})
        display.refresh()
    printed = capsys.readouterr().out
    assert "run[/a]" in printed and "odd[/z]" in printed


@pytest.mark.parametrize("quiet", [False, True])
def test_trouble_of_a_job_is_said(
    quiet: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*arguments: Any, report: Callable[[str], None], **options: Any) -> None:
        report("checkpoint at 500 env steps")
        report(Trouble("the checkpoint is not kept: No space left on device"))

    monkeypatch.setattr(experiment, "train", full)
    monkeypatch.setattr("sb3_follow_object.settings.presets.load_config", lambda folder: None)
    display = GridDisplay(quiet=quiet)
    display.started("a", TRAIN)
    told: list[Message] = []
    run_job(Job(TRAIN, "a", "a"), told.append)
    capsys.readouterr()
    for message in told:
        display.update("a", json.loads(json.dumps(message)))
    printed = capsys.readouterr()
    sentence = "a: the checkpoint is not kept: No space left on device\n"
    assert (printed.err if quiet else printed.out) == sentence
