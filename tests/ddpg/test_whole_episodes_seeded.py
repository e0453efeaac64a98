"""`set_random_seed` seeds all that a training draws from, whenever it is called."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from small_models import make_model, weights
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import PointEnv

from sb3_follow_object.ddpg.her_ddpg import HerDDPG


def states(model: Any) -> list[Any]:
    """What the algorithm's and the replay buffer's generators stand at."""
    states = [each.rng.bit_generator.state for each in (model, model.replay_buffer)]
    if model._device_replay is not None:
        states.append(model._device_replay.generator.get_state().tolist())
    return states


@pytest.mark.parametrize("on_device", [False, True])
def test_a_seed_begins_the_generators_as_a_new_model_with_it_has_them(on_device: bool) -> None:
    model, new = (make_model(seed=seed, replay_on_device=on_device) for seed in (0, 7))
    model.learn(80)
    assert states(model) != states(new)
    model.set_random_seed(7)
    assert states(model) == states(new)


def test_no_seed_changes_nothing() -> None:
    model, same = make_model(), make_model()
    model.set_random_seed(None)
    assert states(model) == states(same)


def test_a_buffers_own_seed_stays() -> None:
    model = make_model(replay_buffer_kwargs={"seed": 3})
    before = states(model)
    model.set_random_seed(7)
    assert states(model)[1] == before[1] and states(model)[0] != before[0]


def test_a_loaded_model_that_is_seeded_learns_the_same_again(tmp_path: Path) -> None:
    model = make_model(seed=None)
    model.learn(80)
    model.save(tmp_path / "model")
    learned = []
    for other in range(2):
        np.random.seed(other)
        th.manual_seed(other)
        again = HerDDPG.load(tmp_path / "model", env=DummyVecEnv([PointEnv] * 4))
        again.set_random_seed(7)
        again.learn(160)
        learned.append(weights(again))
    assert th.equal(*learned)
    assert again._n_updates > model._n_updates


def test_one_that_was_loaded_to_act_learns_the_same_too(tmp_path: Path) -> None:
    make_model(seed=None).save(tmp_path / "model")
    learned = []
    for other in range(2):
        np.random.seed(other)
        again = HerDDPG.load(tmp_path / "model")
        again.set_random_seed(7)
        again.set_env(DummyVecEnv([PointEnv] * 4))
        again.env.seed(7)  # type: ignore[union-attr]
        again.learn(160)
        learned.append(weights(again))
    assert th.equal(*learned)
