"""Planes over which the robot's tasks are symmetric."""

from __future__ import annotations

from dataclasses import replace

from ..common.mirrors import Mirror
from .tasks import COMMON, Box, Task

# The robot's observation and action (`FetchSimulation`), mirrored in x and in y. The fingers lie
# beside each other along y. The table's middle is the arm's to 6 mm, so all but the outermost of
# what it can do has a mirror image: tests measure it.
_FETCH = (
    Mirror(0, COMMON.table[0], (0, 3), (6, 12, 13, 14, 18, 19, 20), (), (0,)),
    Mirror(1, COMMON.table[1], (1, 4), (7, 11, 13, 15, 17, 19, 21), ((9, 10), (23, 24)), (1,)),
)


def fetch_mirrors(task: Task) -> tuple[Mirror, ...]:
    """Return the planes through the table's middle over which a task's obstacles are symmetric."""
    return tuple(
        mirror
        for mirror in _FETCH
        if all(_symmetric(boxes, mirror.axis) for boxes in (task.obstacles, task.tube))
    )


def _symmetric(boxes: tuple[Box, ...], axis: int) -> bool:
    def placed(box: Box, sign: float) -> Box:
        x, y, z = (
            round(sign * value if i == axis else value, 6) + 0.0  # no -0.0
            for i, value in enumerate(box.centre)
        )
        return replace(box, centre=(x, y, z))

    return {placed(box, -1.0) for box in boxes} == {placed(box, 1.0) for box in boxes}
