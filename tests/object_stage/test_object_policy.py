"""When the object's stage ends."""

from __future__ import annotations

import pytest
from tiny_runs import SMALL_NET

from sb3_follow_object.envs import make_vec
from sb3_follow_object.object_stage.policy import train_object_policy

OBJECT = "FollowObject/PnPShelfObject-v0"


def test_its_tests_have_the_rhythm_the_episodes_and_the_success_that_are_asked_for() -> None:
    env, test_env = (make_vec(OBJECT, 2, 1, seed=seed) for seed in (0, 1))
    heard: list[int] = []
    model, solved = train_object_policy(
        env,
        test_env,
        10_000,
        n_test_episodes=4,
        test_every=3,
        success_rate=0.0,
        seed=0,
        report=lambda steps, rate: heard.append(steps),
        **SMALL_NET,
    )
    # Three rollouts of two copies, then four episodes; solved by the second test.
    assert heard == [500, 1000]
    assert solved.solved and solved.test_steps == 400
    assert model.num_timesteps == pytest.approx(1000, abs=2)
