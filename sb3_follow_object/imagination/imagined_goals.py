"""From a level of the curriculum to an imagined goal."""

from __future__ import annotations

import numpy as np

from ..common.answers import check_shape
from ..envs.goal_space import POSITIONS, GoalSpace
from .curriculum import Curriculum
from .goal_predictor import GoalPredictor


@np.errstate(under="ignore")
def imagine(
    predictor: GoalPredictor,
    curriculum: Curriculum,
    start: np.ndarray,
    goal: np.ndarray,
    level: np.ndarray,
    contexts: np.ndarray | None = None,
) -> np.ndarray:
    """Return the imagined goals h of given levels (paper, section 4.3).

    Args:
        predictor: F_phi.
        curriculum: says whether a level means time-steps or a share of the path's length.
        start: object positions o_1, shape (n, 3), metres.
        goal: original goals g, shape (n, 3), metres.
        level: shape (n,) int, in 1..curriculum.n_levels.
        contexts: where other things stand, shape (n, c); None where F_phi sees none.

    Returns:
        h, shape (n, 3) float64, metres.

    Raises:
        ValueError: a shape or a level is wrong.
    """
    level = np.asarray(level)
    if level.size and not (level.min() >= 1 and level.max() <= curriculum.n_levels):
        raise ValueError(f"Levels must lie in 1..{curriculum.n_levels}, got {level.tolist()}.")
    if curriculum.levels == "time":
        imagined = predictor.predict(start, goal, level, contexts)
    else:
        levels = _all_levels(predictor, curriculum, start, goal, contexts)
        imagined = levels[np.arange(len(level)), level - 1]
    check_shape(imagined, np.shape(start), "the goals that the predictor imagines")
    return imagined


@np.errstate(under="ignore")
def draw_goals(
    predictor: GoalPredictor,
    curriculum: Curriculum,
    start: np.ndarray,
    goal: np.ndarray,
    rng: np.random.Generator,
    contexts: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the goal that each of n new training episodes shows (paper, Algorithm 1).

    With ``curriculum.min_distance`` > 0 a level whose goal lies nearer to the start than that is
    drawn again among those levels up to k_max that lie far enough; an episode that has none shows
    its original goal.

    Args:
        predictor: F_phi.
        curriculum: draws the coin and the level of each episode.
        start: object positions o_1, shape (n, 3), metres.
        goal: original goals g, shape (n, 3), metres.
        rng: source of randomness.
        contexts: as in `imagine`.

    Returns:
        shown goals, shape (n, 3) float64, metres; levels, shape (n,) int64, 0 where original.
    """
    shown = np.array(goal, dtype=np.float64)
    original, level = curriculum.draw(len(shown), rng)
    level[original] = 0
    rows = np.flatnonzero(~original)
    if rows.size:
        seen = None if contexts is None else contexts[rows]
        shown[rows], level[rows] = imagine_afar(
            predictor, curriculum, start[rows], goal[rows], level[rows], rng, seen
        )
    return shown, level


def imagine_afar(
    predictor: GoalPredictor,
    curriculum: Curriculum,
    start: np.ndarray,
    goal: np.ndarray,
    level: np.ndarray,
    rng: np.random.Generator,
    contexts: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the imagined goals of levels that were drawn, those too near to the start drawn again.

    Args:
        predictor: F_phi.
        curriculum: says how near is too near, and which levels may be drawn.
        start: object positions o_1, shape (n, 3), metres.
        goal: original goals g, shape (n, 3), metres.
        level: shape (n,) int, of `curriculum.drawable()`.
        rng: source of randomness.
        contexts: as in `imagine`.

    Returns:
        as `draw_goals`.
    """
    shown, level = imagine(predictor, curriculum, start, goal, level, contexts), level.copy()
    distance = predictor.space.distance
    near = np.flatnonzero(distance(shown, start) < curriculum.min_distance)
    if near.size:
        choices = curriculum.drawable()
        seen = None if contexts is None else contexts[near]
        every = _all_levels(predictor, curriculum, start[near], goal[near], seen)
        ways = every[:, choices - 1]
        far = distance(ways, start[near, None]) >= curriculum.min_distance
        for row, way, mask in zip(near, ways, far, strict=True):
            # One draw among the far levels has the distribution of drawing until a level is far.
            choice = rng.choice(np.flatnonzero(mask)) if mask.any() else None
            level[row] = 0 if choice is None else choices[choice]
            shown[row] = goal[row] if choice is None else way[choice]
    return shown, level


def _all_levels(
    predictor: GoalPredictor,
    curriculum: Curriculum,
    start: np.ndarray,
    goal: np.ndarray,
    contexts: np.ndarray | None,
) -> np.ndarray:
    """Return the imagined goals of every level, shape (n, n_levels, 3)."""
    paths = predictor.paths(start, goal, contexts)
    if curriculum.levels == "time":
        return paths[:, 1:]
    shares = np.arange(1, curriculum.n_levels + 1) / curriculum.n_levels
    return points_along(paths, shares, predictor.space)


def points_along(paths: np.ndarray, shares: np.ndarray, space: GoalSpace = POSITIONS) -> np.ndarray:
    """Interpolate paths at shares of their length.

    Args:
        paths: shape (n, m, 3), m >= 2, metres.
        shares: shape (s,), in [0, 1].
        space: of the paths.

    Returns:
        points, shape (n, s, 3); share 1 is the path's end.
    """
    steps = space.distance(paths[:, 1:], paths[:, :-1])
    travelled = np.concatenate([np.zeros((len(paths), 1)), np.cumsum(steps, axis=1)], axis=1)
    wanted = travelled[:, -1:] * shares  # (n, s)
    # Index of the step in which the wanted length is reached.
    step = np.sum(travelled[:, None, 1:-1] < wanted[:, :, None], axis=2)
    row = np.arange(len(paths))[:, None]
    # A path of length zero stays where it is: nothing to divide.
    length = np.maximum(steps[row, step], np.finfo(np.float64).tiny)
    part = np.clip((wanted - travelled[row, step]) / length, 0.0, 1.0)
    return space.between(paths[row, step], paths[row, step + 1], part)


def ahead(
    predictor: GoalPredictor,
    start: np.ndarray,
    goal: np.ndarray,
    distance: float,
    contexts: np.ndarray | None = None,
) -> np.ndarray:
    """Return the first points of imagined paths that lie so far from their starts.

    Args:
        predictor: F_phi.
        start: object positions o_1, shape (n, 3), metres.
        goal: original goals g, shape (n, 3), metres.
        distance: metres.
        contexts: as in `imagine`.

    Returns:
        points, shape (n, 3), metres; the end of a path that goes nowhere so far.
    """
    paths = predictor.paths(start, goal, contexts)
    far = predictor.space.distance(paths, paths[:, :1]) >= distance
    first = np.where(far.any(axis=1), far.argmax(axis=1), paths.shape[1] - 1)
    points: np.ndarray = paths[np.arange(len(paths)), first]
    return points
