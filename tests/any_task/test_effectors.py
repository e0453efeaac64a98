"""The middle of a robot's fingertips is read from any simulation."""

from __future__ import annotations

from typing import Any

import arm_and_wall
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scenes import fingers

from sb3_follow_object import fingertips
from sb3_follow_object.any_task.registering import registered
from sb3_follow_object.envs.robot_copies import robot_maker


class Hand(gym.Env):
    """Something that holds a simulation."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)


def test_the_middle_of_two_fingers_goes_where_the_hand_goes() -> None:
    hand = Hand(fingers()[0])
    for place in ([0.0, 0.0], [0.1, -0.2]):
        hand.data.qpos[:2] = place
        mujoco.mj_forward(hand.model, hand.data)
        # Two flat fingers about the grip, whose longest sides end 10 mm in front of it.
        ahead = hand.data.site("grip").xpos + np.array([0.01, 0.0, 0.0])
        np.testing.assert_allclose(fingertips(hand), ahead, atol=1e-9)


def test_another_model_in_the_same_environment_is_read_anew() -> None:
    hand = Hand(fingers()[0])
    fingertips(hand)
    arm = gym.make(arm_and_wall.ARM)
    arm.reset(seed=0)
    hand.model, hand.data = arm.unwrapped.model, arm.unwrapped.data  # type: ignore[attr-defined]
    np.testing.assert_allclose(fingertips(hand), hand.data.site("tip").xpos, atol=0.003)
    arm.close()


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        (gym.Env(), "holds no MuJoCo simulation"),
        (Hand(mujoco.MjModel.from_xml_string("<mujoco/>")), "no actuator drives anything in it"),
    ],
)
def test_what_has_no_robot_is_refused(env: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        fingertips(env)


def test_copies_tell_it_at_the_observations_end() -> None:
    env = robot_maker(registered(arm_and_wall.ARM, effector=fingertips))()
    obs, _ = env.reset(seed=0)
    for action in (np.ones(3), -np.ones(3)):
        # The arm tells its own as MuJoCo had it before the last of its steps.
        np.testing.assert_allclose(obs["observation"][21:], obs["observation"][:3], atol=0.006)
        obs = env.step(action)[0]
    env.close()
