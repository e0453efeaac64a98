"""Pictures of anybody's MuJoCo environment, with points in them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from ..envs.goal_space import followed_space
from ..envs.graphics import open_graphics
from ..envs.physics_engine import mujoco
from ..envs.picture import SIZE, add_point, check_process
from .physics_access import physics_of

START_RGBA, GOAL_RGBA = np.array([[0.1, 0.4, 0.9, 0.6], [0.9, 0.1, 0.1, 0.6]])
_AZIMUTH, _ELEVATION = 132.0, -25.0
_WIDER = 1.6  # the picture's width, in what the points span
_LEAST = 0.6  # metres that it shows
_BALL = 0.006  # a point's radius, in the camera's distance
_MOST_GEOMS = 20_000

Pixels = np.ndarray  # (480, 480, 3) of uint8


class ScenePicture:
    """Draws states of one model off-screen; its graphics are let go by `close`.

    Args:
        model: is drawn whole, what is only seen too.
        points: that the camera looks at, (n, 3) metres.

    Raises:
        RuntimeError: there is no graphics library to draw with.
    """

    def __init__(self, model: mujoco.MjModel, points: np.ndarray) -> None:
        check_process()
        self._context = open_graphics(SIZE)[1]
        self._context.make_current()
        self._model = model
        shown = model.vis.global_
        size = shown.offwidth, shown.offheight
        shown.offwidth = shown.offheight = SIZE
        self._pen = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        shown.offwidth, shown.offheight = size
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._pen)
        self._scene = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
        self._camera = _camera(points)

    def draw(self, data: mujoco.MjData, points: np.ndarray, colours: np.ndarray) -> Pixels:
        """Draw a state with points (n, 3) in metres, each in its colour, (n, 4) in [0, 1]."""
        self._context.make_current()
        scene, everything = self._scene, mujoco.mjtCatBit.mjCAT_ALL
        option = mujoco.MjvOption()
        mujoco.mjv_updateScene(self._model, data, option, None, self._camera, everything, scene)
        for point, rgba in zip(points, colours, strict=True):
            add_point(scene, point, _BALL * self._camera.distance, rgba)
        image = np.empty((SIZE, SIZE, 3), dtype=np.uint8)
        rectangle = mujoco.MjrRect(0, 0, SIZE, SIZE)
        mujoco.mjr_render(rectangle, scene, self._pen)
        mujoco.mjr_readPixels(image, None, rectangle, self._pen)
        return np.ascontiguousarray(image[::-1])

    def close(self) -> None:
        """Free the graphics memory and the context."""
        self._context.make_current()
        self._pen.free()
        self._context.free()


def draw_points(env: gym.Env, points: np.ndarray, colours: np.ndarray) -> Pixels:
    """Draw the state that an environment is in, with points.

    Args:
        env: anybody's, with MuJoCo.
        points: (n, 3) metres, n >= 1; the camera looks at them.
        colours: of each, (n, 4), red, green, blue and opacity in [0, 1].

    Raises:
        RuntimeError: there is no graphics library to draw with.
    """
    model, data = physics_of(env)
    picture = ScenePicture(model, points)
    try:
        return picture.draw(data, points, colours)
    finally:
        picture.close()


class Drawn(gym.Wrapper):
    """An environment that draws nothing itself, drawn with its goal in red."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._picture: ScenePicture | None = None
        self._space = followed_space(env.observation_space["desired_goal"].shape)  # type: ignore[index]
        self._goal = np.zeros(3)

    def reset(self, **options: Any) -> Any:
        """Start an episode."""
        obs, info = self.env.reset(**options)
        keys = ("achieved_goal", "desired_goal")
        seen = self._space.point(np.array([obs[key] for key in keys], dtype=np.float64))
        self._goal = seen[1]
        if self._picture is None:
            self._picture = ScenePicture(physics_of(self.env)[0], seen)
        return obs, info

    def render(self) -> Any:
        """Draw the state."""
        assert self._picture is not None, "reset() comes first"
        return self._picture.draw(physics_of(self.env)[1], self._goal[None], GOAL_RGBA[None])

    def close(self) -> None:
        """Let environment and graphics go."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None
        super().close()


def _camera(points: np.ndarray) -> Any:
    camera = mujoco.MjvCamera()
    low, high = points.min(axis=0), points.max(axis=0)
    camera.lookat[:] = (low + high) / 2
    camera.distance = _WIDER * max(_LEAST, float(np.linalg.norm(high - low)))
    camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION
    return camera
