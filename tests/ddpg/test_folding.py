"""States and actions on one side of planes of symmetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import arm_and_wall
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from tiny_runs import bare_run

from sb3_follow_object import HerDDPG, HerPolicy, export_onnx, make_vec, run_config
from sb3_follow_object.common.mirrors import Mirror, as_mirrors
from sb3_follow_object.ddpg.actor_files import load_actor, save_actor
from sb3_follow_object.ddpg.folding import Folding, resolved_mirrors
from sb3_follow_object.ddpg.policies import NormalizedGoalExtractor
from sb3_follow_object.envs import TASKS, Box, FetchEnv, FetchVecEnv, Region, Task
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
        ([Mirror(0, 0.0, positions=(4,))], "entry 4 of an observation, which has 4"),
        ([Mirror(0, 0.0, actions=(2,))], "entry 2 of an action, which has 2"),
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
        ({"axis": 0, "at": 0.0, "signs": (1,), "positions": (1,)}, "twice"),
        ({"axis": 0, "at": 0.0, "swaps": ((1, 2), (2, 3))}, "twice"),
        ({"axis": 0, "at": 0.0, "swaps": (1, 2)}, "swaps are a list"),
        ({"axis": 0, "at": 0.0, "swaps": None}, "swaps are a list"),
        ({"axis": 0, "at": 0.0, "positions": 3}, "positions are a list"),
        ({"axis": 0, "at": 0.0, "swaps": ((1, 2, 3),)}, "pairs"),
        ({"axis": 0, "at": 0.0, "actions": (-1,)}, "entry"),
    ],
)
def test_a_mirror_that_is_none_is_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Mirror(**fields)


def planes(task: Task) -> list[tuple[int, float]]:
    return [(mirror.axis, mirror.at) for mirror in fetch_mirrors(task)]


def test_goals_and_obstacles_decide_which_planes_there_are() -> None:
    gripper, table = [(0, 1.3419), (1, 0.7491)], [(0, 1.3), (1, 0.75)]
    assert {name: planes(task) for name, task in TASKS.items()} == {
        "PnPSimpleV1": gripper,
        "PnPSimpleV2": table,
        "PnPInsertion": gripper,
        "PushSideGap": table[:1],
        "PushMiddleGap": table[:1],
        "PushDoubleObstacles": table[:1],
        "PnPObstacle": [],
        "PnPShelf": [],
    }


def test_planes_of_a_task_of_ones_own() -> None:
    region = Region("table", (-0.1, -0.2), (0.1, -0.1))
    third = Box((0.1 + 0.2 - 0.15, 0.1, 0.25), (0.05, 0.01, 0.05))
    walls = (third, Box((-0.15, 0.1, 0.25), (0.05, 0.01, 0.05)))
    assert third.centre[0] != 0.15, "a rounding is no asymmetry"
    assert planes(Task("Rounded", region, region, obstacles=walls)) == [(0, 1.3)]
    aside = Task("Aside", region, region, obstacles=(Box((0.05, 0.1, 0.25), (0.1, 0.01, 0.05)),))
    assert planes(aside) == []
    halves = tuple(Box((x, 0.1, 0.25), (0.125, 0.01, 0.05)) for x in (-0.125, 0.125))
    assert planes(Task("Halves", region, region, obstacles=halves)) == [], "a wall across all"
    post = Box((0.0, 0.2, 0.25), (0.01, 0.01, 0.05))
    assert planes(Task("Post", region, region, obstacles=(*halves, post))) == [(0, 1.3)]
    beyond = Region("table", (-0.1, 0.1), (0.1, 0.2))
    assert planes(Task("Across", region, beyond)) == [(0, 1.3)], "goals lie on one side in y"
    leaning = (Box((0.03, 0.0, 0.05), (0.01, 0.01, 0.05)),)
    assert planes(Task("Leaning", region, region, tube=leaning)) == [(1, 0.6)]


def _model(env: Any, **policy_kwargs: Any) -> HerDDPG:
    return HerDDPG("MultiInputPolicy", env, seed=0, policy_kwargs=policy_kwargs)


def test_the_policy_acts_in_a_mirrored_state_as_in_a_mirror(tmp_path: Path) -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 4, seed=0)
    model = _model(env, mirrors="auto", net_arch=[16])
    model.policy.set_moments(th.full((28,), 0.7), th.full((28,), 0.2))
    obs = env.reset()
    played, _ = model.predict(obs, deterministic=True)
    for mirror in env.mirrors:  # one plane at a time, whatever side each goal is on
        seen, goal = mirror.observation(obs["observation"]), mirror.goal(obs["desired_goal"])
        there = {**obs, "observation": seen, "desired_goal": goal}
        mirrored, _ = model.predict(there, deterministic=True)
        np.testing.assert_allclose(mirrored, mirror.action(played), atol=1e-5)
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

    def keep(chunk: Any, actions: th.Tensor, *rest: Any) -> th.Tensor:
        seen.append((chunk, actions))
        return run(chunk, actions, *rest)

    monkeypatch.setattr(model._updates, "run", keep)
    sampled: list[Any] = []
    sample = model._sample

    def keep_sample(*args: Any) -> Any:
        sampled.append(sample(*args))
        return sampled[-1]

    monkeypatch.setattr(model, "_sample", keep_sample)
    model.learn(20)
    (chunk, actions), data = seen[0], sampled[0][0]
    folding = Folding(model.policy.mirrors, 25, 4)
    observation, goal = folding.states(
        data.observations["observation"], data.observations["desired_goal"]
    )
    extractor = model.actor.features_extractor
    inputs = (th.cat([observation, goal], 1) - extractor.mean) / extractor.std
    np.testing.assert_allclose(chunk.features, inputs.clamp(-5, 5), atol=1e-6)
    assert th.equal(chunk.actions, data.actions), "auxiliary rewards see what was done"
    assert th.equal(actions, folding.actions(data.actions, data.observations["desired_goal"]))
    assert (actions != data.actions).any(dim=0).tolist() == [True, True, False, False]
    inputs = th.cat([model.actor.features_extractor(data.observations), actions], 1)
    q = model.critic.q_networks[0](inputs)
    assert th.equal(q, model.critic(data.observations, data.actions)[0])
    assert th.equal(q, model.critic.q1_forward(data.observations, data.actions))
    assert goal[:, 0].min() >= 1.3 - 1e-6 and goal[:, 1].min() >= 0.75 - 1e-6
    # Inputs are standardised as the networks see them.
    assert extractor.mean[25] > 1.3 and extractor.mean[26] > 0.75


def test_swapped_entries_may_change_their_sign_too() -> None:
    both = Mirror(0, 0.0, signs=(0, 1), swaps=((0, 1),))
    np.testing.assert_array_equal(both.observation(np.array([1.0, 2.0, 3.0])), [-2.0, -1.0, 3.0])
    assert both == as_mirrors([both.plain()])[0]


def test_auto_finds_none_where_the_environment_names_none() -> None:
    assert resolved_mirrors("auto", None) == []
    assert resolved_mirrors(None, None) == []
    assert resolved_mirrors("auto", make_vec("FetchReach-v4", 1)) == []
    assert resolved_mirrors([{"axis": 1, "at": 0.5}], None) == [Mirror(1, 0.5)]
    env = gym.make("FollowObject/PushMiddleGap-v0")
    assert [mirror.axis for mirror in env.get_wrapper_attr("mirrors")] == [0]


@pytest.mark.parametrize("env_id", ["FetchPush-v4", "gymnasium_robotics:FetchPickAndPlace-v4"])
def test_the_same_robot_of_others_has_the_same_planes(env_id: str) -> None:
    own = [mirror.plain() for mirror in FetchEnv("PnPSimpleV1").mirrors]
    found = resolved_mirrors("auto", make_vec(env_id, 1))
    assert [mirror.plain() for mirror in found] == own
    changed = DummyVecEnv([lambda: Longer(gym.make(env_id))])
    assert resolved_mirrors("auto", changed) == []
    assert (
        run_config(env_id, method="rnd").settings["algorithm"]["policy_kwargs"]["mirrors"] == "auto"
    )


class Longer(gym.ObservationWrapper):
    """An environment whose observations have an entry more."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        box = gym.spaces.Box(-np.inf, np.inf, (26,))
        self.observation_space = gym.spaces.Dict(
            {**env.observation_space.spaces, "observation": box}
        )

    def observation(self, observation: Any) -> Any:
        return {**observation, "observation": np.append(observation["observation"], 0.0)}


