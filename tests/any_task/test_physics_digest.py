"""The hash of a scene's physics: all that decides how the object moves, and nothing else."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from sb3_follow_object.any_task.resets import Resets
from sb3_follow_object.any_task.scene import physics_digest_of

SCENE = """
<mujoco>
  <option timestep="0.004"/>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .06 0 0  0 .06 0  .06 .06 0  0 0 .03  .06 0 .03"/>
    <hfield name="hills" nrow="2" ncol="2" size="1 1 .1 .1" elevation="0 .5 .2 1"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="ground" type="hfield" hfield="hills" rgba="1 0 0 1"/>
    <body name="ramp" euler="0 10 0"><geom type="box" size=".5 .5 .01"/></body>
    <body name="door" pos="1 0 .5">
      <joint name="hinge" axis="0 0 1" pos=".1 0 0" springref="0" stiffness="1"/>
      <geom name="leaf" type="box" size=".1 .01 .1"/>
    </body>
    <body name="knob" pos="1 0 .8">
      <joint name="turn" axis="0 1 0"/><geom type="sphere" size=".02"/>
    </body>
    <body name="wall" pos="0 .5 .2" euler="0 0 20"><geom type="box" size=".2 .01 .2"/></body>
    <body name="cube" pos="0 0 .3" gravcomp="0.1">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 2e-4 2e-4"/>
      <geom type="mesh" mesh="wedge"/>
    </body>
  </worldbody>
  <contact>
    <exclude body1="cube" body2="knob"/>
    <pair geom1="ground" geom2="leaf" friction="1 1 .005 .0001 .0001"/>
  </contact>
  <equality><joint joint1="hinge" joint2="turn" polycoef="0 1 0 0 0"/></equality>
  <tendon>
    <fixed name="cord" stiffness="1"><joint joint="hinge" coef="1"/></fixed>
  </tendon>
</mujoco>
"""
RED = """
    <texture name="flat" type="2d" builtin="flat" width="8" height="8"/>
    <material name="red" texture="flat" rgba="1 0 0 1"/>
"""
OPTION = '<option timestep="0.004"'


def digest(text: str = SCENE) -> str:
    """The hash of a scene in which only the wall stands elsewhere in each of three episodes."""
    return digest_of(mujoco.MjModel.from_xml_string(text))


def digest_of(model: mujoco.MjModel, again: mujoco.MjModel | None = None) -> str:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    places = np.stack([np.concatenate([data.xpos, data.xquat], axis=1)] * 3)
    places[:, model.body("wall").id, 0] += [0.0, 0.1, 0.2]
    points = np.zeros((3, 3))
    resets = Resets(points, points, np.stack([data.qpos] * 3), np.stack([data.qvel] * 3), places)
    body = int(model.body("cube").id)
    repeated = {} if again is None else {"again": again}
    return physics_digest_of(model, body, np.zeros(3), resets, "drawn", **repeated)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('name="ramp" euler="0 10 0"', 'name="ramp" euler="0 30 0"'),
        ('name="ramp" euler', 'name="ramp" pos="0 0 .01" euler'),
        ('pos=".1 0 0"', 'pos="-.1 0 0"'),
        ('springref="0"', 'springref="0.3"'),
        ('gravcomp="0.1"', 'gravcomp="0.2"'),
        ('<inertial pos="0 0 0"', '<inertial pos="0 .01 0"'),
        ('mass="0.1" diag', 'mass="0.1" quat="1 1 0 0" diag'),
        ("polycoef=", 'solref="0.05 1" polycoef='),
        ('polycoef="0 1', 'polycoef="0 2'),
        ("<equality><joint", '<equality><joint active="false"'),
        ('<exclude body1="cube" body2="knob"/>', '<exclude body1="cube" body2="door"/>'),
        ('friction="1 1 .005', 'friction=".5 .5 .005'),
        ('name="cord" stiffness="1"', 'name="cord" stiffness="2"'),
        (".06 0 .03", ".06 0 .04"),
        ('elevation="0 .5', 'elevation="0 .4'),
        (OPTION, f'{OPTION} cone="elliptic"'),
        (OPTION, f'{OPTION} impratio="5"'),
        (OPTION, f'{OPTION} integrator="implicitfast"'),
        (OPTION, f'{OPTION} density="1.2"'),
        (OPTION, f'{OPTION} viscosity="0.01"'),
        (OPTION, f'{OPTION} wind="1 0 0"'),
        (OPTION, f'{OPTION} gravity="0 0 -1.6"'),
        (OPTION, '<option timestep="0.002"'),
    ],
)
def test_what_moves_an_object_otherwise_is_other_physics(old: str, new: str) -> None:
    assert SCENE.count(old) == 1
    assert digest(SCENE.replace(old, new)) != digest()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('rgba="1 0 0 1"', 'rgba="0 1 0 .5"'),
        ('rgba="1 0 0 1"', 'rgba="1 0 0 1" group="3"'),
        ("<asset>", '<visual><headlight ambient=".9 .9 .9"/></visual><asset>'),
        ('<light pos="0 0 3"/>', '<light pos="0 1 3"/><light pos="2 0 3"/><camera pos="0 0 2"/>'),
        ('<light pos="0 0 3"/>', '<site name="goal" pos=".3 0 .3" rgba="1 0 0 .3"/>'),
        ("<asset>", '<sensor><jointpos joint="hinge"/></sensor><asset>'),
        ('rgba="1 0 0 1"', 'material="red"'),
        ('name="wall" pos="0 .5 .2" euler="0 0 20"', 'name="wall" pos=".2 .5 .2" euler="0 9 20"'),
        ('name="hinge" axis', 'name="hinge" user="7" axis'),
    ],
)
def test_looks_names_and_where_an_episode_has_put_things_are_none(old: str, new: str) -> None:
    assert SCENE.count(old) == 1
    text = SCENE.replace(old, new).replace("<asset>", f"<asset>{RED}")
    assert digest(text) == digest()


def test_numbers_that_no_seed_says_again_are_none() -> None:
    digests = set()
    for mass in (0.1, 0.2):
        model, again = (mujoco.MjModel.from_xml_string(SCENE) for _ in range(2))
        model.body("ramp").mass, again.body("ramp").mass = mass, 0.3
        digests.add(digest_of(model, again))
        model.body("ramp").mass = 0.3
        digests.add(digest_of(model, again))
    assert len(digests) == 2, "one where the mass is known, one where it is not"


def test_processes_agree() -> None:
    code = "import test_physics_digest as t; print(t.digest())"
    said = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert said == {digest()}
