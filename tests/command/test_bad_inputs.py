"""Every bad input of bad_inputs.yaml gets its sentence, exit code 2, and nothing is written."""

from __future__ import annotations

import json
import os
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_follow_object.command.cli import main
from sb3_follow_object.object_stage.stage import ObjectStage
from sb3_follow_object.runs.stages import RunStages
from sb3_follow_object.settings.presets import SAVED_STATE, run_config

TASK = "FollowObject/PushSideGap-v0"
CASES = yaml.safe_load(Path(__file__).with_name("bad_inputs.yaml").read_text())


def test_corpus_is_as_large_as_was_promised() -> None:
    assert len(CASES) >= 150
    assert len({(case["command"], case.get("file")) for case in CASES}) == len(CASES)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the broken run folders that the corpus speaks of."""
    config = json.dumps(asdict(run_config(TASK)))
    for name in ("CONFIG", "ENDED", "BADCONFIG", "BADPOLICY"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{" if name == "BADCONFIG" else config)
    (tmp_path / "ENDED" / "result.json").write_text("{}")
    (tmp_path / "SAVED").mkdir()
    (tmp_path / "SAVED" / SAVED_STATE).touch()
    (tmp_path / "MODEL.zip").touch()
    (tmp_path / "BADPOLICY" / "policy.safetensors").write_bytes(bytes(100))
    monkeypatch.chdir(tmp_path)

    def accepted(*arguments: Any, **options: Any) -> None:
        raise AssertionError("the input was accepted")  # rather than trained for hours

    monkeypatch.setattr(RunStages, "learn_robot_stage", accepted)
    monkeypatch.setattr(ObjectStage, "learn_predictor", accepted)
    return tmp_path


def id_of(case: dict[str, Any]) -> str:
    return f"{case['command']} {case.get('file', '')}"[-60:]


@pytest.mark.parametrize("case", CASES, ids=id_of)
def test_bad_input_is_refused(
    case: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if "file" in case:
        (folder / "FILE.yml").write_text(case["file"])
    before = sorted(folder.rglob("*"))
    words = [TASK if word == "T" else word for word in shlex.split(case["command"])]
    try:
        status: Any = main(words)
    except SystemExit as stop:  # argparse
        status = stop.code
    printed = capsys.readouterr()
    said = [case["says"]] if isinstance(case["says"], str) else case["says"]
    assert status == 2
    assert printed.out == ""
    assert printed.err.startswith("sb3-follow-object: ")
    assert printed.err.count("\n") == 1
    # Paths are told from the root on.
    told = printed.err.replace(f"{folder}{os.sep}", "").replace(f"{folder} ", ". ")
    assert all(sentence in told for sentence in said), printed.err
    assert sorted(folder.rglob("*")) == before
