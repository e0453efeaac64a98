"""Curriculum-guided hindsight replay: which relabelled transitions to learn from (Fang, 2019)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..settings.learning import CherSettings

# The weight of proximity grows with every batch; beyond this, diversity has long stopped counting.
_MAX_GROWTH = 1e9
_BLOCK = 1 << 21  # distances held at once


class GoalSelection:
    """Chooses diverse goals first and goals near to what was achieved later.

    From the candidates of a batch a subset A is picked greedily for

        sum over candidates i of max over j in A of s_ij, minus weight x sum over A of |g_j - a_j|

    where g are the goals as relabelled, a the goals achieved when the transition began, and s_ij is
    exp(-d_ij^2 / mean(d)^2) if g_j is the nearest other goal of g_i, d_ij metres away, and 0 else.
    Each pick looks at a few random candidates only.

    Args:
        candidates: drawn for each transition that is chosen, >= 1.
        picks: random candidates that each pick looks at, >= 1.
        weight: of proximity in the first batch, >= 0.
        growth: factor on the weight from batch to batch, >= 1.

    Attributes:
        n_batches: chosen so far.

    Raises:
        ValueError: an argument is outside its range.
    """

    def __init__(
        self,
        candidates: int = CherSettings.candidates,
        picks: int = CherSettings.picks,
        weight: float = CherSettings.weight,
        growth: float = CherSettings.growth,
    ) -> None:
        settings = CherSettings(candidates=candidates, picks=picks, weight=weight, growth=growth)
        self.candidates = settings.candidates
        self.picks = settings.picks
        self.weight = settings.weight
        self.growth = settings.growth
        self.n_batches = 0

    def proximity_weights(self, n_batches: int) -> np.ndarray:
        """Weights of proximity in the next batches (n_batches,)."""
        batch = np.arange(self.n_batches, self.n_batches + n_batches, dtype=np.float64)
        with np.errstate(over="ignore", under="ignore"):
            return self.weight * np.minimum(self.growth**batch, _MAX_GROWTH)

    def choose(
        self,
        goals: np.ndarray,
        achieved: np.ndarray,
        n_batches: int,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Choose the same share of the candidates of each batch.

        Args:
            goals: as relabelled, (n_batches * m, d); one batch's m candidates after another.
            achieved: when the transitions began, of the same shape.
            n_batches: batches, each chosen from its own candidates alone.
            rng: source of randomness.

        Returns:
            Indices of the chosen, batch after batch, in the order of the picks.
        """
        n_candidates = len(goals) // n_batches
        per_batch = goals.reshape(n_batches, n_candidates, -1).astype(np.float64)
        distance = np.linalg.norm(goals - achieved, axis=1).reshape(n_batches, n_candidates)
        weights = self.proximity_weights(n_batches)
        self.n_batches += n_batches
        score = coverage(per_batch) - weights[:, None] * distance
        chosen = _pick(score, n_candidates // self.candidates, self.picks, rng)
        return (chosen + n_candidates * np.arange(n_batches)[:, None]).ravel()

    def state_dict(self) -> dict[str, Any]:
        """Return what the next choice depends on beside the candidates."""
        return {"n_batches": self.n_batches}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.n_batches = int(state["n_batches"])


def coverage(goals: np.ndarray) -> np.ndarray:
    """What picking each goal adds to the facility-location sum (b, m), for goals (b, m, d).

    Each goal has one edge only, to its nearest other one, so what a pick covers no other pick can:
    the gain is the same whatever was picked before.
    """
    n_batches, n, _ = goals.shape
    gain = np.zeros((n_batches, n))
    if n < 2:
        return gain
    for row, batch in zip(gain, goals, strict=True):
        nearest, distance = _nearest_other(batch - batch.mean(axis=0))
        mean = distance.mean()
        similarity = np.exp(-((distance / mean) ** 2)) if mean > 0.0 else np.ones(n)
        row += np.bincount(nearest, weights=similarity, minlength=n)
    return gain


def _nearest_other(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of and distance to the nearest other point, (n,) each, of points (n, d)."""
    n = len(points)
    square = np.einsum("ij,ij->i", points, points)
    nearest = np.empty(n, dtype=np.int64)
    size = max(1, _BLOCK // n)
    for first in range(0, n, size):
        rows = np.arange(first, min(first + size, n))
        # |a - b|^2 without |a|^2, which is the same for all b
        gap = square - 2.0 * (points[rows] @ points.T)
        gap[rows - first, rows] = np.inf
        nearest[rows] = gap.argmin(axis=1)
    return nearest, np.linalg.norm(points - points[nearest], axis=1)


def _pick(score: np.ndarray, n: int, picks: int, rng: np.random.Generator) -> np.ndarray:
    """Pick n columns of each row (b, n): each time the best of some random ones that are left."""
    n_rows, left = score.shape
    order = np.tile(np.arange(left), (n_rows, 1))  # what is left, then what was picked
    row = np.arange(n_rows)
    for _ in range(n):
        looked_at = min(picks, left)
        # The first steps of a shuffle: the columns looked at change places with the last ones left.
        for last in range(left - 1, left - 1 - looked_at, -1):
            place = rng.integers(last + 1, size=n_rows)
            order[row, place], order[:, last] = order[:, last].copy(), order[row, place]
        seen = order[:, left - looked_at : left]
        best = left - looked_at + np.argmax(score[row[:, None], seen], axis=1)
        order[row, best], order[:, left - 1] = order[:, left - 1].copy(), order[row, best]
        left -= 1
    return order[:, left:][:, ::-1]
