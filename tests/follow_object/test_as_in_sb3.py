"""`FollowObject.learn` where it looks like SB3's: logs, progress bar, threads, calls that go on."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from tiny_runs import SMALL_NET, TINY, bare_run

from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.object_stage.stage import ObjectStage

ENV = "FollowObject/PushSideGap-v0"


@pytest.fixture(scope="module")
def predictor() -> GoalPredictor:
    run = bare_run(ENV, **TINY)
    made = run.object_stage.learn_predictor()
    run.close()
    return made


def imagining(predictor: GoalPredictor, algorithm: dict[str, Any], **more: Any) -> FollowObject:
    settings = {**TINY, "algorithm": {**SMALL_NET, **algorithm}, "curriculum": {"threshold": 0.0}}
    return bare_run(ENV, predictor=predictor, **settings, **more)


def test_verbose_prints_a_table_a_rollout(
    predictor: GoalPredictor, capsys: pytest.CaptureFixture[str]
) -> None:
    run = imagining(predictor, {"verbose": 1})
    run.learn(400)
    assert run.model is not None
    printed = capsys.readouterr().out
    rollouts = (400 - run.test_steps) // (2 * run.horizon)
    assert rollouts > 0 and printed.count("rollout/") == rollouts
    assert "success_rate" in printed
    quiet = imagining(predictor, {})
    quiet.learn(400)
    assert capsys.readouterr().out == ""


def test_a_logger_of_ones_own_is_written_when_one_says_so(
    predictor: GoalPredictor, tmp_path: Path
) -> None:
    """As in `train`, whose log has a line a validation."""
    run = imagining(predictor, {"verbose": 1})
    run.prepare().set_logger(configure(str(tmp_path), ["csv"]))
    run.learn(400)
    assert (tmp_path / "progress.csv").read_text() == ""
    run.learn(1000, log_interval=2)
    with open(tmp_path / "progress.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) > 0


def test_each_training_has_a_folder_of_its_own_in_tensorboard(
    predictor: GoalPredictor, tmp_path: Path
) -> None:
    for seed in (0, 1):
        run = imagining(predictor, {"tensorboard_log": str(tmp_path)}, seed=seed)
        run.learn(300)
        run.learn(700)
    imagining(predictor, {"tensorboard_log": str(tmp_path)}).learn(300, tb_log_name="mine")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "FollowObject_1",
        "FollowObject_2",
        "mine_1",
    ]


def test_the_progress_bar_ends_where_the_training_does(
    predictor: GoalPredictor, capsys: pytest.CaptureFixture[str]
) -> None:
    run = imagining(predictor, {})
    run.learn(400)
    before = run.env_steps
    run.learn(1200, progress_bar=True)
    assert run.test_steps > 0, "tests are what SB3's own bar does not see"
    total = 1200 - before
    assert f"{run.env_steps - before:,}/{total:,}" in capsys.readouterr().out


def test_a_call_that_has_nothing_to_train_says_so(predictor: GoalPredictor) -> None:
    said: list[str] = []
    run = imagining(predictor, {}, report=said.append)
    run.learn(400)
    said.clear()
    run.learn(100)
    assert said == [f"{run.env_steps:,} env steps are done already, of 100 in all: none are left"]


class Threads(BaseCallback):
    def _on_training_start(self) -> None:
        self.seen = th.get_num_threads()

    def _on_step(self) -> bool:
        return True


def test_pytorch_has_one_thread_while_it_learns_and_then_as_many_as_before(
    predictor: GoalPredictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    def learn_predictor(self: ObjectStage) -> GoalPredictor:
        seen.append(th.get_num_threads())
        self.use_predictor(predictor)
        return predictor

    monkeypatch.setattr(ObjectStage, "learn_predictor", learn_predictor)
    earlier = th.get_num_threads()
    th.set_num_threads(2)
    try:
        callback = Threads()
        bare_run(ENV, **TINY).learn(300, callback)
        assert [*seen, callback.seen, th.get_num_threads()] == [1, 1, 2]
    finally:
        th.set_num_threads(earlier)
