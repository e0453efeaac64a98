"""A picture of anybody's MuJoCo environment with points in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from .graphics import open_graphics
from .physics_engine import mujoco
from .picture import SIZE, add_point, check_process

START_RGBA, GOAL_RGBA = (0.1, 0.4, 0.9, 0.6), (0.9, 0.1, 0.1, 0.6)
_AZIMUTH, _ELEVATION = 132.0, -25.0
_WIDER = 1.6  # the picture's width, in what the points and the object span
_LEAST = 0.6  # metres that it shows


def draw_points(
    model: mujoco.MjModel, data: mujoco.MjData, starts: np.ndarray, goals: np.ndarray
) -> np.ndarray:
    """Draw a simulation's state with starts in blue and goals in red.

    Args:
        model: is drawn whole, what is only seen too.
        data: its state.
        starts: (n, 3) metres.
        goals: (m, 3) metres.

    Returns:
        (480, 480, 3) of uint8.

    Raises:
        RuntimeError: there is no graphics library to draw with.
    """
    check_process()
    context = open_graphics(SIZE)[1]
    context.make_current()
    size = model.vis.global_.offwidth, model.vis.global_.offheight
    model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
    pen = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, pen)
        scene = mujoco.MjvScene(model, maxgeom=model.ngeom + len(starts) + len(goals) + 2000)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        camera = _camera(np.concatenate([starts, goals]))
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
        radius = 0.006 * camera.distance
        for points, rgba in ((starts, START_RGBA), (goals, GOAL_RGBA)):
            for point in points:
                add_point(scene, point, radius, rgba)
        image = np.empty((SIZE, SIZE, 3), dtype=np.uint8)
        rectangle = mujoco.MjrRect(0, 0, SIZE, SIZE)
        mujoco.mjr_render(rectangle, scene, pen)
        mujoco.mjr_readPixels(image, None, rectangle, pen)
        return np.ascontiguousarray(image[::-1])
    finally:
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        pen.free()
        context.free()


def _camera(points: np.ndarray) -> Any:
    camera = mujoco.MjvCamera()
    low, high = points.min(axis=0), points.max(axis=0)
    camera.lookat[:] = (low + high) / 2
    camera.distance = _WIDER * max(_LEAST, float(np.linalg.norm(high - low)))
    camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION
    return camera
