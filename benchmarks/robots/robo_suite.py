"""robosuite's can, to be put into its bin's middle: the id robosuite/PickPlaceCan-v0."""

import gymnasium as gym
import numpy as np
import robosuite
from robosuite import load_composite_controller_config
from robosuite.wrappers import GymWrapper

from sb3_follow_object.envs import RobotTask

REACHED = 0.05  # metres
HEIGHT = 0.06  # metres of the can's middle above the bin's floor
REPEATS = 3  # of an action: the hand moves up to 61 mm in a step, of 150 ms
STEPS = 50  # of an episode
SETTINGS = {
    "has_renderer": False,
    "has_offscreen_renderer": False,
    "use_camera_obs": False,
    "ignore_done": True,
    "hard_reset": False,  # else it builds its model anew in each episode, 0.3 s
}


class Seeded(GymWrapper):
    """Its environment as gymnasium knows one, slower to act; places are drawn from the seed."""

    unwrapped = property(lambda self: self)  # its own is none of gymnasium's environments

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
        return super().reset()

    def step(self, action):
        for _ in range(REPEATS):
            result = super().step(action)
        return result


def goal(env, observation):
    bins = env.env
    can = bins.sim.data.body_xpos[bins.obj_body_id["Can"]]
    x, y, _ = bins.target_bin_placements[bins.object_to_id["can"]]
    return can, np.array([x, y, bins.bin2_pos[2] + HEIGHT])


def is_success(achieved, desired):
    return np.linalg.norm(achieved - desired, axis=-1) <= REACHED


def upright():
    """Its controller of the hand's place, without that of how the hand is turned."""
    config = load_composite_controller_config(robot="Panda")
    arm = config["body_parts"]["right"]
    arm["type"] = "OSC_POSITION"
    for name in ("input_min", "input_max", "output_min", "output_max"):
        arm[name] = arm[name][:3] if isinstance(arm[name], list) else arm[name]
    return config


def make(**options):
    env = robosuite.make("PickPlaceCan", robots="Panda", controller_configs=upright(), **SETTINGS)
    return RobotTask(Seeded(env), goal, is_success)


gym.register("robosuite/PickPlaceCan-v0", make, max_episode_steps=STEPS)
