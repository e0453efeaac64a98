"""What has a `save` has a `load`, in another process, and without an environment where SB3 can."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from numbered import learner, numbered
from small_buffers import make_env
from small_models import make_model
from stable_baselines3 import DDPG
from stable_baselines3.common.buffers import DictReplayBuffer
from toy import HORIZON, PointEnv
from tree import ROOT, run

from sb3_follow_object.ddpg.actor_files import save_actor
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.ddpg.policies import HerPolicy

SEEN = {key: np.full((5, 3), 0.1) for key in ("observation", "achieved_goal", "desired_goal")}
LOADER = """
import sys
sys.path.insert(0, {support!r})
import numpy as np
from sb3_follow_object import HerDDPG, HerPolicy, load_actor
import toy
seen = {{k: np.full((5, 3), 0.1) for k in ("observation", "achieved_goal", "desired_goal")}}
env = toy.PointEnv()
np.savez({out!r}, *[loaded.predict(seen, deterministic=True)[0] for loaded in [{loaded}]])
"""
LOADS = {
    "model": "HerDDPG.load({path!r})",
    "model on another device": "HerDDPG.load({path!r}, device='cpu')",
    "policy": "HerPolicy.load({path!r})",
    "actor": "load_actor({path!r}, env.observation_space, env.action_space)[0]",
}
MODELS: dict[str, dict[str, Any]] = {
    "plain": {},
    "with everything": {
        "auxiliary": {"name": "rnd", "hidden": [8], "n_outputs": 4},
        "average_decay": 0.9,
        "policy_kwargs": {"critic_layer_norm": True, "features_clip": 2.0, "net_arch": [16]},
    },
}
ALL = [(which, kind) for which in MODELS for kind in LOADS]


@pytest.fixture(scope="module")
def actions(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], list[np.ndarray]]:
    """What each model does, and what each thing saved of it does in one other process."""
    folder = tmp_path_factory.mktemp("saved")
    here, loads = [], []
    for number, (which, kind) in enumerate(ALL):
        model = make_model(**MODELS[which])
        model.learn(200, log_interval=None)  # type: ignore[arg-type]
        path = folder / f"{number}.zip"
        if kind == "policy":
            model.policy.save(str(path))
        elif kind == "actor":
            save_actor(path, model.policy.actor_average, "Point-v0")
        else:
            model.save(path)
        here.append(model.predict(SEEN, deterministic=True)[0])  # type: ignore[arg-type]
        loads.append(LOADS[kind].format(path=str(path)))
    support, out = str(ROOT / "tests" / "support"), folder / "actions.npz"
    script = LOADER.format(support=support, loaded=", ".join(loads), out=str(out))
    run([sys.executable, "-c", script])
    there = np.load(out)
    return {case: [here[i], there[f"arr_{i}"]] for i, case in enumerate(ALL)}


@pytest.mark.parametrize("case", ALL, ids=" ".join)
def test_acts_the_same_in_another_process(
    case: tuple[str, str], actions: dict[tuple[str, str], list[np.ndarray]]
) -> None:
    np.testing.assert_array_equal(*actions[case])


@pytest.mark.parametrize("what", ["model", "actor"])
def test_what_is_no_actor_of_ours_is_not_saved_as_one(what: str, tmp_path: Path) -> None:
    stock = DDPG("MultiInputPolicy", PointEnv(), buffer_size=100)
    given: Any = stock.actor if what == "actor" else make_model()
    with pytest.raises(ValueError, match="save_actor takes the actor of a HerPolicy"):
        save_actor(tmp_path / "policy.safetensors", given, "Point-v0")
    assert not any(tmp_path.iterdir())


def test_a_policy_is_loaded_whole(tmp_path: Path) -> None:
    model = make_model(
        policy_kwargs={"critic_layer_norm": True, "net_arch": {"pi": [8], "qf": [4]}}
    )
    model.learn(200, log_interval=None)  # type: ignore[arg-type]
    model.policy.save(str(tmp_path / "policy"))
    loaded = HerPolicy.load(str(tmp_path / "policy"))
    assert loaded.critic_layer_norm and loaded.features_clip == 5.0
    for ours, theirs in zip(model.policy.parameters(), loaded.parameters(), strict=True):
        assert th.equal(ours, theirs)


def test_a_model_without_an_environment_says_what_it_needs_and_learns_once_it_has_it(
    tmp_path: Path,
) -> None:
    model = learner("HerDDPG", numbered(2))
    model.learn(5 * 2 * HORIZON)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = HerDDPG.load(tmp_path / "model")
    assert loaded.replay_buffer is None
    for wanted in (
        lambda: loaded.learn(10),
        lambda: loaded.load_replay_buffer(tmp_path / "buffer"),
    ):
        with pytest.raises(ValueError, match=r"call set_env\(env\) first"):
            wanted()
    again = HerDDPG.load(tmp_path / "model")
    again.save(tmp_path / "again")
    loaded = HerDDPG.load(tmp_path / "again")
    loaded.set_env(numbered(2))
    loaded.load_replay_buffer(tmp_path / "buffer")
    before = loaded._n_updates
    loaded.learn(2 * HORIZON, reset_num_timesteps=False)
    assert loaded._n_updates > before and loaded.num_timesteps == 6 * 2 * HORIZON


def test_the_zoos_way_without_an_environment_still_works(tmp_path: Path) -> None:
    model = make_model()
    model.save(tmp_path / "model")
    options = {"buffer_size": 1, "replay_buffer_class": DictReplayBuffer}
    HerDDPG.load(tmp_path / "model", None, replay_buffer_kwargs={}, **options)


@pytest.mark.parametrize("truncated", [True, False])
def test_a_replay_buffer_is_loaded_by_the_model_that_goes_on(
    truncated: bool, tmp_path: Path
) -> None:
    model = learner("HerDDPG", numbered(2), train_freq=13)
    model.learn(3 * 2 * 13)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = HerDDPG.load(tmp_path / "model", env=numbered(2))
    if truncated:
        with pytest.warns(UserWarning, match="truncated"):
            loaded.load_replay_buffer(tmp_path / "buffer")
    else:
        loaded.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    assert loaded.replay_buffer.env is loaded.env  # type: ignore[union-attr]
    loaded.learn(2 * 13, reset_num_timesteps=False)
    lengths = loaded.replay_buffer.table.length  # type: ignore[union-attr]
    assert sorted(lengths[lengths > 0]) == [9, 9, *[10] * 8]  # 39 = 3 x 10 + 9, then 10 and 3


def test_without_its_replay_a_loaded_model_waits_for_the_first_episode(tmp_path: Path) -> None:
    """Its steps have passed learning_starts; the new buffer is empty."""
    model = learner("HerDDPG", numbered(2), train_freq=4)
    model.learn(100)
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=numbered(2))
    before = loaded._n_updates
    loaded.learn(2 * 8, reset_num_timesteps=False)
    assert loaded._n_updates == before
    loaded.learn(2 * 8, reset_num_timesteps=False)
    assert loaded._n_updates > before


def test_moments_go_on_with_what_the_new_buffer_is_given(tmp_path: Path) -> None:
    """Not with the empty slots between where the old buffer stood and where the new one does."""
    model = make_model()
    model.learn(400, log_interval=None)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model", env=make_env(4))
    loaded.learn(200, log_interval=None)  # type: ignore[arg-type]
    assert loaded.moments.count == pytest.approx(2 * 600, rel=1e-3)
    std = loaded.moments.std[3:]  # goals lie 30 cm away; empty slots would pull this to 0.01
    assert (std > 0.1).all()


def test_schedules_end_at_zero_and_not_below() -> None:
    rates: list[float] = []

    def linear(progress: float) -> float:
        rates.append(1e-3 * progress)
        return rates[-1]

    model = learner("HerDDPG", numbered(2), learning_rate=linear, train_freq=30, learning_starts=0)
    model.learn(70)  # two rollouts of 60 steps
    assert min(rates) == 0.0 and max(rates) == 1e-3
