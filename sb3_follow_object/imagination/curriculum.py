"""The curriculum over imagined goals: which level k an episode plays, and when k_max grows."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..common.numbers import checked_number, checked_whole
from ..settings.stages import CurriculumSettings
from .sequential_test import SequentialTest


class Curriculum:
    """Levels 1..k_max of imagined goals, k_max growing with success (paper, section 4.3).

    Each episode shows its original goal with probability ``p`` and otherwise the imagined goal of
    a level k drawn from U{1..k_max}. A test at level k_max that reaches ``threshold`` raises k_max
    by one, or by up to ``stride``. Once the last level is reached (and passed, with
    ``finish_threshold``) the curriculum is finished and shows original goals only.

    Args:
        horizon: T, steps of an episode, >= 1.
        p: probability of the original goal, in [0, 1].
        threshold: success rate at k_max that raises k_max, in [0, 1].
        sequential: whether the tests of a level add up until they decide (`SequentialTest`), so
            that chance cannot pass it; otherwise each stands alone (paper).
        stride: most levels that a test raises k_max by, >= 1: as many as its success rate holds the
            threshold, so that what is learned at once need not wait for a test of every level.
        finish_threshold: success rate at the last level that ends the curriculum, in [0, 1]; until
            then imagined goals of all levels go on. 0 is the paper's: reaching that level ends it.
        k_max: first value of k_max, in 1..n_levels.
        levels: "time": level k is k time-steps along the path (paper), so there are T levels;
            "path": level k is the share k / n_levels of the path's length.
        n_levels: number of levels with levels="path", >= 1; "time" does not read it.
        sampling: "uniform" (paper) or "max", always k = k_max (the paper's ablation).
        min_distance: metres, >= 0; imagined goals nearer to the start than this are not shown.
        go_on: share in [0, 1] of the episodes of training that show the original goal from where
            they reach their imagined one, so that what is left of them is spent on the way ahead.
            0 is the paper's.

    Raises:
        ValueError: an argument is outside its range.
    """

    stride = 1  # of those pickled before there was one
    go_on = 0.0  # likewise
    first_k_max = 1

    def __init__(
        self,
        horizon: int,
        *,
        p: float = CurriculumSettings.p,
        threshold: float = CurriculumSettings.threshold,
        sequential: bool = CurriculumSettings.sequential,
        stride: int = CurriculumSettings.stride,
        finish_threshold: float = CurriculumSettings.finish_threshold,
        k_max: int = CurriculumSettings.k_max,
        levels: str = CurriculumSettings.levels,
        n_levels: int = CurriculumSettings.n_levels,
        sampling: str = CurriculumSettings.sampling,
        min_distance: float = CurriculumSettings.min_distance,
        go_on: float = CurriculumSettings.go_on,
    ) -> None:
        settings = CurriculumSettings(
            p=p,
            threshold=threshold,
            sequential=sequential,
            stride=stride,
            finish_threshold=finish_threshold,
            k_max=k_max,
            levels=levels,  # type: ignore[arg-type]  # a word is checked there
            n_levels=n_levels,
            sampling=sampling,  # type: ignore[arg-type]
            min_distance=min_distance,
            go_on=go_on,
        )
        self.horizon = checked_whole("horizon", horizon, 1)
        self.levels = settings.levels
        self.n_levels = self.horizon if settings.levels == "time" else settings.n_levels
        self.p = settings.p
        self.threshold = settings.threshold
        self.stride = settings.stride
        self.finish_threshold = settings.finish_threshold
        self.sampling = settings.sampling
        self.min_distance = settings.min_distance
        self.go_on = settings.go_on
        self.k_max = self.first_k_max = checked_whole("k_max", settings.k_max, 1, self.n_levels)
        self._passed_last = False
        self._tests = SequentialTest() if settings.sequential else None

    @property
    def finished(self) -> bool:
        """Whether the last level is passed, so that only original goals are shown."""
        at_last = self.k_max == self.n_levels
        return at_last and (self._passed_last or self.finish_threshold == 0.0)

    def draw(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw the coin and the level of ``n`` new episodes.

        Args:
            n: number of episodes, >= 0.
            rng: source of randomness.

        Returns:
            original (n,) bool, True where the episode shows its original goal; level (n,) int64 in
            1..k_max, meant for the others.
        """
        original = rng.random(n) < self.p
        if self.finished:
            original[:] = True
        if self.sampling == "max":
            return original, np.full(n, self.k_max, dtype=np.int64)
        return original, rng.integers(1, self.k_max, size=n, endpoint=True)

    def draw_going_on(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw which of ``n`` new episodes go on once they reach their imagined goals, (n,) bool.

        Where all do or none does, nothing is drawn.
        """
        if self.go_on in (0.0, 1.0):
            return np.full(n, self.go_on == 1.0)
        return rng.random(n) < self.go_on

    def drawable(self) -> np.ndarray:
        """Return the levels that ``draw`` can give now, shape (m,) int64, ascending."""
        first = self.k_max if self.sampling == "max" else 1
        return np.arange(first, self.k_max + 1)

    def report(self, success_rate: float, n_episodes: int = 1) -> bool:
        """Take in a test at level k_max; return whether k_max grew or the curriculum ended.

        Args:
            success_rate: share of successful test episodes, in [0, 1].
            n_episodes: of the test, >= 1; tests that add up weigh by it.

        Raises:
            ValueError: ``success_rate`` is outside [0, 1], or ``n_episodes`` below 1.
        """
        success_rate = checked_number("success_rate", success_rate, 0.0, 1.0)
        n_episodes = checked_whole("n_episodes", n_episodes, 1)
        if self.finished:
            return False
        at_last = self.k_max == self.n_levels
        threshold = self.finish_threshold if at_last else self.threshold
        if self._tests is None:
            passed = success_rate >= threshold
        else:
            passed = self._tests.passes(success_rate, n_episodes, threshold)
        if not passed:
            return False
        if at_last:
            self._passed_last = True
        else:
            held = int(success_rate / threshold + 1e-9) if threshold > 0.0 else 1
            self.k_max = min(self.n_levels, self.k_max + min(max(1, held), self.stride))
        return True

    def restart(self) -> None:
        """Begin anew at the first value of k_max."""
        self.k_max, self._passed_last = self.first_k_max, False
        if self._tests is not None:
            self._tests = SequentialTest()

    def state_dict(self) -> dict[str, Any]:
        """Return what training has changed, and what it only makes sense with (JSON types)."""
        return {
            "k_max": self.k_max,
            "passed_last": self._passed_last,
            "levels": self.levels,
            "n_levels": self.n_levels,
            **({} if self._tests is None else {"evidence": self._tests.evidence}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state``, made by ``state_dict`` of a curriculum with the same levels.

        Raises:
            ValueError: the state lacks an entry, has other levels, or a k_max outside them.
        """
        missing = {"k_max", "passed_last", "levels", "n_levels"} - set(state)
        if missing:
            raise ValueError(f"The curriculum's state lacks {sorted(missing)}.")
        theirs = (state["levels"], state["n_levels"])
        if theirs != (self.levels, self.n_levels):
            raise ValueError(
                f"The curriculum's state has levels={theirs[0]!r} with {theirs[1]!r} levels, "
                f"but this curriculum has levels={self.levels!r} with {self.n_levels}."
            )
        self.k_max = checked_whole("k_max", state["k_max"], 1, self.n_levels)
        self._passed_last = bool(state["passed_last"])
        if self._tests is not None:
            self._tests.evidence = float(state.get("evidence", 0.0))
