"""Pictures of a simulation: the whole scene with the goal, regions and extra points drawn in."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from .batch import BatchedSimulation
from .scene import OBJECT, Scene, fetch_spec, object_only
from .tasks import SUCCESS_DISTANCE, Region, reference_point

SIZE = 480  # pixels, both ways
_LOOK_AT = (1.3, 0.75, 0.55)
_DISTANCE, _AZIMUTH, _ELEVATION = 1.9, 132.0, -20.0
_GOAL_RGBA = (0.9, 0.1, 0.1, 0.8)
_START_REGION_RGBA = (0.1, 0.4, 0.9, 0.15)
_GOAL_REGION_RGBA = (0.9, 0.2, 0.1, 0.12)
_MARKER_RGBA = (0.1, 0.7, 0.2, 0.6)
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
        self._model: mujoco.MjModel | None = None
        self._data: mujoco.MjData | None = None
        self._renderer: Any = None
        self._window: Any = None

    def set_markers(self, points: np.ndarray) -> None:
        """Points (n, 3) in metres to draw from now on.

        Raises:
            ValueError: the shape is another one.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"Markers must have shape (n, 3), not {points.shape}.")
        self._markers = points.copy()

    def draw(self, simulation: BatchedSimulation, index: int, mode: str) -> np.ndarray | None:
        """One copy as an array (480, 480, 3) of uint8, or in the window with mode "human".

        Raises:
            RuntimeError: there is no graphics library to draw with.
        """
        if self._model is None:
            self._model = self._whole_model()
            self._data = mujoco.MjData(self._model)
        # The physics model lacks what touches nothing, so the state is shown on the whole one.
        source = simulation.data[index]
        self._data.qpos[:] = source.qpos
        self._data.mocap_pos[:] = source.mocap_pos
        self._data.mocap_quat[:] = source.mocap_quat
        mujoco.mj_forward(self._model, self._data)
        goal = simulation.goals[index]
        return self._draw_window(goal) if mode == "human" else self._draw_array(goal)

    def close(self) -> None:
        """Let the graphics go."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        if self._window is not None:
            self._window.close()
            self._window = None

    def _whole_model(self) -> mujoco.MjModel:
        spec = fetch_spec(self._scene.task)
        if self._scene.alone:
            spec = object_only(spec, OBJECT)
        # The goal is drawn by hand; the asset's own mark would stand still.
        spec.delete(next(site for site in spec.sites if site.name == "target0"))
        model = spec.compile()
        model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
        return model

    def _draw_array(self, goal: np.ndarray) -> np.ndarray:
        if self._renderer is None:
            try:
                self._renderer = mujoco.Renderer(self._model, SIZE, SIZE)
            except Exception as error:  # each graphics library fails with an error of its own
                raise RuntimeError(
                    "No OpenGL to draw with: install libegl1 or libosmesa6 and set "
                    f"MUJOCO_GL=egl or MUJOCO_GL=osmesa ({error})."
                ) from error
        camera = mujoco.MjvCamera()
        _point(camera)
        self._renderer.update_scene(self._data, camera)
        self._add_shapes(self._renderer.scene, goal)
        return self._renderer.render()

    def _draw_window(self, goal: np.ndarray) -> None:
        if self._window is None:
            try:
                import mujoco.viewer

                self._window = mujoco.viewer.launch_passive(self._model, self._data)
            except Exception as error:  # no display, or a library of it is missing
                raise RuntimeError(f"No window can be opened here ({error}).") from error
            _point(self._window.cam)
        with self._window.lock():
            self._window.user_scn.ngeom = 0
            self._add_shapes(self._window.user_scn, goal)
        self._window.sync()

    def _add_shapes(self, canvas: Any, goal: np.ndarray) -> None:
        sphere, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX
        task, rest = self._scene.task, self._scene.landmarks.rest_height
        for point in self._markers:
            _add_shape(canvas, sphere, point, np.full(3, 0.4 * SUCCESS_DISTANCE), _MARKER_RGBA)
        _add_shape(canvas, sphere, goal, np.full(3, 0.4 * SUCCESS_DISTANCE), _GOAL_RGBA)
        if self._show_regions:
            low = rest if task.height.chance < 1 else rest + task.height.low
            for region, bottom, top, rgba in (
                (task.start, rest, rest, _START_REGION_RGBA),
                (task.goal, low, rest + task.height.high, _GOAL_REGION_RGBA),
            ):
                _add_shape(canvas, box, *self._extent(region, bottom, top), rgba)

    def _extent(self, region: Region, bottom: float, top: float) -> tuple[np.ndarray, np.ndarray]:
        """Centre and half-size of the box that a region spans between two heights."""
        reference = reference_point(region, self._scene.landmarks)
        low = np.array([*(reference + region.low), bottom])
        high = np.array([*(reference + region.high), top])
        return (low + high) / 2, np.maximum((high - low) / 2, _THIN)


def _point(camera: Any) -> None:
    camera.lookat[:] = _LOOK_AT
    camera.distance, camera.azimuth, camera.elevation = _DISTANCE, _AZIMUTH, _ELEVATION


def _add_shape(
    canvas: Any, kind: Any, centre: np.ndarray, size: np.ndarray, rgba: tuple[float, ...]
) -> None:
    if canvas.ngeom >= canvas.maxgeom:
        return
    shape = canvas.geoms[canvas.ngeom]
    turn = np.eye(3).ravel()
    mujoco.mjv_initGeom(shape, kind, size, centre, turn, np.array(rgba, dtype=np.float32))
    canvas.ngeom += 1
