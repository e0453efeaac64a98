"""Transitions lie side by side in memory; what is drawn is what was drawn before they did."""

from __future__ import annotations

import copy
import hashlib
import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_follow_object.replay.episode_table import EpisodeTable
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer
from sb3_follow_object.replay.records import Records

# Digests of samples from a buffer with an array a field and a binary search over all episodes:
# 300 and then 64 transitions after 60 steps, and as many after 205 steps, which overwrite some.
FROZEN: dict[str, tuple[dict[str, Any], list[str]]] = {
    "plain": (
        {},
        ["98f4b230401cd151", "84cc4211bb52e595", "9f031e22660d38a4", "453794ce15f62e5b"],
    ),
    "episode": (
        {"goal_selection_strategy": "episode"},
        ["c702c44d3c1e7091", "fc51ca6d20e4a8ad", "ca5d720ab4a411a9", "893053e94c8f8556"],
    ),
    "final": (
        {"goal_selection_strategy": "final"},
        ["6d49653001fef2e5", "fb3ccc58c0dc94c8", "3bb5bbb09ae2beca", "0be631c0b7d7d8e5"],
    ),
    "uneven": (
        {"lengths": (1, 3, 8, 13)},
        ["5ab31066b6526daa", "17bc73f15b0bb8a0", "e3627d4fab18a6cd", "d7d30c2e48bc8de8"],
    ),
    "moved": (
        {"moved_ratio": 0.5, "moved_distance": 1.0},
        ["dd4ccc24898314f8", "1419453580696ee3", "99cfc8f4f6591c23", "cdc809857a2d9302"],
    ),
    "energy": (
        {"moved_ratio": 0.5, "moved_distance": 1.0, "moved_priority": "energy", "lengths": (4, 9)},
        ["0c49b3a3cdead668", "cb686278b069ee18", "f4c177ea50ad65ae", "b00c22611831dfa4"],
    ),
    "far": (
        {"moved_ratio": 0.5, "moved_distance": 0.5, "min_goal_distance": 2.0},
        ["040e5afd38cbd746", "bdccfbb5282a482c", "f95ede156777247c", "0b32f9301958c178"],
    ),
}


def unbounded(*shape: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float64)


GOALS = {key: unbounded(3) for key in ("achieved_goal", "desired_goal")}


