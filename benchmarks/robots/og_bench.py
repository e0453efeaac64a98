"""OGBench's cube with goals anywhere on its table: the id OGBench/cube-single-v0."""

import gymnasium as gym
import numpy as np
import ogbench  # noqa: F401 - registers cube-single-v0

from sb3_follow_object import fingertips
from sb3_follow_object.envs import RobotTask

REACHED = 0.04  # metres, as in its own success
REPEATS = 2  # of an action: the hand moves up to 43 mm in a step, of 100 ms
STEPS = 50  # of an episode


class Slower(gym.Wrapper):
    """Acts less often: a step of its own, of 50 ms, is too short to come anywhere in 50."""

    def step(self, action):
        for _ in range(REPEATS):
            result = self.env.step(action)
        return result


def goal(env, observation):
    return env._data.body("object_0").xpos, env._data.body("object_target_0").xpos


def is_success(achieved, desired):
    return np.linalg.norm(achieved - desired, axis=-1) <= REACHED


def make(**options):
    # In its mode "task" a reset draws one of five tasks, and not from the seed.
    env = gym.make("cube-single-v0", mode="data_collection", terminate_at_goal=False, **options)
    return RobotTask(Slower(env.unwrapped), goal, is_success, effector=fingertips)


gym.register("OGBench/cube-single-v0", make, max_episode_steps=STEPS)