@pytest.mark.parametrize("held", [3, Mirror(0, 0.0), True, {"axis": 0, "at": 0.0}, np.zeros(2)])
def test_what_an_environment_holds_instead_is_said(held: Any) -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 1, seed=0)
    env.get_attr = lambda name, indices=None: [held]  # type: ignore[method-assign, misc]
    with pytest.raises(ValueError, match=r"attribute mirrors: mirrors are a list.*mirrors=null"):
        resolved_mirrors("auto", env)


def test_policies_say_where_planes_do_not_fit(tmp_path: Path) -> None:
    both = FetchVecEnv("FollowObject/PnPSimpleV2-v0", 1, seed=0)
    one = FetchVecEnv("FollowObject/PushSideGap-v0", 1, seed=0)
    model = _model(both, mirrors="auto", net_arch=[8])
    with pytest.warns(UserWarning, match=r"across axis \[1\]"):
        model.set_env(one)
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match=r"across axis \[1\]"):
        HerDDPG.load(tmp_path / "model", env=one)
    state = model.training_state()
    with pytest.raises(ValueError, match="trained with the mirrors"):
        _model(one, mirrors="auto", net_arch=[8]).load_training_state(state)


def test_actions_with_bounds_of_two_kinds_have_no_mirror_image() -> None:
    box, action = gym.spaces.Box(-1.0, 1.0, (3,)), gym.spaces.Box(0.0, 1.0, (2,))
    spaces = gym.spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
    with pytest.raises(ValueError, match="changes its sign"):
        HerPolicy(spaces, action, lambda _: 1e-3, mirrors=[Mirror(0, 0.0, actions=(1,))])
    with pytest.raises(ValueError, match="HerDDPG"):
        HerPolicy(spaces, action, lambda _: 1e-3, mirrors="auto")  # type: ignore[arg-type]


