"""Validation counts every step, shows original goals, and goes on with its file."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy
from imagined import N, bare, imagining, learner
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_follow_object.callbacks import eval_callback
from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_evaluations_count_every_step_and_show_original_goals(tmp_path: Path) -> None:
    curriculum = toy.curriculum(threshold=1.0, k_max=6)
    test = CurriculumCallback(imagining(curriculum, "test"), N)
    path = tmp_path / "eval.csv"
    evaluation = OriginalGoalEvalCallback(
        bare(), 10, 160, path, curriculum_callback=test, object_steps=1000
    )
    model = learner(imagining(curriculum))
    model.learn(320, callback=[test, evaluation])
    found = rows(path)
    assert tuple(found[0]) == OriginalGoalEvalCallback.COLUMNS
    assert [int(row["train_steps"]) for row in found] == [80, 160]
    assert [int(row["test_steps"]) for row in found] == [80, 160]
    assert [int(row["env_steps"]) for row in found] == [1160, 1320]
    assert {row["episodes"] for row in found} == {"10"}
    assert {row["k_max"] for row in found} == {"6"}
    assert float(found[0]["wall_s"]) <= float(found[1]["wall_s"])
    assert 0 <= float(found[-1]["success_rate"]) <= 1
    assert evaluation.env_steps == 160 + 160 + 1000


def test_a_policy_that_flies_to_its_goal_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def to_the_goal(self: Any, obs: dict[str, np.ndarray], **_: Any) -> Any:
        way = (obs["desired_goal"] - obs["achieved_goal"]) / toy.STEP
        return np.clip(way, -1, 1).astype(np.float32), None

    evaluation = OriginalGoalEvalCallback(bare(), 10, 40, tmp_path / "eval.csv")
    model = learner(bare())
    monkeypatch.setattr(DDPG, "predict", to_the_goal)
    model.learn(40, callback=evaluation)
    assert evaluation.success_rate == 1.0
    (row,) = rows(tmp_path / "eval.csv")
    assert row["success_rate"] == "1.0"
    assert -7 <= float(row["mean_return"]) <= -2
    assert row["k_max"] == ""


def test_each_evaluation_has_fresh_episodes() -> None:
    goals: list[np.ndarray] = []

    class Noting(toy.PointEnv):
        def reset(self, **options: Any) -> Any:
            obs, info = super().reset(**options)
            goals.append(self.goal)
            return obs, info

    evaluation = OriginalGoalEvalCallback(DummyVecEnv([Noting] * 2), 4, 40)
    learner(bare()).learn(120, callback=evaluation)
    assert len(goals) >= 12
    assert len(np.unique(np.array(goals), axis=0)) == len(goals)


def test_a_resumed_evaluation_goes_on_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "eval.csv"
    first = OriginalGoalEvalCallback(bare(), N, 80, path)
    model = learner(bare())
    model.learn(160, callback=first)
    state = json.loads(json.dumps(first.state_dict()))
    kept = rows(path)
    # The run goes on, writes a row, and is then killed: its last saved state is the one above.
    model.learn(80, callback=first, reset_num_timesteps=False)
    assert [row["train_steps"] for row in rows(path)] == ["80", "160", "240"]
    second = OriginalGoalEvalCallback(bare(), N, 80, path)
    second.load_state_dict(state)
    resumed = learner(bare())
    resumed.num_timesteps = 160
    resumed.learn(120, callback=second, reset_num_timesteps=False)
    found = rows(path)
    assert found[:2] == kept
    assert [row["train_steps"] for row in found] == ["80", "160", "240"]
    assert float(found[2]["wall_s"]) >= float(kept[1]["wall_s"])


def test_learning_anew_after_a_resumption_counts_anew() -> None:
    evaluation = OriginalGoalEvalCallback(bare(), N, 40)
    first = OriginalGoalEvalCallback(bare(), N, 40)
    learner(bare()).learn(160, callback=first)
    evaluation.load_state_dict(first.state_dict())
    model = learner(bare())
    model.num_timesteps = 160
    model.learn(80, callback=evaluation, reset_num_timesteps=False)
    before = evaluation.n_evaluations
    model.learn(160, callback=evaluation)
    assert evaluation.n_evaluations - before == 160 // 40


def test_a_model_that_has_trained_less_is_evaluated_too() -> None:
    evaluation = OriginalGoalEvalCallback(bare(), N, 40)
    learner(bare()).learn(400, callback=evaluation)
    before = evaluation.n_evaluations
    model = learner(bare())
    model.learn(40)
    model.learn(160, callback=evaluation, reset_num_timesteps=False)
    assert evaluation.n_evaluations - before == 160 // 40


def test_only_training_counts_as_training_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(eval_callback.time, "monotonic", lambda: now[0])
    evaluation = OriginalGoalEvalCallback(bare(), N, 80, wall_before=5.0)
    now[0] += 1000.0  # the object learns meanwhile
    model = learner(bare())

    class TakesTwoSeconds(BaseCallback):
        def _on_step(self) -> bool:
            now[0] += 2.0 / 20  # of twenty steps
            return True

    for ends_at in (7.0, 9.0):
        model.learn(80, callback=[evaluation, TakesTwoSeconds()], reset_num_timesteps=False)
        assert evaluation.wall_s == pytest.approx(ends_at)
        now[0] += 1000.0  # a pause
        assert evaluation.wall_s == pytest.approx(ends_at)


class Kept(KVWriter):
    """What is dumped, and with which step."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, dict[str, Any]]] = []

    def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
        self.rows.append((step, dict(key_values)))


