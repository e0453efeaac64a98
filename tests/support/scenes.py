"""Small compiled scenes of every kind that a transcription meets, and how to throw things there."""

from __future__ import annotations

import mujoco
import numpy as np

# An arm and a table on one root, a box, a drawer with a handle and a rope's worth of odd settings.
KITCHEN = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" cone="elliptic" impratio="3"/>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .06 0 0  0 .06 0  .06 .06 0  0 0 .03  .06 0 .03"/>
  </asset>
  <worldbody>
    <geom type="plane" size="2 2 .1" friction="0.9"/>
    <body name="bench" pos="0.5 0 0.1" euler="0 0 0.3">
      <geom name="top" type="box" size="0.3 0.3 0.1" solref="0.01 1"/>
      <body name="arm" pos="-0.25 0 0.1">
        <joint name="turn" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0.4 0.1 0 0.4" size="0.02"/>
        <site name="tip" pos="0.1 0 0.4"/>
      </body>
      <body name="cabinet" pos="0.1 0.15 0.15">
        <geom type="box" size="0.08 0.05 0.05" contype="0" conaffinity="0"/>
        <body name="drawer" pos="0 -0.06 0">
          <joint name="rail" type="slide" axis="0 -1 0" range="0 0.1" damping="2" stiffness="1"
                 frictionloss="0.1" springref="0.02"/>
          <geom type="box" size="0.05 0.02 0.02" mass="0.2"/>
          <body name="handle" pos="0 -0.03 0"><geom type="sphere" size="0.01" mass="0.01"/></body>
        </body>
      </body>
    </body>
    <body name="shelf" pos="0.55 -0.15 0.23"><geom type="box" size="0.03 0.05 0.03"/></body>
    <body name="mug" pos="0.45 0.05 0.25" quat="0.9 0.1 0.2 0.3">
      <freejoint/>
      <geom type="mesh" mesh="wedge" mass="0.3" priority="1" friction="0.5 0.01 0.001"/>
      <body name="grip" pos="0 0.03 0.01"><geom type="sphere" size="0.02" mass="0.05"/></body>
    </body>
    <body name="empty root" pos="0.3 -0.1 0.3">
      <freejoint/>
      <body name="load" pos="0.01 0 0"><geom type="box" size="0.02 0.03 0.02" mass="0.1"/></body>
    </body>
    <body name="puller" mocap="true" pos="0 0 1"/>
  </worldbody>
  <contact><exclude body1="mug" body2="drawer"/></contact>
  <actuator><position joint="turn"/></actuator>
</mujoco>
"""

# A hand with two fingers below it over a box on a table; where the fingers meet there is a site.
FINGERS = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <body name="hand" pos="0 0 0.2">
      <joint name="x" type="slide" axis="1 0 0" damping="5"/>
      <joint name="z" type="slide" axis="0 0 1" damping="5"/>
      <geom type="sphere" size="0.02" mass="0.1" contype="0" conaffinity="0"/>
      <site name="grip" pos="0 0 -0.06"/>
      <body name="left" pos="0 0.02 -0.06">
        <joint name="l" type="slide" axis="0 1 0" range="0 0.02" damping="5"/>
        <geom type="box" size="0.01 0.004 0.01" mass="0.02"/>
      </body>
      <body name="right" pos="0 -0.02 -0.06">
        <joint name="r" type="slide" axis="0 -1 0" range="0 0.02" damping="5"/>
        <geom type="box" size="0.01 0.004 0.01" mass="0.02"/>
      </body>
    </body>
    <body name="box" pos="0.1 0 0.02"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  </worldbody>
  <actuator>
    <position joint="x" kp="50"/><position joint="z" kp="50"/>
    <position joint="l" kp="50"/><position joint="r" kp="50"/>
  </actuator>
</mujoco>
"""


def kitchen() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The scene, its kinematics run."""
    model = mujoco.MjModel.from_xml_string(KITCHEN)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def fingers() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The hand over the box, its kinematics run."""
    model = mujoco.MjModel.from_xml_string(FINGERS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def throw(
    model: mujoco.MjModel, data: mujoco.MjData, joint: str, velocity: np.ndarray, seconds: float
) -> np.ndarray:
    """Give a joint a velocity and return the positions of its body, (steps, 3) metres."""
    body = int(model.jnt_bodyid[model.joint(joint).id])
    data.joint(joint).qvel = velocity
    path = []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        path.append(data.xpos[body].copy())
    return np.array(path)
