"""A run that validations call solved ends before its steps are gone, and says so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_runs import config, outcome, quiet

import sb3_follow_object.callbacks.eval_callback as eval_callback
from sb3_follow_object.callbacks.rollout import Episodes
from sb3_follow_object.runs import stages
from sb3_follow_object.runs.experiment import train

SOLVED = config(solved_at=0.9, solved_validations=2, eval_every=300)


@pytest.fixture
def validations(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Success rates that the coming validations have."""
    rates: list[float] = []

    def run_episodes(*arguments: Any) -> Episodes:
        rate = rates.pop(0)
        return Episodes(*[np.arange(10) < 10 * rate] * 2, np.zeros(10), 0)

    monkeypatch.setattr(eval_callback, "run_episodes", run_episodes)
    return rates


def test_it_ends_after_enough_good_validations_in_a_row(
    validations: list[float], tmp_path: Path
) -> None:
    validations += [1.0, 0.5, 0.9, 0.9, 1.0]
    said: list[str] = []
    whole = train(SOLVED, tmp_path / "whole", report=said.append)
    assert validations == [1.0], "the second in a row was the last"
    rows = (tmp_path / "whole" / "evaluations.csv").read_text().splitlines()
    assert len(rows) == 1 + 4 and whole["env_steps"] == int(rows[-1].split(",")[0]) < 3600
    assert whole["solved"] is True
    assert [each for each in said if each.startswith("solved after")] == [
        f"solved after {whole['env_steps']} env steps of 3600: "
        "2 validations in a row of 0.9 or more"
    ]
    assert json.loads((tmp_path / "whole" / "result.json").read_text()) == whole
    assert train(SOLVED, tmp_path / "whole", resume=True, report=quiet) == whole, "it is finished"


def test_an_interrupted_run_counts_on_and_ends_as_the_uninterrupted_one(
    validations: list[float], tmp_path: Path
) -> None:
    validations += [0.9, 0.9]
    train(SOLVED, tmp_path / "whole", report=quiet)

    def interrupt(figures: dict[str, Any]) -> None:
        if figures["success_rate"] is not None:
            raise KeyboardInterrupt

    validations += [0.9]
    with pytest.raises(KeyboardInterrupt):
        train(SOLVED, tmp_path / "part", report=quiet, progress=interrupt)
    validations += [0.9, 0.9]  # the checkpoint is of the rollout before
    train(SOLVED, tmp_path / "part", resume=True, report=quiet)
    assert not validations
    assert outcome(tmp_path / "part") == outcome(tmp_path / "whole")


def test_a_solved_run_that_is_stopped_in_its_final_test_has_ended(
    validations: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    validations += [0.9, 0.9]
    train(SOLVED, tmp_path / "whole", report=quiet)

    def interrupt(*arguments: Any) -> None:
        raise KeyboardInterrupt

    validations += [0.9, 0.9]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "evaluate", interrupt)
        train(SOLVED, tmp_path / "part", report=quiet)
    result = train(SOLVED, tmp_path / "part", resume=True, report=quiet)
    assert result["solved"] is True
    assert outcome(tmp_path / "part") == outcome(tmp_path / "whole")


def test_without_it_no_validation_ends_a_run(validations: list[float], tmp_path: Path) -> None:
    validations += [1.0] * 9
    result = train(config(), tmp_path / "run", report=quiet)
    assert result["env_steps"] >= 3600 and "solved" not in result
