"""An object whose F_phi is too rough learns on, once, and resumes exactly from either part."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kept_states import keeping
from tiny_runs import TASK, TINY, bare_run

from sb3_follow_object.object_stage.stage import ObjectStage

SETTINGS: dict[str, Any] = {
    **TINY,
    "object_n_envs": 2,
    "object_test_every": 1,
    "object_test_episodes": 2,
    "object_success": 0.0,  # any two tests solve it
}
# Env steps: two rollouts of two copies, a test of two episodes after each, and where it stops.
SOLVED = 2 * (100 + 100) + 2
PATHS = 8 * 50


def stage(error: float, said: list[str] | None = None, **settings: Any) -> ObjectStage:
    report = None if said is None else said.append
    run = bare_run(TASK, report=report, object_error=error, **{**SETTINGS, **settings})
    return run.object_stage


def test_smooth_paths_end_the_stage() -> None:
    plain, judged = stage(0.0), stage(10.0)
    before, after = (each.learn_predictor() for each in (plain, judged))
    assert plain.steps == judged.steps == SOLVED + PATHS
    assert plain.policy_steps == SOLVED
    assert judged.policy_steps == SOLVED + PATHS, "the paths decided when it ended"
    np.testing.assert_array_equal(before.error_mm, after.error_mm)


def test_rough_paths_let_it_learn_as_long_again_and_it_resumes_exactly() -> None:
    said: list[str] = []
    states: list[dict[str, Any]] = []
    whole = stage(1e-6, said)
    predictor = whole.learn_predictor(keeping(states))
    assert sum("the object learns on, for 804 steps in all" in sentence for sentence in said) == 1
    assert (whole.policy_steps, whole.steps) == (2 * SOLVED + PATHS, 2 * SOLVED + 2 * PATHS)
    assert any("until" in state.get("notes", {}) for state in states)
    for state in (states[0], states[-1]):
        again = stage(1e-6)
        resumed = again.learn_predictor(state=state)
        assert again.steps == whole.steps
        np.testing.assert_array_equal(resumed.error_mm, predictor.error_mm)
    # Stopped between the first part's end and the second's beginning.
    states = []
    stage(0.0).learn_policy(keeping(states))
    again = stage(1e-6).learn_predictor(state=states[-1])
    np.testing.assert_array_equal(again.error_mm, predictor.error_mm)


def test_unsolved_objects_do_not_learn_on() -> None:
    short = stage(1e-6, object_success=1.0, object_timesteps=400)
    short.learn_predictor()
    assert short.steps == 400 + PATHS


def test_what_sldr_reads_is_of_the_policy_that_learned_on() -> None:
    shared, own = stage(1e-6), stage(1e-6)
    shared.learn_predictor(networks=True)
    own.learn_policy(networks=True)
    assert own.policy_steps == shared.policy_steps
    assert shared.networks is not None and own.networks is not None
    ours, theirs = (each.state_dict().values() for each in (own.networks, shared.networks))
    assert all((a == b).all() for a, b in zip(ours, theirs, strict=True))


def test_an_error_below_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="object_error is -1"):
        stage(-1.0)
