"""Statistics over seeds and tasks, with bootstrap intervals (Agarwal et al. 2021, by rliable).

Scores are success rates in [0, 1], shape (seeds, tasks). Intervals are of 95%, from bootstrap
samples that are stratified over tasks and the same whenever they are drawn, whichever other methods
there are. One seed has an interval of width 0, which says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..common.extras import need

_SAMPLES = 2000
_SEED = 0

Key = TypeVar("Key", bound=Hashable)


class Estimate(NamedTuple):
    """A figure and the interval in which it lies."""

    value: float
    low: float
    high: float


def quartiles(values: np.ndarray) -> tuple[float, float, float]:
    """Return the 25%, 50% and 75% quantiles of values (n,), n >= 1."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


def interquartile_means(scores: Mapping[Key, np.ndarray]) -> dict[Key, Estimate]:
    """Return the mean of the middle half of all runs, by any key.

    Raises:
        MissingExtra: rliable is not installed.
    """
    bands = _bands(scores, _middle_half)
    return {key: Estimate(*map(float, band[:, 0])) for key, band in bands.items()}


def probabilities_of_improvement(
    scores: Mapping[str, np.ndarray], over: str
) -> dict[str, Estimate]:
    """Return the probability that a run of each other method beats one of `over` on a task.

    It is the mean over tasks; runs that are as good count half.

    Raises:
        MissingExtra: rliable is not installed.
    """
    pairs = {name: [own, scores[over]] for name, own in scores.items() if name != over}
    bands = _bands(pairs, _share_of_better)
    return {name: Estimate(*map(float, band[:, 0])) for name, band in bands.items()}


def performance_profiles(
    scores: Mapping[str, np.ndarray], thresholds: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the share of runs whose success is above each of the thresholds (n,).

    Returns:
        By method the shares and the ends of their intervals, shape (3, n).

    Raises:
        MissingExtra: rliable is not installed.
    """
    return _bands(scores, lambda x: np.mean(x[..., None] > thresholds, axis=(0, 1)))


def sample_efficiency(scores: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the interquartile mean at each of n times.

    Args:
        scores: by method, shape (seeds, tasks, n).

    Returns:
        By method the means and the ends of their intervals, shape (3, n).

    Raises:
        MissingExtra: rliable is not installed.
    """
    return _bands(scores, _middle_half)


def _middle_half(scores: np.ndarray) -> np.ndarray:
    """Return interquartile means of scores (seeds, tasks, ...), one for each of what is left.

    rliable's own has one for all; called for each point of a curve it took minutes a figure.
    """
    stats = need("scipy.stats", "plots")
    return np.asarray(stats.trim_mean(scores.reshape(-1, *scores.shape[2:]), 0.25, axis=0))


def _share_of_better(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the share of pairs of runs (seeds, tasks) of a task that ours wins, ties half.

    The figure of rliable's probability_of_improvement, which makes a rank test for each task.
    """
    ours, theirs = ours[:, None], theirs[None]
    return float(np.mean((ours > theirs) + 0.5 * (ours == theirs)))


def _bands(scores: Mapping[Key, Any], figure: Callable[..., Any]) -> dict[Key, np.ndarray]:
    """Return by key what `figure` makes of the scores and the ends of its interval, (3, n)."""
    library = need("rliable.library", "plots")

    def figures(*given: np.ndarray) -> np.ndarray:
        return np.atleast_1d(figure(*given))

    bands: dict[Key, np.ndarray] = {}
    earlier = np.random.get_state()  # rliable draws from NumPy's global stream
    try:
        for key, given in scores.items():
            arrays = given if isinstance(given, list) else [given]
            at = figures(*arrays)
            ends: Any = [at, at]
            if max(map(len, arrays)) > 1:
                np.random.seed(_SEED)  # anew for each, or its interval would hang on the others'
                _, found = library.get_interval_estimates({key: given}, figures, reps=_SAMPLES)
                ends = found[key]
            bands[key] = np.vstack([at, ends])
    finally:
        np.random.set_state(earlier)
    return bands
