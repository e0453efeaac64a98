"""Reaching first in the robot's stage: it changes what is trained, and nothing where it is off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_runs as runs
import torch as th
from stable_baselines3.common.vec_env import unwrap_vec_wrapper
from tiny import TASK, cache_predictor
from tiny_runs import bare_run

from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.reach.vec_env import ReachFirstVecEnv
from sb3_follow_object.runs import evaluation
from sb3_follow_object.runs.checkpoints import checkpoint_files
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.settings.stages import BEHIND

REACH: dict[str, Any] = {"n_updates": 3, "batch_size": 16, "share": 0.7}
PICK = "FollowObject/PnPSimpleV1-v0"


@pytest.fixture(scope="module")
def predictor(tmp_path_factory: pytest.TempPathFactory) -> GoalPredictor:
    cache = tmp_path_factory.mktemp("cache")
    cache_predictor(cache)
    (file,) = cache.glob(f"{TASK}/*")
    return GoalPredictor.load(file, env_id=TASK)


def robot(predictor: GoalPredictor | None, **settings: Any) -> FollowObject:
    tiny = {**runs.TINY, "reach": REACH, **settings}
    return bare_run(TASK, imagine=predictor is not None, predictor=predictor, **tiny)


def outcome(run: FollowObject) -> dict[str, Any]:
    assert run.model is not None and run.model.replay_buffer is not None
    buffer = run.model.replay_buffer
    callback = run.reach_callback
    reach = None
    if callback is not None:
        assert callback.policy is not None
        reach = [weights(callback.policy.policy), callback.success, callback.own_success]
    return {
        "weights": weights(run.model.policy),
        "actions": buffer.actions[: buffer.pos].copy(),
        "env_steps": run.env_steps,
        "k_max": run.curriculum.k_max,
        "reach": reach,
    }


def weights(policy: th.nn.Module) -> np.ndarray:
    return th.cat([p.detach().ravel() for p in policy.parameters()]).numpy().copy()


def wrapper_of(run: FollowObject) -> ReachFirstVecEnv | None:
    return unwrap_vec_wrapper(run.env, ReachFirstVecEnv)  # type: ignore[return-value]


@pytest.mark.parametrize("imagine", [False, True])
def test_resumed_equals_uninterrupted(
    predictor: GoalPredictor, imagine: bool, tmp_path: Path
) -> None:
    given = predictor if imagine else None
    whole, part = robot(given), robot(given)
    whole.learn(900)
    part.learn(500)
    part.save(tmp_path / "run")
    part.close()
    resumed = FollowObject.load(tmp_path / "run")
    resumed.learn(900)
    np.testing.assert_equal(outcome(resumed), outcome(whole))
    reaching = wrapper_of(whole)
    assert reaching is not None and reaching.approach.began.any()


def test_one_seed_one_result_and_threads_change_nothing(predictor: GoalPredictor) -> None:
    first, second, other = (
        outcome(robot(predictor, seed=seed, n_threads=threads).learn(600))
        for seed, threads in ((0, 1), (0, 2), (1, 1))
    )
    np.testing.assert_equal(first, second)
    assert not np.array_equal(first["reach"][0], other["reach"][0])


def test_without_it_nothing_is_wrapped_and_none_is_as_nothing(predictor: GoalPredictor) -> None:
    plain = bare_run(TASK, predictor=predictor, **runs.TINY).learn(600)
    off, never = robot(predictor, reach=None).learn(600), robot(predictor, reach={"share": 0.0})
    assert plain.settings == off.settings and "reach" not in off.settings
    assert wrapper_of(plain) is None and plain.reach_callback is None
    assert "reach" not in plain.state_dict(replay_buffer=False)
    np.testing.assert_equal(outcome(off), outcome(plain))
    np.testing.assert_array_equal(outcome(never.learn(600))["actions"].shape, (300, 2, 4))


def test_tests_of_h_max_know_nothing_of_it(predictor: GoalPredictor) -> None:
    run = robot(predictor).learn(900)
    assert run.test_steps > 0 and run.curriculum_callback is not None
    assert unwrap_vec_wrapper(run.curriculum_callback.test_env, ReachFirstVecEnv) is None


def test_run_folder_stopped_in_the_robots_stage_resumes_exactly(tmp_path: Path) -> None:
    config = runs.config(settings={"reach": REACH}, eval_every=10**6, total_timesteps=2800)
    runs.run(tmp_path / "whole", config=config)

    def interrupt(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 2400:
            raise KeyboardInterrupt

    folder = tmp_path / "part"
    with pytest.raises(KeyboardInterrupt):
        train(config, folder, report=runs.quiet, progress=interrupt)
    assert checkpoint_files(folder)
    train(config, folder, report=runs.quiet, resume=True)
    assert runs.outcome(folder) == runs.outcome(tmp_path / "whole")


def test_environments_that_cannot_tell_their_state_resume_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "_COPIES", 1)  # each takes as long as two rollouts to make
    tiny = {**runs.TINY, "imagine": False, "reach": REACH}
    short = {"total_timesteps": 400, "eval_every": 10**6, "n_final_episodes": 1}
    config = replace(runs.config(env_id="FetchPush-v4", **short), settings=tiny)
    runs.run(tmp_path / "whole", config=config)

    def interrupt(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "part", report=runs.quiet, progress=interrupt)
    train(config, tmp_path / "part", report=runs.quiet, resume=True)
    assert runs.outcome(tmp_path / "part") == runs.outcome(tmp_path / "whole")


@pytest.mark.parametrize(
    ("env_id", "on_table", "reach", "metres"),
    [
        (TASK, None, {}, BEHIND),
        (TASK, False, {}, BEHIND),
        (PICK, None, {}, 0.0),
        (PICK, True, {}, BEHIND),
        (PICK, True, {"standoff": 0.0}, 0.0),
        (TASK, None, {"standoff": 0.1}, 0.1),
    ],
)
def test_standoff_is_the_tasks_unless_it_is_given(
    env_id: str, on_table: bool | None, reach: dict[str, Any], metres: float
) -> None:
    tiny = {**runs.TINY, "imagine": False, "object_on_table": on_table, "reach": reach}
    run = bare_run(env_id, **tiny)
    run.prepare()
    reaching = wrapper_of(run)
    assert reaching is not None and reaching.reach_settings().standoff == metres
    run.close()


@pytest.mark.parametrize(
    ("reach", "sentence"),
    [
        (3, "reach must be a mapping, not 3"),
        ({"shares": 1}, "reach has no setting 'shares'; did you mean 'share'"),
        ({"share": 2}, r"share is 2; it must lie in \[0, 1\]"),
        ({"standoff": "behind"}, 'standoff must be "auto" or a number of at least 0'),
    ],
)
def test_bad_settings_are_one_sentence(reach: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        bare_run(TASK, reach=reach)


def test_an_effector_that_is_not_there_is_refused_before_the_object_learns() -> None:
    told: list[str] = []
    run = bare_run(TASK, **{**runs.TINY, "reach": {"effector": [90, 91, 92]}})
    run.object_stage.report = told.append
    with pytest.raises(ValueError, match=r"effector is \[90, 91, 92\].*must hold the effector's"):
        run.learn(2000)
    assert not told and run.object_steps == 0