def near(achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
    return -(np.abs(achieved - desired).sum(axis=1) > 4).astype(np.float32)


def make_buffer(n_steps: int, lengths: tuple[int, ...] = (5,), **options: Any) -> Any:
    """80 slots of 3 environments, filled with whole numbers: the same on every machine."""
    n_envs = 3
    buffer = FollowObjectReplayBuffer(
        240,
        spaces.Dict({"observation": unbounded(7), **GOALS}),
        spaces.Box(-1, 1, (2,), np.float32),
        None,  # type: ignore[arg-type]
        "cpu",
        n_envs,
        reward_function=near,
        seed=3,
        **options,
    )
    rng = np.random.default_rng(0)
    left = rng.choice(lengths, n_envs)
    where, goal = rng.integers(0, 9, (2, n_envs, 3)).astype(float)

    def observe() -> dict[str, np.ndarray]:
        observation = rng.integers(0, 99, (n_envs, 7)).astype(float)
        return {"observation": observation, "achieved_goal": where, "desired_goal": goal}

    later = observe()
    for step in range(n_steps):
        obs = later  # of a new episode too, its goal apart
        where = where + rng.integers(-1, 2, (n_envs, 3)) * (step % 40 > 14)
        later = next_obs = observe()
        left -= 1
        done = left == 0
        infos = [{"TimeLimit.truncated": bool(d and rng.integers(2))} for d in done]
        actions = rng.integers(-1, 2, (n_envs, 2)).astype(float)
        buffer.add(obs, next_obs, actions, rng.integers(-5, 0, n_envs), done, infos)
        goal = np.where(done[:, None], rng.integers(0, 9, (n_envs, 3)), goal)
        later = {**later, "desired_goal": goal}
        left[done] = rng.choice(lengths, done.sum())
    return buffer


def digest(buffer: Any, n: int) -> str:
    samples, steps = buffer.sample_with_steps(n)
    parts = [
        half[key]
        for half in (samples.observations, samples.next_observations)
        for key in ("observation", "achieved_goal", "desired_goal")
    ]
    parts += [samples.actions, samples.rewards, samples.dones, steps]
    content = b"".join(part.numpy().astype("<f4").tobytes() for part in parts)
    return hashlib.sha256(content).hexdigest()[:16]


@pytest.mark.parametrize("case", FROZEN)
def test_samples_are_bit_for_bit_those_of_before(case: str) -> None:
    options, wanted = FROZEN[case]
    got = []
    for n_steps in (60, 205):
        buffer = make_buffer(n_steps, **options)
        got.append(digest(buffer, 300))
        buffer.sample(7)
        got.append(digest(buffer, 64))
    assert got == wanted


@pytest.mark.parametrize("lengths", [(50, 50), (1, 50), (1, 2), (7, 8)])
@pytest.mark.parametrize("by_priority", [False, True])
def test_draw_is_that_of_a_binary_search(lengths: tuple[int, int], by_priority: bool) -> None:
    rng = np.random.default_rng(0)
    table = EpisodeTable()
    for i in range(300):
        length = int(rng.integers(lengths[0], lengths[1] + 1))
        table.insert(50 * i, 0, length, float(rng.exponential() * rng.integers(2)))
    for row in range(0, 300, 7):
        table.remove(row)
    weight = table.length * (table.priority if by_priority else 1.0)
    rows = np.flatnonzero(weight > 0)
    ends = np.cumsum(weight[rows])
    ours, theirs = np.random.default_rng(1), np.random.default_rng(1)
    row, step = table.draw(20_000, ours, by_priority)
    found = np.searchsorted(ends, theirs.random(20_000) * ends[-1], side="right")
    wanted = rows[np.minimum(found, len(rows) - 1)]
    np.testing.assert_array_equal(row, wanted)
    np.testing.assert_array_equal(step, theirs.integers(table.length[wanted]))


def test_sb3s_arrays_are_views_of_records_also_after_pickling() -> None:
    buffer = make_buffer(30)
    other = pickle.loads(pickle.dumps(buffer))
    for each in (buffer, other):
        assert each.records.array.ctypes.data % 64 == 0
        for array in (
            *each.observations.values(),
            each.next_observations["observation"],
            each.actions,
            each.rewards,
            each.dones,
            each.timeouts,
        ):
            assert np.shares_memory(array, each.records.array)
        achieved = each.next_observations["achieved_goal"]
        assert np.shares_memory(achieved, each.achieved.array)
    assert not np.shares_memory(buffer.records.array, other.records.array)
    for key in buffer.next_observations:
        stored = buffer.next_observations[key]
        np.testing.assert_array_equal(other.next_observations[key], stored)
    assert digest(buffer, 50) == digest(other, 50)


def test_records_begin_with_cache_lines_where_that_is_cheap() -> None:
    assert Records(2, 1, {"a": (60,), "b": ()}).array.shape == (2, 1, 64)
    assert Records(2, 1, {"a": (18,), "b": ()}).array.shape == (2, 1, 19)


def test_memory_per_transition() -> None:
    """7 + 3 + 7 numbers of observations, a goal, 2 of the action, 3 more and what was achieved."""
    buffer = make_buffer(5)
    assert buffer.records.array.shape[-1] == 25
    bookkeeping = 2 * 4
    assert buffer.bytes_per_transition() == 4 * (25 + 4) + bookkeeping


def test_goals_that_move_within_an_episode_are_kept_apart() -> None:
    buffer = make_buffer(30, n_sampled_goal=0)
    resumed = make_buffer(0)
    obs = {key: np.full((3, space.shape[0]), 1.0) for key, space in GOALS.items()}  # type: ignore[index]
    obs["observation"] = np.zeros((3, 7))
    later = {**obs, "desired_goal": np.full((3, 3), 2.0)}
    before = buffer.next_observations["desired_goal"][:30].copy()
    for _ in range(10):
        buffer.add(obs, later, np.zeros((3, 2)), np.zeros(3), np.ones(3, dtype=bool), [{}] * 3)
    np.testing.assert_array_equal(buffer.next_observations["desired_goal"][:30], before)
    resumed.load_state_dict(buffer.state_dict())
    for each in (buffer, pickle.loads(pickle.dumps(buffer)), resumed):
        each.her_ratio = 0.0
        samples = each.sample(500)
        goal, next_goal = (
            half["desired_goal"].numpy()
            for half in (samples.observations, samples.next_observations)
        )
        moved = (samples.observations["observation"] == 0).all(dim=1).numpy()
        assert 0.1 < moved.mean() < 0.9
        assert (goal[moved] == 1.0).all() and (next_goal[moved] == 2.0).all()
        np.testing.assert_array_equal(goal[~moved], next_goal[~moved])


@pytest.mark.parametrize("dtype", [np.int8, np.float32])
def test_images_and_whole_numbers_have_arrays_of_their_own(dtype: Any) -> None:
    bits = spaces.Box(0, 9, (2,), dtype)
    space = spaces.Dict(
        {
            "observation": spaces.Box(0, 255, (4, 5, 1), np.uint8),
            "achieved_goal": bits,
            "desired_goal": bits,
        }
    )
    asked: list[np.ndarray] = []

    def reward(achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        asked.extend([achieved, desired])
        return (achieved == desired).all(axis=1).astype(np.float32) - 1.0

    buffer = FollowObjectReplayBuffer(
        60,
        space,
        spaces.Discrete(9),
        None,
        "cpu",
        2,
        reward_function=reward,
        seed=0,  # type: ignore[arg-type]
    )
    for step in range(20):
        obs = {key: np.full((2, *s.shape), step, s.dtype) for key, s in space.spaces.items()}  # type: ignore[misc]
        later = {key: value + 1 for key, value in obs.items()}
        done = np.full(2, step % 5 == 4)
        buffer.add(obs, later, np.array([step, step]), np.zeros(2), done, [{}, {}])
    for each in (buffer, copy.deepcopy(buffer)):
        samples, steps = each.sample_with_steps(200)
        image = samples.observations["observation"]
        assert image.shape == (200, 4, 5, 1)
        step = image[:, 0, 0, 0]
        assert (samples.actions[:, 0] == step).all()
        assert (samples.next_observations["achieved_goal"][:, 0] == step + 1).all()
        virtual = steps[:, 0].isfinite()
        goal = samples.observations["desired_goal"][:, 0]
        assert (goal[virtual] == (step + 1 + steps[:, 0])[virtual]).all()
    assert {array.dtype for array in asked} == {np.dtype(dtype)}
    assert {*buffer._stores()} >= {"observations.observation", "actions", "records"}
