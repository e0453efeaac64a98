"""Which level an episode plays, when k_max grows, and what is refused of either."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import toy

from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.imagined_goals import draw_goals, imagine, points_along

RNG = np.random.default_rng


def test_defaults_are_the_papers() -> None:
    curriculum = Curriculum(50)
    assert (curriculum.k_max, curriculum.p, curriculum.threshold) == (2, 0.2, 0.25)
    assert curriculum.n_levels == 50
    assert curriculum.sampling == "uniform"


def test_original_goals_have_probability_p() -> None:
    original, _ = Curriculum(50, p=0.2).draw(20_000, RNG(0))
    assert abs(original.mean() - 0.2) < 0.01  # 3.5 standard deviations


@pytest.mark.parametrize("k_max", [1, 2, 7])
def test_levels_are_uniform_up_to_k_max(k_max: int) -> None:
    _, level = Curriculum(50, k_max=k_max).draw(20_000, RNG(0))
    shares = np.bincount(level, minlength=k_max + 1) / len(level)
    assert len(shares) == k_max + 1
    np.testing.assert_allclose(shares[1:], 1 / k_max, atol=0.015)
    assert shares[0] == 0


def test_sampling_max_always_plays_k_max() -> None:
    _, level = Curriculum(50, k_max=7, sampling="max").draw(100, RNG(0))
    assert set(level) == {7}


def test_k_max_grows_by_one_when_the_threshold_is_reached_and_stops_at_the_last_level() -> None:
    curriculum = Curriculum(4, threshold=0.25)
    assert not curriculum.report(0.24)
    assert curriculum.k_max == 2
    assert curriculum.report(0.25)
    assert curriculum.report(1.0)
    assert curriculum.k_max == 4 and curriculum.finished
    assert not curriculum.report(1.0)
    assert curriculum.k_max == 4


@pytest.mark.parametrize(
    ("stride", "success_rate", "k_max"),
    [(1, 1.0, 3), (4, 0.14, 2), (4, 0.15, 3), (4, 0.29, 3), (4, 0.3, 4), (4, 0.45, 5), (4, 1.0, 6)],
)
def test_a_test_raises_k_max_by_a_level_for_each_threshold_that_it_holds(
    stride: int, success_rate: float, k_max: int
) -> None:
    curriculum = Curriculum(50, levels="path", threshold=0.15, stride=stride)
    assert curriculum.report(success_rate) == (k_max > 2)
    assert curriculum.k_max == k_max


def test_a_stride_ends_at_the_last_level() -> None:
    curriculum = Curriculum(50, levels="path", n_levels=4, threshold=0.0, stride=3)
    curriculum.report(0.0)
    assert curriculum.k_max == 3, "a threshold of 0 is held once"
    curriculum = Curriculum(50, levels="path", n_levels=4, threshold=0.1, stride=3)
    curriculum.report(1.0)
    assert (curriculum.k_max, curriculum.finished) == (4, True)


def test_a_finished_curriculum_draws_original_goals_only() -> None:
    original, _ = Curriculum(10, k_max=10, p=0.0).draw(1000, RNG(0))
    assert original.all()


def test_path_levels_have_their_own_number() -> None:
    curriculum = Curriculum(50, levels="path", n_levels=3)
    assert curriculum.n_levels == 3
    assert curriculum.report(1.0)
    assert curriculum.finished


def test_state_passes_through_json() -> None:
    curriculum = Curriculum(50)
    curriculum.report(1.0)
    resumed = Curriculum(50)
    resumed.load_state_dict(json.loads(json.dumps(curriculum.state_dict())))
    assert resumed.k_max == 3
    draws = [c.draw(50, RNG(1)) for c in (curriculum, resumed)]
    np.testing.assert_array_equal(draws[0], draws[1])


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"k_max": 51, "passed_last": False, "levels": "time", "n_levels": 50},
        {"k_max": 2.5, "passed_last": False, "levels": "time", "n_levels": 50},
        {"k_max": 2, "passed_last": False, "levels": "path", "n_levels": 25},
    ],
)
def test_a_state_of_another_curriculum_is_refused(state: dict[str, Any]) -> None:
    curriculum = Curriculum(50)
    with pytest.raises(ValueError):
        curriculum.load_state_dict(state)
    assert curriculum.k_max == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"p": 1.1}, r"p is 1.1; it must lie in \[0, 1\]"),
        ({"p": float("nan")}, "p is nan; it must lie in"),
        ({"threshold": -0.1}, "threshold is -0.1; it must lie in"),
        ({"k_max": 51}, "k_max is 51; it must be at most 50"),
        ({"k_max": 0}, "k_max"),
        ({"k_max": 2.0}, "k_max"),
        ({"k_max": 11, "levels": "path", "n_levels": 10}, "k_max is 11; it must be at most 10"),
        ({"levels": "space"}, "levels must be 'time' or 'path', not 'space'"),
        ({"sampling": "min"}, "sampling must be 'uniform' or 'max', not 'min'"),
        ({"n_levels": 0, "levels": "path"}, "n_levels"),
        ({"min_distance": -1.0}, "min_distance"),
        ({"horizon": 0}, "horizon"),
    ],
)
def test_values_out_of_range_are_refused_in_a_sentence(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Curriculum(**{"horizon": 50, **options})


def test_a_success_rate_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="success_rate"):
        Curriculum(50).report(2.0)


# Imagined goals


def test_time_levels_are_steps_of_the_predictor() -> None:
    path, goal = toy.paths(5)
    level = np.arange(1, 6)
    shown = imagine(toy.StraightPredictor(), toy.curriculum(), path[:, 0], goal, level)
    np.testing.assert_allclose(shown, path[np.arange(5), level], atol=1e-12)


def test_path_levels_share_the_length_equally() -> None:
    path, goal = toy.paths(4)
    curriculum = toy.curriculum(levels="path", n_levels=4)
    shown = imagine(toy.StraightPredictor(), curriculum, path[:, 0], goal, np.array([1, 2, 3, 4]))
    # The point rests on its goal from step 6 on: in time, half of the steps are not half the way.
    share = np.array([[0.25], [0.5], [0.75], [1.0]])
    np.testing.assert_allclose(shown, path[:, 0] + share * (goal - path[:, 0]), atol=1e-12)


def test_points_along_a_path_with_corners_and_rests() -> None:
    corner = np.array([[[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 3, 0], [1, 3, 0]]], float)
    points = points_along(corner, np.array([0.0, 0.125, 0.25, 0.5, 1.0]))
    expected = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 1, 0], [1, 3, 0]]
    np.testing.assert_allclose(points[0], expected, atol=1e-12)


def test_a_path_of_no_length_stays_in_place() -> None:
    path = np.ones((1, 5, 3))
    np.testing.assert_array_equal(points_along(path, np.array([0.5, 1.0])), np.ones((1, 2, 3)))


def test_levels_beyond_the_last_are_refused() -> None:
    path, goal = toy.paths(1)
    for level in (0, 11):
        with pytest.raises(ValueError, match="Levels must lie in"):
            imagine(toy.StraightPredictor(), toy.curriculum(), path[:, 0], goal, np.array([level]))


@pytest.mark.parametrize("levels", ["time", "path"])
def test_drawn_goals_are_those_of_their_levels(levels: str) -> None:
    path, goal = toy.paths(500)
    predictor, curriculum = toy.StraightPredictor(), toy.curriculum(levels=levels, k_max=5)
    shown, level = draw_goals(predictor, curriculum, path[:, 0], goal, RNG(0))
    original = level == 0
    assert 0.1 < original.mean() < 0.3
    assert set(level[~original]) == {1, 2, 3, 4, 5}
    np.testing.assert_array_equal(shown[original], goal[original])
    imagined = imagine(predictor, curriculum, path[~original, 0], goal[~original], level[~original])
    np.testing.assert_allclose(shown[~original], imagined, atol=1e-12)


@pytest.mark.parametrize("levels", ["time", "path"])
def test_goals_near_the_start_are_drawn_again_uniformly_among_the_far_ones(levels: str) -> None:
    path, goal = toy.paths(3000)
    # 6 levels of 5 cm each, in time as along the path; goals of levels 1 and 2 are too near.
    curriculum = toy.curriculum(levels=levels, n_levels=6, k_max=4, p=0.0, min_distance=0.12)
    shown, level = draw_goals(toy.StraightPredictor(), curriculum, path[:, 0], goal, RNG(0))
    assert np.linalg.norm(shown - path[:, 0], axis=1).min() >= 0.12
    shares = np.bincount(level, minlength=5) / len(level)
    np.testing.assert_allclose(shares, [0, 0, 0, 0.5, 0.5], atol=0.03)


@pytest.mark.parametrize("sampling", ["uniform", "max"])
def test_without_a_far_level_up_to_k_max_the_goal_is_the_original(sampling: str) -> None:
    path, goal = toy.paths(10)
    curriculum = toy.curriculum(k_max=2, p=0.0, min_distance=0.12, sampling=sampling)
    shown, level = draw_goals(toy.StraightPredictor(), curriculum, path[:, 0], goal, RNG(0))
    np.testing.assert_array_equal(shown, goal)
    assert not level.any()


def test_finish_threshold_keeps_imagining_until_the_last_level_is_passed() -> None:
    curriculum = Curriculum(3, k_max=3, threshold=0.1, finish_threshold=0.5, p=0.0)
    assert not curriculum.report(0.4) and not curriculum.finished
    assert not curriculum.draw(100, np.random.default_rng(0))[0].any()
    resumed = Curriculum(3, finish_threshold=0.5)
    resumed.load_state_dict(curriculum.state_dict())
    assert not resumed.finished
    assert curriculum.report(0.5) and curriculum.finished and curriculum.k_max == 3
    assert curriculum.draw(100, np.random.default_rng(0))[0].all()
    resumed.load_state_dict(curriculum.state_dict())
    assert resumed.finished and not resumed.report(1.0)


def sequential(**settings: Any) -> Curriculum:
    return Curriculum(50, levels="path", n_levels=25, sequential=True, **settings)


def test_sequential_tests_need_seven_of_sixteen_or_several_that_add_up() -> None:
    at_once, in_two, never = sequential(), sequential(), sequential()
    assert not sequential().report(6 / 16, 16)
    assert at_once.report(7 / 16, 16) and at_once.k_max == 3
    assert not in_two.report(5 / 16, 16) and in_two.report(6 / 16, 16)
    assert not any(never.report(4 / 16, 16) for _ in range(100))


def test_sequential_tests_forget_the_failures_of_long_ago_and_begin_anew_at_each_level() -> None:
    curriculum = sequential()
    for _ in range(50):
        assert not curriculum.report(0.0, 16)
    assert curriculum.report(7 / 16, 16)
    assert not curriculum.report(5 / 16, 16), "what the level before had left counts no more"


def test_a_level_with_a_rate_of_a_tenth_is_seldom_passed_by_chance() -> None:
    """Of a hundred tests each: by chance most single tests pass it, hardly any sequential ones."""
    rng = RNG(0)
    passed = {True: 0, False: 0}
    for adds_up in passed:
        for _ in range(200):
            curriculum = Curriculum(50, sequential=adds_up)
            passed[adds_up] += any(
                curriculum.report(rng.binomial(16, 0.1) / 16, 16) for _ in range(100)
            )
    assert passed[False] > 190 and passed[True] < 40


def test_a_level_with_a_rate_of_a_half_is_passed_within_a_test_or_two() -> None:
    rng, tests = RNG(0), []
    for _ in range(200):
        curriculum, n = sequential(), 1
        while not curriculum.report(rng.binomial(16, 0.5) / 16, 16):
            n += 1
        tests.append(n)
    assert np.mean(tests) < 1.5


def test_a_sequential_test_goes_on_from_its_state() -> None:
    curriculum, another = sequential(), sequential()
    curriculum.report(5 / 16, 16)
    another.load_state_dict(json.loads(json.dumps(curriculum.state_dict())))
    assert another.report(6 / 16, 16)
    old = {name: value for name, value in curriculum.state_dict().items() if name != "evidence"}
    another.load_state_dict(old)
    assert not another.report(6 / 16, 16)


@pytest.mark.parametrize("threshold", [0.0, 0.05, 0.5, 0.9, 1.0])
def test_sequential_tests_take_every_threshold(threshold: float) -> None:
    assert sequential(threshold=threshold).report(1.0, 100)
    assert sequential(threshold=threshold).report(0.0, 16) == (threshold == 0.0)
