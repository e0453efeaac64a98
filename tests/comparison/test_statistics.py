"""Statistics over seeds and tasks: right, repeatable, and as rliable's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rliable import metrics

from sb3_follow_object.comparison.statistics import (
    interquartile_means,
    performance_profiles,
    probabilities_of_improvement,
    sample_efficiency,
)


def test_interquartile_mean_leaves_the_outer_quarters_out() -> None:
    state = np.random.get_state()[1]
    scores = np.array([[0.0], [0.4], [0.6], [1.0]])
    mean, low, high = interquartile_means({"fo": scores})["fo"]
    assert mean == pytest.approx(0.5)
    assert 0.0 <= low < mean < high <= 1.0
    assert interquartile_means({"fo": scores})["fo"] == (mean, low, high), "not repeatable"
    np.testing.assert_array_equal(np.random.get_state()[1], state)


def test_bootstrap_is_stratified() -> None:
    # Within a task the seeds agree, so only a bootstrap that mixed the tasks would vary.
    scores = np.array([[0.1, 0.2, 0.8, 0.9]] * 3)
    assert interquartile_means({"fo": scores})["fo"] == pytest.approx((0.5, 0.5, 0.5))


def test_one_seed_has_an_interval_of_no_width() -> None:
    scores = {"fo": np.array([[0.2, 0.6]]), "her": np.array([[0.0, 0.0], [0.1, 0.3]])}
    means = interquartile_means(scores)
    assert means["fo"] == pytest.approx((0.4, 0.4, 0.4))
    assert means["her"].low < means["her"].high


def test_aggregates_are_those_of_rliable() -> None:
    random = np.random.default_rng(0)
    scores = {name: random.integers(0, 5, (n, 3)) / 4 for name, n in (("fo", 5), ("her", 3))}
    means = interquartile_means(scores)
    for name, of_runs in scores.items():
        assert means[name].value == pytest.approx(metrics.aggregate_iqm(of_runs))
    (better,) = probabilities_of_improvement(scores, "her").values()
    theirs = metrics.probability_of_improvement(scores["fo"], scores["her"])
    assert better.value == pytest.approx(theirs)


def test_profile_is_the_share_of_runs_above() -> None:
    profile = performance_profiles({"fo": np.array([[0.5, 1.0]])}, np.array([0.0, 0.5, 0.9, 1.0]))
    np.testing.assert_allclose(profile["fo"], [[1.0, 0.5, 0.5, 0.0]] * 3)


def test_sample_efficiency_is_a_mean_at_each_time() -> None:
    scores = np.array([[[0.0, 0.2, 0.4]], [[0.0, 0.4, 1.0]]])  # two seeds of one task
    middle, low, high = sample_efficiency({"fo": scores})["fo"]
    np.testing.assert_allclose(middle, [0.0, 0.3, 0.7])
    assert (low <= middle).all() and (high >= middle).all()


@pytest.mark.parametrize(
    "bands",
    [
        interquartile_means,
        lambda scores: performance_profiles(scores, np.linspace(0.0, 1.0, 5)),
        sample_efficiency,
        lambda scores: probabilities_of_improvement({**scores, "base": np.eye(5)}, "base"),
    ],
)
def test_interval_does_not_hang_on_which_other_methods_there_are(bands: Any) -> None:
    random = np.random.default_rng(1)
    scores = {name: random.random((5, 5)) for name in ("fo", "her", "rnd")}
    alone = bands({"rnd": scores["rnd"]})["rnd"]
    assert np.max(np.asarray(alone)[2] - np.asarray(alone)[1]) > 0.0
    np.testing.assert_array_equal(bands(scores)["rnd"], alone)
