"""Random network distillation: where the bonus falls, and the statistics that scale it."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sb3_follow_object.ddpg.auxiliary import Transitions
from sb3_follow_object.ddpg.rnd import RndReward

N_FEATURES = 6


def batch(next_features: th.Tensor) -> Transitions:
    nothing = th.zeros(len(next_features), 1)
    return Transitions({}, nothing, {}, nothing, next_features)


def around(centre: float, n: int = 256) -> Transitions:
    return batch(centre + 0.3 * th.randn(n, N_FEATURES))


def test_bonus_falls_where_it_has_been_and_not_where_it_has_not() -> None:
    th.manual_seed(0)
    reward = RndReward(N_FEATURES, hidden=(64, 64), n_outputs=32)
    here, there = around(1.0), around(-1.0)
    with th.no_grad():
        before_here, before_there = reward(here).mean(), reward(there).mean()
    for _ in range(300):
        reward.update(around(1.0))
    with th.no_grad():
        after_here, after_there = reward(here).mean(), reward(there).mean()
    assert after_here < 0.1 * before_here
    assert after_there > 0.5 * before_there


def test_bonus_is_the_error_over_the_running_deviation() -> None:
    th.manual_seed(0)
    reward = RndReward(N_FEATURES, hidden=(16,), n_outputs=8, max_bonus=1e9)
    seen = []
    for centre in (0.0, 2.0, -3.0):
        data = around(centre, 50)
        with th.no_grad():
            seen.append(reward.errors(data).numpy())
            bonus = reward(data).numpy()
        errors = np.concatenate(seen)
        np.testing.assert_allclose(bonus, seen[-1] / errors.std(), rtol=1e-4)
    assert float(reward.mean) == pytest.approx(errors.mean(), rel=1e-5)
    assert float(reward.count) == 150


def test_bonus_is_never_negative_nor_above_its_bound() -> None:
    th.manual_seed(0)
    reward = RndReward(N_FEATURES, hidden=(16,), n_outputs=8, max_bonus=1.5)
    with th.no_grad():
        reward(around(0.0))
        bonus = reward(around(40.0))
    assert reward.reward_range == (0.0, 1.5)
    assert bonus.max() == 1.5 and bonus.min() >= 0.0


def test_fixed_network_stays_fixed() -> None:
    th.manual_seed(0)
    reward = RndReward(N_FEATURES, hidden=(16,), n_outputs=8)
    before = {name: value.clone() for name, value in reward.target.state_dict().items()}
    learned = [p.clone() for p in reward.predictor.parameters()]
    reward.update(around(0.0))
    assert all(th.equal(value, before[name]) for name, value in reward.target.state_dict().items())
    assert not all(map(th.equal, reward.predictor.parameters(), learned))
