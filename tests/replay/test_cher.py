"""Curriculum-guided selection: equal to a brute-force search, per batch, and resumed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from small_models import make_model

from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.replay.cher import GoalSelection


def similarities(goals: np.ndarray) -> np.ndarray:
    """s_ij of the 1-nearest-neighbour graph, from its definition."""
    n = len(goals)
    nearest = [
        min((j for j in range(n) if j != i), key=lambda j: np.linalg.norm(goals[i] - goals[j]))
        for i in range(n)
    ]
    d = np.array([np.linalg.norm(goals[i] - goals[nearest[i]]) for i in range(n)])
    s = np.zeros((n, n))
    s[np.arange(n), nearest] = np.exp(-(d**2) / d.mean() ** 2) if d.mean() else 1.0
    return s


def objective(chosen: list[int], goals: np.ndarray, achieved: np.ndarray, weight: float) -> float:
    covered = similarities(goals)[:, chosen].max(axis=1).sum()
    return float(covered - weight * np.linalg.norm(goals - achieved, axis=1)[chosen].sum())


def brute_force(goals: np.ndarray, achieved: np.ndarray, n: int, weight: float) -> list[int]:
    """Greedy search over all that is left, the whole objective computed for each."""
    chosen: list[int] = []
    for _ in range(n):
        left = [i for i in range(len(goals)) if i not in chosen]
        gains = [objective([*chosen, i], goals, achieved, weight) for i in left]
        chosen.append(left[int(np.argmax(gains))])
    return chosen


def draw(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    goals = rng.uniform(0, 1, (n, 3)).astype(np.float32)
    return goals, goals + rng.normal(0, 0.3, (n, 3)).astype(np.float32)


@pytest.mark.parametrize("weight", [0.0, 1.0, 30.0])
@pytest.mark.parametrize("seed", range(5))
def test_choice_is_that_of_a_brute_force_greedy_search(seed: int, weight: float) -> None:
    goals, achieved = draw(12, seed)
    selection = GoalSelection(picks=100, weight=weight)
    chosen = selection.choose(goals, achieved, 1, np.random.default_rng(0))
    wanted = brute_force(goals, achieved, 6, weight)
    assert len(set(chosen)) == 6
    # Equal gains may be taken in any order: the value after each pick must be the same.
    for n in range(1, 7):
        assert objective(list(chosen[:n]), goals, achieved, weight) == pytest.approx(
            objective(wanted[:n], goals, achieved, weight)
        )
    if weight:
        assert chosen.tolist() == wanted


def test_lazier_picks_lie_between_chance_and_greed() -> None:
    values: dict[int, list[float]] = {1: [], 3: [], 100: []}
    for seed in range(20):
        goals, achieved = draw(32, seed)
        for picks, of in values.items():
            selection = GoalSelection(picks=picks)
            chosen = selection.choose(goals, achieved, 1, np.random.default_rng(seed))
            of.append(objective(list(chosen), goals, achieved, 1.0))
    assert np.mean(values[1]) < np.mean(values[3]) < np.mean(values[100])


def test_each_pick_looks_at_distinct_random_candidates() -> None:
    """The worst of m is picked first only if the two worst were drawn: never among three."""
    goals = np.zeros((6, 3), dtype=np.float32)
    achieved = np.arange(6, dtype=np.float32)[:, None] * np.array([[1.0, 0, 0]], dtype=np.float32)
    rng = np.random.default_rng(0)
    first = [
        int(GoalSelection(candidates=6).choose(goals, achieved, 1, rng)[0]) for _ in range(4000)
    ]
    # The best of three out of six is candidate i with probability C(5 - i, 2) / C(6, 3). The first
    # of equal goals covers the rest, so it is as good as it is near.
    share = np.bincount(first, minlength=6) / len(first)
    np.testing.assert_allclose(share, [0.5, 0.3, 0.15, 0.05, 0, 0], atol=0.03)


def test_batches_are_chosen_each_from_its_own_candidates() -> None:
    goals, achieved = draw(3 * 10, 0)
    chosen = GoalSelection(picks=100).choose(goals, achieved, 3, np.random.default_rng(0))
    for i, part in enumerate(chosen.reshape(3, 5)):
        rows = slice(10 * i, 10 * (i + 1))
        alone = GoalSelection(picks=100, weight=1.0001**i)
        wanted = alone.choose(goals[rows], achieved[rows], 1, np.random.default_rng(0))
        np.testing.assert_array_equal(part - 10 * i, wanted)


def test_proximity_weighs_more_from_batch_to_batch_and_never_overflows() -> None:
    selection = GoalSelection()
    goals, achieved = draw(8, 0)
    for _ in range(3):
        selection.choose(goals, achieved, 2, np.random.default_rng(0))
    np.testing.assert_allclose(selection.proximity_weights(2), [1.0001**6, 1.0001**7])
    selection.n_batches = 10**9
    assert np.isfinite(selection.proximity_weights(1)).all()
    assert (GoalSelection(weight=0.0).proximity_weights(3) == 0.0).all()


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_or_equal_goals_can_be_chosen_from(n: int) -> None:
    goals = np.ones((n, 3), dtype=np.float32)
    chosen = GoalSelection(candidates=1).choose(goals, goals, 1, np.random.default_rng(0))
    assert sorted(chosen) == list(range(n))


def learned(**cher: Any) -> HerDDPG:
    model = make_model(replay_buffer_kwargs={"cher": cher})
    model.learn(800, log_interval=None)  # type: ignore[arg-type]
    return model


def test_goals_of_a_batch_come_nearer_with_the_weight() -> None:
    distances = []
    for weight in (0.0, 1e6):
        buffer = learned(weight=weight).replay_buffer
        assert buffer is not None
        data, steps = buffer.sample_with_steps(640, n_batches=10)
        assert len(data.rewards) == len(steps) == len(data.actions) == 640
        goal, start = data.observations["desired_goal"], data.observations["achieved_goal"]
        distances.append(float((goal - start).norm(dim=1).mean()))
        # What is chosen stays together: rewards belong to the goals.
        reached = (data.next_observations["achieved_goal"] - goal).norm(dim=1) <= 0.05
        np.testing.assert_array_equal(data.rewards[:, 0] == 0.0, reached)
    assert distances[1] < 0.8 * distances[0]


def test_weight_survives_a_resume() -> None:
    model = learned()
    buffer, other = model.replay_buffer, make_model(replay_buffer_kwargs={"cher": {}}).replay_buffer
    assert buffer is not None and other is not None
    assert buffer.selection is not None and buffer.selection.n_batches == model._n_updates > 0
    other.load_state_dict(buffer.state_dict())
    logged = buffer.selection_log()["cher/proximity_weight"]
    assert logged == pytest.approx(1.0001**model._n_updates)
    assert th.equal(buffer.sample(64).actions, other.sample(64).actions)
    assert other.selection is not None
    assert other.selection.n_batches == buffer.selection.n_batches


@pytest.mark.parametrize(
    ("cher", "sentence"),
    [
        ({"candidates": 0}, "cher: candidates is 0; it must be at least 1"),
        ({"growth": 0.5}, "growth is 0.5; it must lie in"),
        ({"lambda": 1}, "cher has no setting 'lambda'"),
    ],
)
def test_bad_settings_are_one_sentence(cher: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make_model(replay_buffer_kwargs={"cher": cher})
