"""States and actions on one side of planes of symmetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import arm_and_wall
import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_follow_object import HerDDPG, HerPolicy, export_onnx
from sb3_follow_object.common.mirrors import Mirror
from sb3_follow_object.ddpg.actor_files import load_actor, save_actor
from sb3_follow_object.ddpg.folding import Folding, resolved_mirrors
from sb3_follow_object.envs import TASKS, Box, FetchVecEnv, Region, Task
from sb3_follow_object.envs.robot_copies import robot_vec_env
from sb3_follow_object.envs.symmetry import fetch_mirrors

X = Mirror(axis=0, at=1.0, positions=(0,), signs=(3,), swaps=((1, 2),), actions=(0,))
Y = Mirror(axis=1, at=-0.5, signs=(1,), actions=(1,))
OBSERVATION, ACTION = th.tensor([[0.7, 2.0, 3.0, 4.0]]), th.tensor([[0.1, 0.2]])


def test_what_lies_on_the_lower_side_is_mirrored() -> None:
    low, high = th.tensor([[0.9, 0.0, 0.4]]), th.tensor([[1.0, 0.0, 0.4]])
    folding = Folding([X], 4, 2)

    observation, goal = folding.states(OBSERVATION, low)
    np.testing.assert_allclose(observation, [[1.3, 3.0, 2.0, -4.0]])
    np.testing.assert_allclose(goal, [[1.1, 0.0, 0.4]])
    np.testing.assert_allclose(folding.actions(ACTION, low), [[-0.1, 0.2]])

    observation, goal = folding.states(OBSERVATION, high)
    assert th.equal(observation, OBSERVATION) and th.equal(goal, high)
    assert th.equal(folding.actions(ACTION, high), ACTION)


def test_two_planes_fold_into_a_quarter() -> None:
    goals = th.tensor([[0.9, -0.6, 0.4], [0.9, 0.0, 0.4], [1.1, -0.6, 0.4], [1.1, 0.0, 0.4]])
    folding = Folding([X, Y], 4, 2)
    _, folded = folding.states(OBSERVATION.expand(4, -1), goals)
    assert (folded[:, 0] >= 1.0).all() and (folded[:, 1] >= -0.5).all()
    actions = folding.actions(ACTION.expand(4, -1), goals)
    np.testing.assert_allclose(actions.sign(), [[-1, -1], [-1, 1], [1, -1], [1, 1]])


@pytest.mark.parametrize(
    ("mirrors", "said"),
    [
        ([X, X], "same axis"),
        ([Mirror(0, 0.0, positions=(4,))], "observations of 5 entries"),
        ([Mirror(0, 0.0, actions=(2,))], "actions of 3"),
    ],
)
def test_mirrors_that_do_not_fit_are_refused(mirrors: list[Mirror], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Folding(mirrors, 4, 2)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"axis": 3, "at": 0.0}, "axis"),
        ({"axis": 0, "at": float("nan")}, "at"),
        ({"axis": 0, "at": 0.0, "signs": (1, 1)}, "twice"),
        ({"axis": 0, "at": 0.0, "signs": (1,), "swaps": ((1, 2),)}, "twice"),
        ({"axis": 0, "at": 0.0, "swaps": ((1, 2, 3),)}, "pairs"),
        ({"axis": 0, "at": 0.0, "actions": (-1,)}, "entry"),
    ],
)
def test_a_mirror_that_is_none_is_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Mirror(**fields)


def test_obstacles_decide_which_planes_there_are() -> None:
    axes = {name: [mirror.axis for mirror in fetch_mirrors(task)] for name, task in TASKS.items()}
    across = {"PnPSimpleV1", "PnPSimpleV2", "PnPInsertion"}
    assert axes == {name: [0, 1] if name in across else [0] for name in axes}
    region = Region("table", (-0.1, -0.2), (0.1, -0.1))
    aside = Task("Aside", region, region, obstacles=(Box((0.05, 0.1, 0.25), (0.1, 0.01, 0.05)),))
    assert fetch_mirrors(aside) == ()


def _model(env: Any, **policy_kwargs: Any) -> HerDDPG:
    return HerDDPG("MultiInputPolicy", env, seed=0, policy_kwargs=policy_kwargs)


def test_the_policy_acts_in_a_mirrored_state_as_in_a_mirror(tmp_path: Path) -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 4, seed=0)
    model = _model(env, mirrors="auto", net_arch=[16])
    model.policy.set_moments(th.full((28,), 0.7), th.full((28,), 0.2))
    obs = env.reset()
    played, _ = model.predict(obs, deterministic=True)
    for mirror in env.mirrors:
        # One plane at a time, whatever side each goal is on.
        folding = Folding([mirror], 25, 4)
        goals = th.tensor(obs["desired_goal"], dtype=th.float32)
        other = goals.clone()
        other[:, mirror.axis] = 2 * mirror.at - other[:, mirror.axis]
        order, sign, shift, *_, action_sign = folding._of(0)
        observation = th.tensor(obs["observation"], dtype=th.float32)[:, order] * sign + shift
        there = {**obs, "observation": observation.numpy(), "desired_goal": other.numpy()}
        mirrored, _ = model.predict(there, deterministic=True)
        np.testing.assert_allclose(mirrored, played * action_sign.numpy(), atol=1e-5)
        assert np.abs(mirrored - played).max() > 1e-3
    # The planes come with the policy's file and with the model's.
    save_actor(tmp_path / "policy.safetensors", model.policy.actor, "some-v0")
    actor, _ = load_actor(tmp_path / "policy.safetensors", env.observation_space, env.action_space)
    np.testing.assert_array_equal(actor.predict(obs, deterministic=True)[0], played)
    assert export_onnx(model, tmp_path / "policy.onnx") < 1e-5  # compares them by itself
    model.save(tmp_path / "model")
    loaded = HerDDPG.load(tmp_path / "model")
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], played)


def test_training_folds_states_and_actions_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 4, seed=0, max_episode_steps=5)
    model = _model(env, mirrors="auto", net_arch=[8])
    seen: list[Any] = []
    run = model._updates.run

    def keep(chunk: Any, *rest: Any) -> th.Tensor:
        seen.append(chunk)
        return run(chunk, *rest)

    monkeypatch.setattr(model._updates, "run", keep)
    sampled: list[Any] = []
    sample = model._sample

    def keep_sample(*args: Any) -> Any:
        sampled.append(sample(*args))
        return sampled[-1]

    monkeypatch.setattr(model, "_sample", keep_sample)
    model.learn(20)
    chunk, data = seen[0], sampled[0][0]
    folding = model.policy.folding
    assert folding is not None
    observation, goal = folding.states(
        data.observations["observation"], data.observations["desired_goal"]
    )
    extractor = model.actor.features_extractor
    inputs = (th.cat([observation, goal], 1) - extractor.mean) / extractor.std
    np.testing.assert_allclose(chunk.features, inputs.clamp(-5, 5), atol=1e-6)
    flipped = (chunk.actions != data.actions).any(dim=0)
    assert flipped.tolist() == [True, True, False, False]
    assert goal[:, 0].min() >= 1.3 and goal[:, 1].min() >= 0.75
    # Inputs are standardised as the networks see them.
    assert extractor.mean[25] > 1.3 and extractor.mean[26] > 0.75


def test_auto_finds_none_where_the_environment_names_none() -> None:
    assert resolved_mirrors("auto", None) == []
    assert resolved_mirrors(None, None) == []
    (told,) = resolved_mirrors([{"axis": 1, "at": 0.5, "signs": [2]}], None)
    assert told == {**told, "axis": 1, "at": 0.5, "signs": [2], "swaps": []}
    env = gym.make("FollowObject/PushMiddleGap-v0")
    assert [mirror.axis for mirror in env.get_wrapper_attr("mirrors")] == [0]


class MirroredArm(arm_and_wall.ArmAndWall):
    """The tutorial's arm, with planes that somebody might name."""

    mirrors = ({"axis": 1, "at": 0.0, "positions": [1, 4], "actions": [0]},)


gym.register("MirroredArm-v0", MirroredArm, max_episode_steps=5)


@pytest.mark.parametrize("n_threads", [1, 2])
def test_others_environments_name_their_planes(n_threads: int) -> None:
    env = robot_vec_env("MirroredArm-v0", 2, n_threads)
    model = _model(env, mirrors="auto", net_arch=[8])
    assert model.policy.folding is not None
    assert [mirror.axis for mirror in model.policy.folding.mirrors] == [1]
    env.close()


def test_mirrors_for_other_goals_are_refused() -> None:
    box = gym.spaces.Box(-1.0, 1.0, (2,))
    spaces = gym.spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
    with pytest.raises(ValueError, match="positions"):
        HerPolicy(spaces, box, lambda _: 1e-3, mirrors=[{"axis": 0, "at": 0.0}])


@pytest.mark.parametrize("given", ["left", [1], [{"at": 0.0}], [{"axis": 0, "at": 0.0, "x": 1}]])
def test_what_is_no_list_of_mirrors_is_refused(given: Any) -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 1, seed=0)
    with pytest.raises(ValueError, match="mirrors"):
        _model(env, mirrors=given)
