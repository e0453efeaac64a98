"""Pictures of a simulation: the whole scene with the goal, regions and extra points drawn in."""

from __future__ import annotations

import os
import threading
from importlib import import_module
from typing import Any

import numpy as np

from .batch import BatchedSimulation
from .graphics import check_windows, open_graphics
from .physics_engine import mujoco
from .scene import OBJECT, OBSTACLE, PULLER, TUBE, Scene, delete, fetch_spec
from .tasks import SUCCESS_DISTANCE, Region, reference_point

SIZE = 480  # pixels, both ways
# From before the table, the robot behind it: starts lie on the left of most tasks and goals on the
# right, and the arm comes from behind, so that it hides little of the way between them.
_LOOK_AT = (1.3, 0.75, 0.54)
_DISTANCE, _AZIMUTH, _ELEVATION = 1.4, 183.0, -32.0
_BACKGROUND = ((0.98, 0.98, 0.99), (0.85, 0.88, 0.93))  # the sky's two colours
_OBSTACLE_ALPHA = 0.5  # what is in or behind them is seen through them
_ROBOT = "robot0:"  # what its bodies are called
_ROBOT_ALPHA = 0.3  # while markers are shown, which may stand behind it
_OBJECT_RGBA = (0.95, 0.65, 0.1, 1.0)
_GOAL_RGBA = (0.9, 0.1, 0.1, 0.8)
_START_REGION_RGBA = (0.1, 0.4, 0.9, 0.15)
_GOAL_REGION_RGBA = (0.9, 0.2, 0.1, 0.12)
# Markers from the first to the last, as the levels 1 .. T of imagined goals.
_MARKER_RGB = np.array([(0.27, 0.0, 0.33), (0.13, 0.57, 0.55), (0.99, 0.85, 0.15)])
_RADIUS = 0.4 * SUCCESS_DISTANCE
_MARKER_RADIUS = 0.25 * SUCCESS_DISTANCE
_THIN = 0.002  # half the least thickness of a drawn region, metres


