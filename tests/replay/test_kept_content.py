"""A buffer that is reset is as new; a state that does not fit is refused and changes nothing."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from small_buffers import as_arrays, fill, make_buffer, make_env
from toy import HORIZON, PointEnv


class MovingGoalEnv(PointEnv):
    def step(self, action: np.ndarray) -> Any:
        self.goal = self.goal + 0.01
        return super().step(action)


def assert_same_draws(one: Any, other: Any) -> None:
    got, expected = as_arrays(one.sample(300)), as_arrays(other.sample(300))
    for key in expected:
        np.testing.assert_array_equal(got[key], expected[key])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"moved_ratio": 0.5, "min_goal_distance": 0.05, "scene_distance": 0.04},
        {"cher": {"growth": 1.5}},
        {"copy_info_dict": True},
    ],
    ids=["plain", "moved", "cher", "infos"],
)
@pytest.mark.parametrize("n_steps", [17, 47])
@pytest.mark.parametrize("env_class", [PointEnv, MovingGoalEnv])
def test_a_buffer_that_was_reset_is_as_new(
    env_class: type[PointEnv], n_steps: int, options: dict[str, Any]
) -> None:
    env = make_env(env_class=env_class)
    used, new = (make_buffer(env, size=60, **options) for _ in range(2))
    fill([used], env, n_steps)
    used.sample(30)
    used.reset()
    assert used.size() == 0 and not used.is_ready() and used.moved_share() == 0.0
    with pytest.raises(RuntimeError, match="no finished episode yet"):
        used.sample(1)
    new.rng.bit_generator.state = used.rng.bit_generator.state
    env = make_env()
    for n in (HORIZON + 4, 3, 21):
        fill([used, new], env, n, seed=n)
        assert used.size() == new.size() and used.n_added == new.n_added
        for name, store in new._stores().items():
            np.testing.assert_array_equal(used._stores()[name], store, err_msg=name)
        np.testing.assert_array_equal(used.table.facts, new.table.facts)
        np.testing.assert_array_equal(used._current_ep_start, new._current_ep_start)
        np.testing.assert_array_equal(used.infos, new.infos)
        assert_same_draws(used, new)
    assert used.selection_log() == new.selection_log()


@pytest.mark.parametrize("tells_its_size", [True, False], ids=["new", "older"])
@pytest.mark.parametrize(
    ("size", "n_steps", "into"), [(25, 37, 60), (60, 20, 20), (60, 70, 20)], ids=str
)
def test_a_state_of_another_size_is_refused(
    size: int, n_steps: int, into: int, tells_its_size: bool
) -> None:
    env = make_env(1)
    buffer, other = (make_buffer(env, size=slots) for slots in (size, into))
    fill([buffer], env, n_steps)
    fill([other], env, 13, seed=1)
    state = buffer.state_dict()
    if not tells_its_size:
        state.pop("buffer_size", None)
    with pytest.raises(ValueError, match=f"this one has room for {into}: give it the saved one's"):
        other.load_state_dict(state)


@pytest.mark.parametrize("n_steps", [0, 17, 29, 30, 47])
def test_a_state_that_does_not_tell_its_size_is_loaded(n_steps: int) -> None:
    env = make_env()
    buffer, other = (make_buffer(env, size=60) for _ in range(2))
    fill([buffer], env, n_steps)
    state = copy.deepcopy(buffer.state_dict())
    state.pop("buffer_size", None)
    other.load_state_dict(state)
    fill([buffer, other], env, HORIZON, seed=1)
    assert_same_draws(other, buffer)


@pytest.mark.parametrize("env_class", [PointEnv, MovingGoalEnv])
@pytest.mark.parametrize("wrong", ["copies", "size", "cher"])
def test_a_state_that_is_refused_changes_nothing(wrong: str, env_class: type[PointEnv]) -> None:
    env = make_env(env_class=env_class)
    buffer = make_buffer(env, size=60, cher={} if wrong == "cher" else None)
    fill([buffer], env, 25)
    before = copy.deepcopy(buffer)
    other_env = make_env(
        3 if wrong == "copies" else 2, MovingGoalEnv if env_class is PointEnv else PointEnv
    )
    other = make_buffer(other_env, size=62 if wrong == "size" else 60)
    fill([other], other_env, HORIZON, seed=1)
    sentence = {"copies": "another shape", "size": "room for 31 steps", "cher": "without cher"}
    with pytest.raises(ValueError, match=sentence[wrong]):
        buffer.load_state_dict(other.state_dict())
    assert buffer.goals_are_shared == before.goals_are_shared
    assert buffer.revision == before.revision and buffer.pos == before.pos
    for name, store in before._stores().items():
        np.testing.assert_array_equal(buffer._stores()[name], store, err_msg=name)
    assert_same_draws(buffer, before)
