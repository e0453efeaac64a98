"""What a task is: obstacles, and where object and goal are drawn. All lengths in metres."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..common.numbers import checked_whole

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


# What all tasks' scenes share once they are set up, in metres; a test measures it, to 1 mm, there.
COMMON = Landmarks(gripper=(1.3419, 0.7491, 0.5347), table=(1.3, 0.75, 0.2), rest_height=0.4249)
TABLE_HALF_SIZE = (0.25, 0.35)
SHOULDER = (0.7245, 0.7441, 0.7273)
REACH = 1.13  # from the shoulder to between the fingers, the arm straight


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
        ValueError: the name is not made of letters and digits, the horizon is below 1, there are
            lists in place of tuples, goals lie out of the robot's reach, or an object would start
            beside the table or in an obstacle.
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
        horizon = checked_whole(f"the horizon of {self.name}", self.horizon, 1)
        object.__setattr__(self, "horizon", horizon)
        try:
            hash(self)  # scenes are kept by their tasks
        except TypeError as error:
            raise ValueError(f"{self.name}: give tuples where there are lists.") from error
        self._check_goals()
        self._check_starts()

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

    def _check_goals(self) -> None:
        reference = reference_point(self.goal, COMMON)
        low = np.array([*(reference + self.goal.low), COMMON.rest_height])
        high = np.array([*(reference + self.goal.high), COMMON.rest_height + self.height.high])
        farthest = np.linalg.norm(np.maximum(np.abs(low - SHOULDER), np.abs(high - SHOULDER)))
        if farthest > REACH:
            raise ValueError(
                f"{self.name}: its goals lie up to {farthest:.2f} m from the robot's shoulder, but "
                f"its arm reaches {REACH} m."
            )

    def _check_starts(self) -> None:
        offset = reference_point(self.start, COMMON) - COMMON.table[:2]
        low, high = offset + self.start.low, offset + self.start.high  # from the table's centre
        beyond = np.maximum(-low, high) - TABLE_HALF_SIZE
        if beyond.max() > 0:
            raise ValueError(
                f"{self.name}: its object would start up to {beyond.max():.2f} m beside the table, "
                f"which ends {TABLE_HALF_SIZE[0]} m in x and {TABLE_HALF_SIZE[1]} m in y from its "
                "centre."
            )
        z = COMMON.rest_height - COMMON.table[2]
        for box in self.obstacles:
            centre, half = np.array(box.centre), np.array(box.half_size)
            apart = (high <= centre[:2] - half[:2]) | (low >= centre[:2] + half[:2])
            if not apart.any() and abs(z - centre[2]) < half[2]:
                raise ValueError(
                    f"{self.name}: its object would start inside the obstacle at {box.centre}."
                )


def reference_point(region: Region, landmarks: Landmarks) -> np.ndarray:
    """The (x, y) that a region's offsets start from, shape (2,)."""
    point = landmarks.gripper if region.reference == "gripper" else landmarks.table
    return np.array(point[:2])
