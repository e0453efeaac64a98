"""The robot's tasks have mirror images: mirrored actions have mirrored outcomes, measured."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sb3_follow_object.common.mirrors import Mirror
from sb3_follow_object.ddpg.folding import Folding
from sb3_follow_object.envs import TASKS, FetchEnv
from sb3_follow_object.envs.physics_engine import mujoco
from sb3_follow_object.envs.symmetry import fetch_mirrors
from sb3_follow_object.settings.presets import run_config

PAIRS = [(name, mirror) for name, task in TASKS.items() for mirror in fetch_mirrors(task)]
N_STEPS = 3


TUBE = np.array([1.3, 0.85, 0.4])  # where one stands, if there is one


def play(
    env: FetchEnv, place: np.ndarray, cube: np.ndarray, tube: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """Observations (N_STEPS, 25) from a gripper and a cube at rest at these places."""
    env.reset(seed=0)
    grip, opened = env.simulation.read["grip_pos"][0], np.array([1.0])
    for _ in range(40):
        env.step(np.append(np.clip((place - grip) / 0.05, -1.0, 1.0), opened).astype(np.float32))
    joint = env.model.joint("object0:joint")
    env.data.qpos[joint.qposadr[0] : joint.qposadr[0] + 7] = *cube, 1.0, 0.0, 0.0, 0.0
    env.data.qvel[joint.dofadr[0] : joint.dofadr[0] + 6] = 0.0
    if env.simulation.scene.task.tube:
        env.data.mocap_pos[env.model.body("tube").mocapid[0]] = tube
    mujoco.mj_forward(env.model, env.data)
    env.simulation.refresh(0)
    return np.stack([env.step(action)[0]["observation"] for action in actions])


@pytest.mark.parametrize(("name", "mirror"), PAIRS, ids=lambda value: getattr(value, "axis", value))
def test_mirrored_actions_have_mirrored_outcomes(name: str, mirror: Mirror) -> None:
    env, rng = FetchEnv(name), np.random.default_rng(0)
    folding = Folding([mirror], 25, 4)
    order, sign, shift, goal_sign, goal_shift, action_sign = map(th.Tensor.numpy, folding._of(0))
    off, moved = [], []
    for trial in range(6):
        cube = np.append(rng.uniform([1.25, 0.62], [1.4, 0.66]), 0.425)
        aside = np.array([-0.07, 0.0, 0.01]) if trial % 2 else np.array([0.0, -0.07, 0.01])
        actions = rng.uniform(-1.0, 1.0, (N_STEPS, 4)).astype(np.float32)
        actions[:, :3] = 0.5 * actions[:, :3] - np.sign(aside) * [1.0, 1.0, 0.0]
        actions = actions.clip(-1.0, 1.0)
        places = np.stack([cube + aside, cube, TUBE])
        here = play(env, *places, actions)
        there = play(env, *(places * goal_sign + goal_shift), actions * action_sign)
        off.append(np.abs(there[:, order] * sign + shift - here)[:, :9])
        moved.append(np.linalg.norm(here[-1, 3:6] - cube))
    assert np.median(moved) > 0.02
    gripper, cubes = np.median(off, axis=0)[:, :3], np.median(off, axis=0)[:, 3:6]
    assert gripper.max() < 0.001 and cubes.max() < 0.003


@pytest.mark.parametrize("method", ["fo", "her", "rher"])
@pytest.mark.parametrize("env_id", ["FetchPush-v4", "FetchPickAndPlace-v4"])
def test_presets_have_the_same_mirrors_for_the_robot_that_names_none(
    env_id: str, method: str
) -> None:
    algorithm = run_config(env_id, method=method).settings["algorithm"]
    own = [mirror.plain() for mirror in FetchEnv("PnPSimpleV1").mirrors]
    assert algorithm["policy_kwargs"]["mirrors"] == own
    pushed = "uniform" if env_id == "FetchPush-v4" else "energy"
    assert algorithm["replay_buffer_kwargs"]["moved_priority"] == pushed