class Picture:
    """Draws copies of one scene; needs a graphics library only once it draws.

    Args:
        scene: whose copies are drawn.
        show_regions: draw where start and goal come from, as transparent boxes.
    """

    def __init__(self, scene: Scene, show_regions: bool) -> None:
        self._scene = scene
        self._show_regions = show_regions
        self._markers = np.zeros((0, 3))
        self._canvas: _Canvas | None = None
        self._window: _Window | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Graphics are of one process and one object: a copy opens its own once it draws.
        return {**vars(self), "_canvas": None, "_window": None}

    def set_markers(self, points: np.ndarray) -> None:
        """Points (n, 3) in metres to draw from now on, coloured from first to last.

        The robot is transparent where there are any.

        Raises:
            ValueError: the shape is another one.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"Markers must have shape (n, 3), not {points.shape}.")
        self._markers = points.copy()

    def draw(self, simulation: BatchedSimulation, index: int) -> np.ndarray:
        """One copy as an array (480, 480, 3) of uint8.

        Raises:
            RuntimeError: there is no graphics library to draw with, or the process was forked off
                one that draws.
        """
        check_process()
        if self._canvas is None:
            self._canvas = _Canvas(whole_model(self._scene))
        self._canvas.show(simulation, index, see_through=len(self._markers) > 0)
        self._add_shapes(self._canvas.scene, simulation.goals[index])
        return self._canvas.pixels()

    def draw_window(self, simulation: BatchedSimulation, index: int) -> None:
        """One copy in a window, opened the first time.

        Raises:
            RuntimeError: no window can be opened, or as for `draw`.
        """
        check_process()
        if self._window is None:
            self._window = _Window(whole_model(self._scene))
        with self._window.viewer.lock():
            _copy_state(simulation, index, self._window.model, self._window.data)
            self._window.viewer.user_scn.ngeom = 0
            self._add_shapes(self._window.viewer.user_scn, simulation.goals[index])
        self._window.viewer.sync()

    @property
    def window_closed(self) -> bool:
        """Whether the window was opened and somebody closed it."""
        return self._window is not None and not self._window.viewer.is_running()

    def close(self) -> None:
        """Let the graphics go."""
        if _drawn_by not in (None, os.getpid()):
            return  # they are a parent process's, which frees them
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None
        if self._window is not None:
            self._window.close()
            self._window = None

    def _add_shapes(self, scene: Any, goal: np.ndarray) -> None:
        sphere, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX
        colours = marker_colours(len(self._markers))
        for point, rgb in zip(self._markers, colours, strict=True):
            _add_shape(scene, sphere, point, np.full(3, _MARKER_RADIUS), (*rgb, 1.0))
        _add_shape(scene, sphere, goal, np.full(3, _RADIUS), _GOAL_RGBA)
        if self._show_regions:
            task, rest = self._scene.task, self._scene.landmarks.rest_height
            low = rest if task.height.chance < 1 else rest + task.height.low
            for region, bottom, top, rgba in (
                (task.start, rest, rest, _START_REGION_RGBA),
                (task.goal, low, rest + task.height.high, _GOAL_REGION_RGBA),
            ):
                _add_shape(scene, box, *self._extent(region, bottom, top), rgba)

    def _extent(self, region: Region, bottom: float, top: float) -> tuple[np.ndarray, np.ndarray]:
        """Centre and half-size of the box that a region spans between two heights."""
        reference = reference_point(region, self._scene.landmarks)
        low = np.array([*(reference + region.low), bottom])
        high = np.array([*(reference + region.high), top])
        return (low + high) / 2, np.maximum((high - low) / 2, _THIN)


def marker_colours(n: int) -> np.ndarray:
    """Colours (n, 3) in [0, 1] of n markers: dark violet first, yellow last."""
    share = np.linspace(0.0, 1.0, n)
    stops = np.linspace(0.0, 1.0, len(_MARKER_RGB))
    return np.stack([np.interp(share, stops, part) for part in _MARKER_RGB.T], axis=-1)


_drawn_by: int | None = None  # the first process that drew, among this one and its parents


def check_process() -> None:
    """Refuse to draw where a parent did: the threads that its graphics wait for are not here."""
    global _drawn_by
    if _drawn_by is None:
        _drawn_by = os.getpid()
    elif _drawn_by != os.getpid():
        raise RuntimeError(
            "This process was forked off one that draws and cannot draw itself; start it by spawn "
            "or forkserver."
        )


class _Canvas:
    """Off-screen drawing of one model."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._context = open_graphics(SIZE)[1]
        self._context.make_current()
        model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
        self._model = model
        self._data = mujoco.MjData(model)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._rectangle = mujoco.MjrRect(0, 0, SIZE, SIZE)
        self._pen = _pen(model)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._pen)
        self.scene = mujoco.MjvScene(model, maxgeom=2000)
        bodies = [model.body(body).name for body in model.geom_bodyid]
        self._of_robot = np.array([name.startswith(_ROBOT) for name in bodies])
        _point(self._camera)

    def show(self, simulation: BatchedSimulation, index: int, see_through: bool) -> None:
        """Put the state of a copy into the drawn scene, with `see_through` a transparent robot."""
        _copy_state(simulation, index, self._model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._camera, everything, self.scene
        )
        for geom in self.scene.geoms[: self.scene.ngeom] if see_through else ():
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and self._of_robot[geom.objid]:
                geom.rgba[3] = _ROBOT_ALPHA

    def pixels(self) -> np.ndarray:
        """The drawn scene, row 0 at the top."""
        self._context.make_current()
        image = np.empty((SIZE, SIZE, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rectangle, self.scene, self._pen)
        mujoco.mjr_readPixels(image, None, self._rectangle, self._pen)
        return np.ascontiguousarray(image[::-1])

    def close(self) -> None:
        """Free the graphics memory and the context."""
        self._context.make_current()
        self._pen.free()
        self._context.free()


class _Window:
    """A window on one model."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        check_windows()
        running = set(threading.enumerate())
        try:
            # Its panels would cover two thirds of the window; Tab and Shift-Tab bring them back.
            self.viewer = import_module("mujoco.viewer").launch_passive(
                model, self.data, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # mujoco's errors share no class
            raise RuntimeError(f"No window can be opened here ({error}).") from error
        self._threads = set(threading.enumerate()) - running
        _point(self.viewer.cam)

    def close(self) -> None:
        """Close the window and wait: a program that ends meanwhile would crash."""
        self.viewer.close()
        for thread in self._threads:
            thread.join(timeout=5.0)


def whole_model(scene: Scene) -> mujoco.MjModel:
    """A scene with everything that can be seen; its joints and mocap bodies are the physics'."""
    spec = fetch_spec(scene.task)
    # The goal and what pulls the gripper are marks; the goal's is drawn where the goal is.
    delete(spec, (site for site in spec.sites if site.name == "target0"))
    delete(spec, next(b for b in spec.worldbody.bodies if b.name == "robot0:mocap").geoms)
    (cube,) = (geom for geom in spec.geoms if geom.name == OBJECT)
    cube.material, cube.rgba = "", _OBJECT_RGBA
    for geom in spec.geoms:
        if geom.name.startswith((OBSTACLE, TUBE)):
            geom.rgba[3] = _OBSTACLE_ALPHA
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.rgb1, texture.rgb2 = _BACKGROUND
    if scene.alone:
        for group in (spec.keys, spec.sensors, spec.actuators, spec.tendons, spec.equalities):
            delete(spec, group)
        delete(spec, spec.excludes)
        delete(spec, (body for body in spec.worldbody.bodies if body.name.startswith(_ROBOT)))
        spec.worldbody.add_body(name=PULLER, mocap=True)
    return spec.compile()


def _copy_state(
    simulation: BatchedSimulation, index: int, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    source = simulation.data[index]
    data.qpos[:] = source.qpos
    data.mocap_pos[:] = source.mocap_pos
    data.mocap_quat[:] = source.mocap_quat
    mujoco.mj_forward(model, data)


def _pen(model: mujoco.MjModel) -> mujoco.MjrContext:
    try:
        return mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except mujoco.FatalError as error:  # no RuntimeError, though it is one
        raise RuntimeError(f"The scene cannot be drawn here ({error}).") from error


def _point(camera: Any) -> None:
    camera.lookat[:] = _LOOK_AT
    camera.distance, camera.azimuth, camera.elevation = _DISTANCE, _AZIMUTH, _ELEVATION


def add_point(scene: Any, point: np.ndarray, radius: float, rgba: tuple[float, ...]) -> None:
    """Put a ball into a scene that is being drawn; lengths in metres."""
    _add_shape(scene, mujoco.mjtGeom.mjGEOM_SPHERE, point, np.full(3, radius), rgba)


def _add_shape(
    scene: Any, kind: Any, centre: np.ndarray, size: np.ndarray, rgba: tuple[float, ...]
) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    turn, colour = np.eye(3).ravel(), np.array(rgba, dtype=np.float32)
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, size, centre, turn, colour)
    scene.ngeom += 1