class Dumps(BaseCallback):
    """Dumps after each rollout, as a run in a folder does after its validations."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.logger.dump(-self.num_timesteps)


@pytest.mark.parametrize("dumped_by_another", [False, True])
def test_an_evaluation_is_dumped_with_its_step_unless_another_has_done_it(
    dumped_by_another: bool,
) -> None:
    model, kept = learner(bare()), Kept()
    model.set_logger(Logger(None, [kept]))
    others = [Dumps()] if dumped_by_another else []
    model.learn(
        3 * N * toy.HORIZON,
        [OriginalGoalEvalCallback(bare(), N, N * toy.HORIZON), *others],
        log_interval=None,
    )
    told = [(step, "time/total_timesteps" in row) for step, row in kept.rows]
    sign = -1 if dumped_by_another else 1
    assert told == [(sign * n * N * toy.HORIZON, not dumped_by_another) for n in (1, 2, 3)]
    assert all("eval/success_rate" in row for _, row in kept.rows)


def test_a_verbose_evaluation_prints_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    for verbose in (0, 1):
        evaluation = OriginalGoalEvalCallback(bare(), N, 40, verbose=verbose)
        learner(bare()).learn(40, callback=evaluation)
        said = capsys.readouterr().out
        assert ("evaluation after 40 steps: success rate 0." in said) == bool(verbose)


def test_learning_anew_does_not_write_over_a_callbacks_file(tmp_path: Path) -> None:
    path = tmp_path / "eval.csv"
    evaluation, model = OriginalGoalEvalCallback(bare(), N, 80, path), learner(bare())
    model.learn(80, callback=evaluation)
    model.learn(80, callback=evaluation, reset_num_timesteps=False)
    written = path.read_bytes()
    with pytest.raises(ValueError, match="`learn` counts anew: pass reset_num_timesteps=False"):
        model.learn(80, callback=evaluation)
    assert path.read_bytes() == written


def test_an_environments_own_curriculum_is_another_thing() -> None:
    class Taught(toy.PointEnv):
        curriculum = "lessons"

    env = DummyVecEnv([Taught] * N)
    OriginalGoalEvalCallback(env, N, 40)
    with pytest.raises(ValueError, match="this one imagines no goals"):
        learner(env).learn(40, callback=CurriculumCallback())
    buffer = FollowObjectReplayBuffer(
        100, env.observation_space, env.action_space, env, n_envs=N, scene_distance=0.1
    )
    assert buffer._is_finished()


def test_a_recurrent_policy_is_refused() -> None:
    tiny = {"net_arch": [8], "lstm_hidden_size": 8}
    model = RecurrentPPO("MultiInputLstmPolicy", bare(), n_steps=8, policy_kwargs=tiny)
    with pytest.raises(ValueError, match="the policy of this RecurrentPPO is recurrent"):
        model.learn(N * 8, callback=OriginalGoalEvalCallback(bare(), N, 8))


def test_another_runs_file_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "eval.csv"
    learner(bare()).learn(80, callback=OriginalGoalEvalCallback(bare(), N, 80, path))
    written = path.read_bytes()
    with pytest.raises(ValueError, match="holds another run's evaluations"):
        learner(bare()).learn(80, callback=OriginalGoalEvalCallback(bare(), N, 80, path))
    assert path.read_bytes() == written
    path.write_text("my notes")
    with pytest.raises(ValueError, match="not a file of evaluations"):
        learner(bare()).learn(80, callback=OriginalGoalEvalCallback(bare(), N, 80, path))
    assert path.read_text() == "my notes"


@pytest.mark.parametrize("options", [{"n_episodes": 0}, {"every_steps": 0}, {"object_steps": -1}])
def test_bad_evaluation_settings_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        OriginalGoalEvalCallback(bare(), **{"n_episodes": 1, "every_steps": 1, **options})


def test_an_evaluation_in_vec_normalize_is_refused() -> None:
    with pytest.raises(ValueError, match="eval_env is in VecNormalize"):
        OriginalGoalEvalCallback(VecNormalize(bare()), 1, 1)


def test_an_evaluation_that_would_show_imagined_goals_is_refused() -> None:
    with pytest.raises(ValueError, match="eval_env imagines goals"):
        OriginalGoalEvalCallback(imagining(toy.curriculum()), 1, 1)
