"""Meta-World's tasks with goals, from its sparse success: ids MetaWorld/push-wall-v0 and so on."""

import gymnasium as gym
import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS

from sb3_follow_object import fingertips
from sb3_follow_object.envs import RobotTask

TASKS = ("push-wall", "pick-place-wall", "shelf-place", "peg-insert-side", "drawer-open")
REACHED, DRAWER_REACHED = 0.07, 0.03  # metres, as Meta-World's own success has it
REPEATS = 3  # of an action: the hand moves up to 30 mm in a step, of 37.5 ms
STEPS = 50  # of an episode


class Seeded(gym.Wrapper):
    """One of its environments, slower to act: places are the seed's, nothing but sparse success."""

    def __init__(self, task):
        env = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
        env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
        env.evaluate_state = lambda observation, action: (0.0, {})  # its shaped reward is slow
        super().__init__(env)

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.unwrapped.seed(seed)
        obs, info = self.env.reset()
        mujoco.mj_forward(self.unwrapped.model, self.unwrapped.data)  # it has moved bodies
        return obs, info

    def step(self, action):
        for _ in range(REPEATS):
            result = self.env.step(action)
        return result


def goal(env, observation):
    return env._get_pos_objects(), env._target_pos


def make(task, **options):
    within = DRAWER_REACHED if task == "drawer-open" else REACHED

    def is_success(achieved, desired):
        return np.linalg.norm(achieved - desired, axis=-1) <= within

    return RobotTask(Seeded(task), goal, is_success, effector=fingertips)


for task in TASKS:
    gym.register(f"MetaWorld/{task}-v0", make, max_episode_steps=STEPS, kwargs={"task": task})