def test_an_extractor_pickled_before_there_were_mirrors_has_none() -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 1, seed=0)
    extractor = NormalizedGoalExtractor(env.observation_space)
    state = {name: value for name, value in vars(extractor).items() if name != "folding"}
    old = NormalizedGoalExtractor.__new__(NormalizedGoalExtractor)
    old.__setstate__(state)
    obs = {key: th.as_tensor(value) for key, value in env.reset().items()}
    assert th.equal(old(obs), extractor(obs))


def test_sldr_refuses_an_object_with_mirrors_before_it_learns() -> None:
    fold = {"object_algorithm.policy_kwargs.mirrors": [{"axis": 0, "at": 1.3}]}
    config = run_config("FollowObject/PnPShelf-v0", method="fo-sldr", overrides=fold)
    with pytest.raises(ValueError, match="without mirrors"):
        bare_run("FollowObject/PnPShelf-v0", **config.settings).check()


class MirroredArm(arm_and_wall.ArmAndWall):
    """The tutorial's arm, with planes that somebody might name."""

    mirrors = ({"axis": 1, "at": 0.0, "positions": [1, 4], "actions": [0]},)


gym.register("MirroredArm-v0", MirroredArm, max_episode_steps=5)


@pytest.mark.parametrize("n_threads", [1, 2])
def test_others_environments_name_their_planes(n_threads: int) -> None:
    env = robot_vec_env("MirroredArm-v0", 2, n_threads)
    model = _model(env, mirrors="auto", net_arch=[8])
    assert [mirror.axis for mirror in model.policy.mirrors] == [1]
    env.close()


def test_mirrors_for_other_goals_are_refused() -> None:
    box = gym.spaces.Box(-1.0, 1.0, (2,))
    spaces = gym.spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
    with pytest.raises(ValueError, match="positions"):
        HerPolicy(spaces, box, lambda _: 1e-3, mirrors=[{"axis": 0, "at": 0.0}])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("left", "mirrors are a list"),
        ([1], "mapping with axis and at"),
        ([{"at": 0.0}], "mapping with axis and at"),
        ([{"axis": 0, "at": 0.0, "x": 1}], "has no 'x'"),
        ([{"axis": 3, "at": 0.0}], "axis"),
    ],
)
def test_what_is_no_list_of_mirrors_is_refused(given: Any, said: str) -> None:
    env = FetchVecEnv("FollowObject/PnPSimpleV1-v0", 1, seed=0)
    with pytest.raises(ValueError, match=f"^policy_kwargs: mirrors: .*{said}"):
        _model(env, mirrors=given)
