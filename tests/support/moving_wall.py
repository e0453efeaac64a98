"""The tutorial's arm with a wall that stands elsewhere in each episode, the goal behind it."""

from __future__ import annotations

from typing import Any

import arm_and_wall
import gymnasium as gym
import mujoco
import numpy as np

WALL = "MovingWall-v0"
FIXED = '<geom name="wall" type="box" pos="0.4 0 0.03" size="0.05 0.01 0.03" rgba=".4 .6 .9 1"/>'
MOVED = (
    '<body name="wall" pos="0.4 0 0.03">'
    '<geom type="box" size="0.05 0.01 0.03" rgba=".4 .6 .9 1"/></body>'
    '<body name="paint" pos="0 0 0"><geom type="box" size=".01 .01 .01" contype="0" '
    'conaffinity="0"/></body>'
    '<body name="target" mocap="true"><geom type="sphere" size=".01" pos="0 0 -0.2"/></body>'
)
(SCENE,) = {arm_and_wall.SCENE.replace(FIXED, MOVED)} - {arm_and_wall.SCENE}  # type: ignore[attr-defined]


class MovingWall(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Wall and paint are drawn along x and y, the target stands at the goal."""

    def __init__(self) -> None:
        super().__init__()
        self.model = mujoco.MjModel.from_xml_string(SCENE)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.model.body("wall").pos[:2] = self.np_random.uniform([0.3, -0.02], [0.5, 0.02])
        self.model.body("paint").pos[:2] = self.np_random.uniform(-0.1, 0.1, 2)
        self.data.mocap_pos[0] = self.goal
        return self._observation(), {}  # the places of bodies are stale now, as somebody's may be

    def wall(self) -> np.ndarray:
        """Where it stands, (2,) metres."""
        return self.model.body("wall").pos[:2].copy()


gym.register(WALL, MovingWall, max_episode_steps=50)
