"""The paper's tasks, one row each (section 5.1), and the gymnasium ids that they have.

A task has a pair of ids: `FollowObject/<Task>-v0` of the robot, `FollowObject/<Task>Object-v0` of
its object alone.
"""

from __future__ import annotations

from ..common.suggestions import did_you_mean
from .tasks import Box, Height, Region, Task


def _wall(x: float, y: float, half_x: float) -> Box:
    """A low wall of the pushing tasks: 0.1 m high, 0.025 m thick, standing on the table."""
    return Box((x, y, 0.25), (half_x, 0.0125, 0.05))


_AROUND_GRIPPER = Region("gripper", (-0.15, -0.15), (0.15, 0.15))
_WHOLE_TABLE = Region("table", (-0.225, -0.325), (0.225, 0.325))
_NEAR_SIDE = Region("gripper", (-0.15, -0.15), (0.15, 0.05))
_BEFORE_BOTH_WALLS = Region("gripper", (-0.15, -0.25), (0.15, -0.15))
_FAR_SIDE = Region("gripper", (-0.15, 0.125), (0.15, 0.25))
_ON_TABLE_OR_ABOVE = Height(0.0, 0.45, chance=0.5)
_SIDE_GAP_WALL = _wall(0.0, 0.075, 0.175)

_ROWS = (
    Task("PnPSimpleV1", _AROUND_GRIPPER, _AROUND_GRIPPER, _ON_TABLE_OR_ABOVE),
    Task("PnPSimpleV2", _WHOLE_TABLE, _WHOLE_TABLE, Height(0.05, 0.45)),
    Task(
        "PushSideGap",
        _NEAR_SIDE,
        _FAR_SIDE,
        obstacles=(_SIDE_GAP_WALL,),
        blocked_gripper=True,
    ),
    Task(
        "PushMiddleGap",
        _NEAR_SIDE,
        _FAR_SIDE,
        obstacles=(_wall(-0.14375, 0.075, 0.10625), _wall(0.14375, 0.075, 0.10625)),
        blocked_gripper=True,
    ),
    Task(
        "PushDoubleObstacles",
        _BEFORE_BOTH_WALLS,
        _FAR_SIDE,
        horizon=80,
        obstacles=(
            _SIDE_GAP_WALL,
            _wall(-0.14375, -0.125, 0.10625),
            _wall(0.14375, -0.125, 0.10625),
        ),
        blocked_gripper=True,
    ),
    Task(
        "PnPObstacle",
        _NEAR_SIDE,
        _FAR_SIDE,
        _ON_TABLE_OR_ABOVE,
        obstacles=(Box((0.0, 0.075, 0.30), (0.25, 0.0125, 0.10), friction=(1.0, 1.0, 1.0)),),
    ),
    Task(
        "PnPShelf",
        _NEAR_SIDE,
        _FAR_SIDE,
        Height(0.20, 0.20),
        obstacles=(Box((0.0, 0.2125, 0.30), (0.25, 0.1375, 0.10), condim=3),),
    ),
    Task(
        "PnPInsertion",
        _AROUND_GRIPPER,
        _AROUND_GRIPPER,
        tube=(
            Box((0.05125, 0.0, 0.05), (0.02375, 0.075, 0.05)),
            Box((-0.05125, 0.0, 0.05), (0.02375, 0.075, 0.05)),
            Box((0.0, 0.05125, 0.05), (0.0275, 0.02375, 0.05)),
            Box((0.0, -0.05125, 0.05), (0.0275, 0.02375, 0.05)),
        ),
        min_goal_distance=0.15,
    ),
)

TASKS: dict[str, Task] = {}

IDS: dict[str, tuple[Task, bool]] = {}  # the task, and whether its object is alone


def add_task(task: Task) -> str:
    """Put a row into the tables and return the id of the robot's environment.

    Raises:
        ValueError: another task has the name or one of its ids.
    """
    ids = {f"FollowObject/{task.name}{kind}-v0": (task, bool(kind)) for kind in ("", "Object")}
    for env_id, row in ids.items():
        if IDS.get(env_id, row) != row:
            raise ValueError(f"{env_id!r} is another task's already; find a new name.")
    TASKS[task.name] = task
    IDS.update(ids)
    return next(iter(ids))


for _row in _ROWS:
    add_task(_row)
BUILT_IN = frozenset(IDS)  # what is added later is not among them


def find_task(task: str | Task) -> Task:
    """The row of this name; a row is handed through.

    Raises:
        ValueError: no task has this name.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise ValueError(f"Unknown task {task!r}{did_you_mean(task, TASKS)}.")
    return TASKS[task]


def lookup(env_id: str) -> tuple[Task, bool]:
    """The task of one of our ids, and whether it is the one of the object alone.

    Raises:
        ValueError: it is not one of ours.
    """
    if env_id not in IDS:
        raise ValueError(f"Unknown environment id {env_id!r}{did_you_mean(env_id, IDS)}.")
    return IDS[env_id]


def task_of(env_id: str | Task, *, alone: bool) -> Task:
    """The task of an id of the robot's or, with `alone`, of the object's; a row is handed through.

    Raises:
        ValueError: the id is unknown or of the other kind.
    """
    if isinstance(env_id, Task):
        return env_id
    task, is_alone = lookup(env_id)
    if is_alone != alone:
        wanted = next(other for other, row in IDS.items() if row == (task, alone))
        raise ValueError(f"{env_id!r} does not fit here; {wanted!r} does.")
    return task


def object_id(env_id: str) -> str:
    """The id of the object alone in a task of ours, given the robot's or its own.

    Raises:
        ValueError: it is not one of ours.
    """
    task, _ = lookup(env_id)
    return f"FollowObject/{task.name}Object-v0"
