"""The tasks, one row of data each (section 4 of the paper, Experiments). All lengths in metres."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

SUCCESS_DISTANCE = 0.05
# An object this near to the start region's reference point, seen from above, is drawn again.
MIN_START_DISTANCE = 0.10
# Draws of a start or a goal before a task is said to have none.
_MAX_DRAWS = 10_000


@dataclass(frozen=True)
class Box:
    """An obstacle: centre relative to the body that carries it, half-size, and its contact.

    Raises:
        ValueError: half-sizes are not positive.
    """

    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]
    friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)
    condim: int = 6

    def __post_init__(self) -> None:
        if not all(half > 0.0 for half in self.half_size):
            raise ValueError(f"A box's half-sizes must be positive metres, not {self.half_size}.")


@dataclass(frozen=True)
class Region:
    """A rectangle over the table, given as (x, y) offsets from a reference point.

    Raises:
        ValueError: an unknown reference, bounds that are not pairs, or a lower above an upper one.
    """

    reference: Literal["gripper", "table"]
    low: tuple[float, float]
    high: tuple[float, float]

    def __post_init__(self) -> None:
        if self.reference not in ("gripper", "table"):
            raise ValueError(
                f"A region's reference is 'gripper' or 'table', not {self.reference!r}."
            )
        if not len(self.low) == len(self.high) == 2:
            raise ValueError(f"A region's bounds are (x, y) each, not {self.low} and {self.high}.")
        if not all(low <= high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"A region from {self.low} to {self.high} is empty.")


@dataclass(frozen=True)
class Height:
    """How far a goal lies above a resting object: U(low, high) with this chance, else 0.

    Raises:
        ValueError: not 0 <= low <= high in metres, or a chance outside [0, 1].
    """

    low: float = 0.0
    high: float = 0.0
    chance: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.low <= self.high < np.inf:
            raise ValueError(f"A height needs 0 <= low <= high, not {self.low} and {self.high}.")
        if not 0.0 <= self.chance <= 1.0:
            raise ValueError(f"A height's chance lies in [0, 1], not at {self.chance}.")


@dataclass(frozen=True)
class Landmarks:
    """Points that the samplers refer to, read from the simulation.

    Args:
        gripper: where the grip site stands after set-up, (3,).
        table: the table's centre, (3,).
        rest_height: z of the object's centre when it rests on the table.
    """

    gripper: tuple[float, float, float]
    table: tuple[float, float, float]
    rest_height: float


@dataclass(frozen=True)
class Task:
    """One task as data: obstacles, where object and goal are drawn, and the horizon T.

    Args:
        name: the key in `TASKS` and the middle part of the gymnasium ids.
        start: region of the object's start.
        goal: region of the goal.
        height: law of the goal's height.
        horizon: T, env steps in an episode.
        obstacles: boxes fixed to the table, centres relative to the table's centre.
        tube: boxes of a tube that stands at the goal, relative to the goal's foot on the table.
        blocked_gripper: the fingers stay closed (the pushing tasks).
        min_goal_distance: a goal nearer than this to the object, seen from above, is drawn again.

    Raises:
        ValueError: the name is not made of letters and digits, the horizon is below 1, or
            there are lists in place of tuples.
    """

    name: str
    start: Region
    goal: Region
    height: Height = Height()
    horizon: int = 50
    obstacles: tuple[Box, ...] = ()
    tube: tuple[Box, ...] = ()
    blocked_gripper: bool = False
    min_goal_distance: float = 0.0

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*", self.name):
            raise ValueError(f"A task's name is made of letters and digits, not {self.name!r}.")
        if type(self.horizon) is not int or self.horizon < 1:
            raise ValueError(
                f"The horizon of {self.name} is {self.horizon!r}; it must be a whole number >= 1."
            )
        try:
            hash(self)  # scenes are kept by their tasks
        except TypeError as error:
            raise ValueError(f"{self.name}: give tuples where there are lists.") from error

    def sample(
        self, rng: np.random.Generator, landmarks: Landmarks
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw an episode: the object's start (2,) and the goal (3,), in metres.

        Raises:
            ValueError: the regions are so near to what starts or goals must keep away from that
                none is found.
        """
        reference = reference_point(self.start, landmarks)

        def draw(region: Region, away_from: np.ndarray, distance: float) -> np.ndarray:
            for _ in range(_MAX_DRAWS):
                point = reference_point(region, landmarks) + rng.uniform(region.low, region.high)
                if not np.hypot(*(point - away_from)) < distance:
                    return point
            raise ValueError(
                f"{self.name}: no point of {region} lies {distance} m from {away_from.round(3)}."
            )

        start = draw(self.start, reference, MIN_START_DISTANCE)
        goal = draw(self.goal, start, self.min_goal_distance)
        z = landmarks.rest_height
        if rng.random() < self.height.chance:
            z += rng.uniform(self.height.low, self.height.high)
        return start, np.array([goal[0], goal[1], z])


def reference_point(region: Region, landmarks: Landmarks) -> np.ndarray:
    """The (x, y) that a region's offsets start from, shape (2,)."""
    point = landmarks.gripper if region.reference == "gripper" else landmarks.table
    return np.array(point[:2])


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

TASKS: dict[str, Task] = {row.name: row for row in _ROWS}


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


def did_you_mean(word: str, known: object) -> str:
    """The end of a sentence about an unknown name: the nearest known one, else all of them."""
    names = [str(name) for name in known]  # type: ignore[attr-defined]
    near = difflib.get_close_matches(str(word), names, n=1, cutoff=0.4)
    return f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(names)}"
