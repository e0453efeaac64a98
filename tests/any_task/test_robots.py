"""The object of every robot in docs/robots.md, thrown alone and in its whole scene.

Meta-World and robosuite want a mujoco each, so no installation holds all: what needs a package that
is not there is skipped. docs/robots.md says how to install each.
"""

from __future__ import annotations

import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from tree import ROOT

from sb3_follow_object.any_task.derived import derived
from sb3_follow_object.any_task.finding import find_object, observe
from sb3_follow_object.any_task.physics_access import physics_of
from sb3_follow_object.envs.registration import import_task
from sb3_follow_object.envs.robot_parts import robot_bodies
from sb3_follow_object.envs.transcription import transcribe

META_WORLD = ["push-wall", "pick-place-wall", "shelf-place", "peg-insert-side", "drawer-open"]
TASKS = [
    *(("metaworld", f"meta_world:MetaWorld/{name}-v0") for name in META_WORLD),
    ("ogbench", "og_bench:OGBench/cube-single-v0"),
    ("robosuite", "robo_suite:robosuite/PickPlaceCan-v0"),
]
TENTH_OF_MM = 1e-4
SECONDS = 0.6
FREE = np.array([0.2, 0.4, 1.0, 1.0, 2.0, 3.0])  # metres and radians a second


@pytest.mark.parametrize(("package", "env_id"), TASKS, ids=[env_id for _, env_id in TASKS])
def test_an_object_thrown_alone_moves_as_in_the_whole_scene(
    package: str, env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(package, reason=f"{package} is installed by itself (docs/robots.md)")
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks" / "robots"), *sys.path])
    env = gym.make(import_task(env_id))
    seen = observe(env)
    wanted = (
        env.get_wrapper_attr("followed_object") if env.has_wrapper_attr("followed_object") else None
    )
    found = find_object(seen, wanted)
    env.reset(seed=1)
    model, data = physics_of(env)
    copied = transcribe(model, data)
    alone = copied.spec.compile()
    state = mujoco.MjData(alone)
    for joint, name in copied.joints.items():
        state.joint(name).qpos = data.joint(joint).qpos
        data.joint(joint).qvel = state.joint(name).qvel = 0.0
    robot = robot_bodies(model)[model.geom_bodyid]
    model.geom_contype[robot] = model.geom_conaffinity[robot] = 0  # the arm is in the way
    joint = int(model.body_jntadr[found.body])
    free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    thrown = FREE if free else np.array([-0.5])
    data.joint(joint).qvel = state.joint(copied.joints[joint]).qvel = thrown
    start, off = data.xpos[found.body].copy(), []
    place = 3 if free else 1
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_step(alone, state)
        here, there = (
            each.qpos[:place] for each in (data.joint(joint), state.joint(copied.joints[joint]))
        )
        off.append(np.linalg.norm(here - there))
    mujoco.mj_kinematics(model, data)
    assert np.linalg.norm(data.xpos[found.body] - start) > 0.02, "it was thrown"
    assert max(off) <= TENTH_OF_MM
    env.close()


@pytest.mark.parametrize(("package", "env_id"), TASKS, ids=[env_id for _, env_id in TASKS])
def test_nothing_of_it_is_refused(
    package: str, env_id: str, few_resets: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(package, reason=f"{package} is installed by itself (docs/robots.md)")
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks" / "robots"), *sys.path])
    found = derived(env_id)
    assert len(found.resets) == 60 and found.robot
