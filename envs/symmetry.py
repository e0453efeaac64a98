"""Planes over which the robot's tasks are symmetric."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.mirrors import Mirror
from .tasks import COMMON, TABLE_HALF_SIZE, Box, Region, Task, reference_point

# The robot's observation and action (`FetchSimulation`), mirrored in x and in y. The fingers lie
# beside each other along y. What the arm can do has a mirror image over any plane near the table's
# middle, all but the outermost of it: tests measure it.
_FETCH = (
    Mirror(0, COMMON.table[0], (0, 3), (6, 12, 13, 14, 18, 19, 20), (), (0,)),
    Mirror(1, COMMON.table[1], (1, 4), (7, 11, 13, 15, 17, 19, 21), ((9, 10), (23, 24)), (1,)),
)
_SAME_PLACE = 1e-6  # metres
_SAME_MIDDLE = 0.01  # metres between the middles of starts and of goals


def fetch_mirrors(task: Task) -> tuple[Mirror, ...]:
    """Return the planes over which a task's episodes are symmetric.

    Where there are obstacles it is the table's middle over which they must be, and leave a way past
    them: a wall across the whole table singles out no plane. Where there are none it is the middle
    of starts and goals, which must be the same.
    """
    planes = _about_obstacles(task) if task.obstacles else _about_goals(task)
    return tuple(mirror for mirror in planes if _symmetric(task.tube, mirror.axis))


def _about_obstacles(task: Task) -> list[Mirror]:
    return [
        mirror
        for mirror in _FETCH
        if _symmetric(task.obstacles, mirror.axis) and _leave_a_way(task.obstacles, mirror.axis)
    ]


def _leave_a_way(boxes: tuple[Box, ...], axis: int) -> bool:
    """Whether some box, with those that it is in line with along an axis, is no wall across it."""
    lines: dict[tuple[float, ...], list[tuple[float, float]]] = {}
    for box in boxes:
        others = [i for i in range(3) if i != axis]
        line = tuple(round(of[i], 6) for of in (box.centre, box.half_size) for i in others)
        middle, half = box.centre[axis], box.half_size[axis]
        lines.setdefault(line, []).append((middle - half, middle + half))
    return any(not _cover(spans, TABLE_HALF_SIZE[axis]) for spans in lines.values())


def _cover(spans: list[tuple[float, float]], half: float) -> bool:
    """Whether spans leave nothing of what lies within half a size of the middle."""
    end = -half
    for low, high in sorted(spans):
        if low > end + _SAME_PLACE:
            return False
        end = max(end, high)
    return end >= half - _SAME_PLACE


def _about_goals(task: Task) -> list[Mirror]:
    start, goal = _middle(task.start), _middle(task.goal)
    return [
        replace(mirror, at=round(float(goal[mirror.axis]), 4))
        for mirror in _FETCH
        if abs(start[mirror.axis] - goal[mirror.axis]) < _SAME_MIDDLE
    ]


def _middle(region: Region) -> np.ndarray:
    middle: np.ndarray = reference_point(region, COMMON) + np.add(region.low, region.high) / 2
    return middle


def _symmetric(boxes: tuple[Box, ...], axis: int) -> bool:
    def placed(box: Box, sign: float) -> Box:
        x, y, z = (
            round(sign * value if i == axis else value, 6) + 0.0  # no -0.0
            for i, value in enumerate(box.centre)
        )
        return replace(box, centre=(x, y, z))

    return {placed(box, -1.0) for box in boxes} == {placed(box, 1.0) for box in boxes}
