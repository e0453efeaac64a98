"""Wrappers that reach first: where the effector is taken, what is executed, what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy
from gymnasium.wrappers import RescaleAction
from reaching import HORIZON, REACH, TASK, ReachToyEnv, StraightActor
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
)

from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.reach.vec_env import ReachFirstVecEnv
from sb3_follow_object.reach.wrapper import ReachFirstWrapper
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer
from sb3_follow_object.settings.stages import BEHIND

PUSH, PICK = "FollowObject/PushSideGap-v0", "FollowObject/PnPSimpleV1-v0"
QUIET: dict[str, Any] = {**REACH, "noise": 0.0}


class BentPredictor(toy.StraightPredictor):
    """Sees every object go along the first axis first, wherever its goal lies."""

    horizon = HORIZON

    def __init__(self) -> None:
        self.horizon = HORIZON

    def paths(self, start: np.ndarray, goal: np.ndarray, contexts: Any = None) -> np.ndarray:
        way = np.linspace(0.0, 0.5, HORIZON + 1)[None, :, None] * np.array([1.0, 0.0, 0.0])
        return np.asarray(start)[:, None] + way

    def predict(
        self, start: np.ndarray, goal: np.ndarray, k: np.ndarray, contexts: Any = None
    ) -> np.ndarray:
        return self.paths(start, goal)[np.arange(len(k)), k]


def batched(n: int = 3, share: float = 1.0, **settings: Any) -> ReachFirstVecEnv:
    env = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * n), **{**QUIET, **settings})
    env.seed(0)
    env.set_reach(StraightActor(), share)
    return env


def single(share: float = 1.0, **settings: Any) -> VecEnv:
    env = DummyVecEnv([lambda: ReachFirstWrapper(gym.make(TASK), **{**QUIET, **settings})] * 3)
    env.seed(0)
    env.env_method("set_reach", StraightActor(), share)
    return env


FACES: dict[str, Callable[..., Any]] = {"VecEnv": batched, "gymnasium": single}


def effectors(env: Any, steps: int) -> np.ndarray:
    """Where the effectors are (steps, n, 3), while the learner stands still."""
    env.reset()
    stand = np.zeros((env.num_envs, 4), np.float32)
    return np.stack([env.step(stand)[0]["observation"][:, :3] for _ in range(steps)])


@pytest.mark.parametrize("face", FACES)
def test_effector_goes_above_the_object_and_then_down_to_it(face: str) -> None:
    env = FACES[face]()
    objects = env.reset()["achieved_goal"].copy()
    env.seed(0)  # the same episode again
    way = effectors(env, HORIZON - 1)
    above = objects + np.array([0.0, 0.0, QUIET["height"]])
    to_above = np.linalg.norm(way - above, axis=2)
    to_object = np.linalg.norm(way - objects, axis=2)
    assert (to_above.min(axis=0) <= QUIET["tolerance"]).all()
    assert (to_above.argmin(axis=0) < to_object.argmin(axis=0)).all()
    assert (to_object[-1] <= QUIET["tolerance"]).all()
    assert (way[-1] == way[-2]).all(), "there the learner acts, which stands still"


@pytest.mark.parametrize("face", FACES)
def test_infos_tell_what_was_executed(face: str) -> None:
    env = FACES[face]()
    before = env.reset()["observation"][:, :3].copy()
    given = np.full((3, 4), 0.5, np.float32)
    replaced = []
    for _ in range(HORIZON - 1):
        obs, _, _, infos = env.step(given)
        executed = np.stack([info["executed_action"] for info in infos])
        moved = obs["observation"][:, :3] - before
        np.testing.assert_allclose(moved, 0.05 * executed[:, :3], atol=1e-7)
        replaced.append((executed != given).any(axis=1))
        before = obs["observation"][:, :3].copy()
    begun = np.stack(replaced)
    assert begun[0].all() and not begun[-1].any()
    # Once the learner acts it goes on to.
    assert (np.diff(begun.astype(int), axis=0) <= 0).all()


@pytest.mark.parametrize("face", FACES)
def test_entry_that_reaching_does_not_need_stays_for_an_episode(face: str) -> None:
    env, fourth = FACES[face](), []
    for _ in range(2):
        env.reset()
        infos = [env.step(np.zeros((3, 4), np.float32))[3] for _ in range(3)]
        fourth.append([[info["executed_action"][3] for info in row] for row in infos])
    np.testing.assert_array_equal(fourth[0][0], fourth[0][2])
    assert len({*fourth[0][0], *fourth[1][0]}) == 6, "each episode draws its own"


@pytest.mark.parametrize("face", FACES)
def test_nothing_reaches_without_a_policy_or_a_share(face: str) -> None:
    for env in (FACES[face](share=0.0), DummyVecEnv([lambda: ReachFirstWrapper(gym.make(TASK))])):
        env.reset()
        given = np.full((env.num_envs, 4), 0.25, np.float32)
        for _ in range(2 * HORIZON):
            infos = env.step(given)[3]
            np.testing.assert_array_equal([info["executed_action"] for info in infos], given)


@pytest.mark.parametrize("face", FACES)
def test_share_of_the_episodes_begins_with_reaching_and_all_are_counted(face: str) -> None:
    env = FACES[face](share=0.5)
    env.reset()
    for _ in range(100 * HORIZON):
        env.step(np.zeros((3, 4), np.float32))
    asked = [env.take_counts()] if face == "VecEnv" else env.env_method("take_counts")
    own, begun = np.sum(asked, axis=0)
    assert own.sum() + begun.sum() == 300
    assert 110 <= begun.sum() <= 190  # five standard deviations
    assert own[1] == 0, "a learner that stands still never comes there"
    assert begun[0] == 0
    again = [env.take_counts()] if face == "VecEnv" else env.env_method("take_counts")
    assert np.sum(again) == 0


def test_episodes_that_an_outer_wrapper_ends_are_counted() -> None:
    inner = ReachFirstWrapper(gym.make(TASK), **QUIET)
    inner.set_reach(StraightActor(), 1.0)
    env = gym.wrappers.TimeLimit(inner, HORIZON - 5)
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(HORIZON - 5):
            env.step(np.zeros(4, np.float32))
    env.reset()
    assert inner.take_counts().sum() == 4


@pytest.mark.parametrize("face", FACES)
def test_learner_that_comes_there_by_itself_is_counted(face: str) -> None:
    env = FACES[face](share=0.0)
    obs = env.reset()
    for _ in range(HORIZON):
        to_object = obs["achieved_goal"] - obs["observation"][:, :3]
        actions = np.concatenate([to_object, np.zeros((3, 1))], axis=1) / 0.05
        obs = env.step(np.clip(actions, -1.0, 1.0).astype(np.float32))[0]
    asked = [env.take_counts()] if face == "VecEnv" else env.env_method("take_counts")
    np.testing.assert_array_equal(np.sum(asked, axis=0), [[0, 3], [0, 0]])


@pytest.mark.parametrize("face", FACES)
def test_reaching_gives_up_after_its_steps(face: str) -> None:
    env = FACES[face](max_steps=2)
    way = effectors(env, 4)
    assert (way[1] != way[0]).any(axis=1).all()
    np.testing.assert_array_equal(way[2], way[1])


@pytest.mark.parametrize("face", FACES)
def test_an_effector_that_cannot_get_above_the_object_goes_to_it_after_half_its_steps(
    face: str,
) -> None:
    env = FACES[face](height=100.0, max_steps=6)
    climbed = np.diff(effectors(env, 6)[:, :, 2], axis=0)
    assert (climbed[:2] > 0.0).all() and (climbed[2:] < 0.0).all()


def imagined_batch() -> VecEnv:
    venv = DummyVecEnv([lambda: gym.make(TASK)] * 3)
    return ImaginedGoalVecEnv(venv, BentPredictor(), toy.Curriculum(HORIZON, p=1.0))


def imagined_single() -> gym.Env:
    curriculum = toy.Curriculum(HORIZON, p=1.0)
    return ImaginedGoalWrapper(gym.make(TASK), BentPredictor(), curriculum)


STANDING: dict[str, Callable[..., VecEnv]] = {
    "VecEnv": lambda **s: ReachFirstVecEnv(imagined_batch(), **s),
    "VecEnv in a monitor": lambda **s: ReachFirstVecEnv(VecMonitor(imagined_batch()), **s),
    "gymnasium in a VecEnv": lambda **s: ReachFirstVecEnv(DummyVecEnv([imagined_single] * 3), **s),
    "gymnasium": lambda **s: DummyVecEnv([lambda: ReachFirstWrapper(imagined_single(), **s)] * 3),
}


def effector_way(env: VecEnv) -> np.ndarray:
    """Where the effectors are in an episode but its last step, (steps, 3, 3)."""
    stand = np.zeros((3, 4), np.float32)
    steps: list[Any] = [env.step(stand)[0] for _ in range(HORIZON - 1)]
    return np.array([obs["observation"][:, :3] for obs in steps])


@pytest.mark.parametrize("face", STANDING)
def test_with_a_standoff_it_goes_behind_the_object_and_on_as_its_path_goes(face: str) -> None:
    env = STANDING[face](**QUIET, standoff=0.08)
    env.seed(0)
    if isinstance(env, ReachFirstVecEnv):
        env.set_reach(StraightActor(), 1.0)
    else:
        env.env_method("set_reach", StraightActor(), 1.0)
    objects = env.reset()["achieved_goal"].copy()
    way = effector_way(env)
    behind, end = objects - [0.08, 0.0, 0.0], objects + np.array([0.02, 0.0, 0.0])
    to_place = np.linalg.norm(way - behind, axis=2)
    to_end = np.linalg.norm(way - end, axis=2)
    assert (to_place.min(axis=0) <= QUIET["tolerance"]).all()
    assert (to_end[-1] <= QUIET["tolerance"]).all()
    assert (to_place.argmin(axis=0) < to_end.argmin(axis=0)).all()


def test_without_imagined_goals_it_is_behind_as_the_goal_lies() -> None:
    env = batched(standoff=0.08)
    obs = {key: value.copy() for key, value in env.reset().items()}  # type: ignore[union-attr]
    to_goal = obs["desired_goal"] - obs["achieved_goal"]
    length = np.linalg.norm(to_goal, axis=1, keepdims=True)
    place = obs["achieved_goal"] - 0.08 * to_goal / length
    end = place + np.minimum(0.1, length) * to_goal / length
    way = effector_way(env)
    assert (np.linalg.norm(way - place, axis=2).min(axis=0) <= QUIET["tolerance"]).all()
    assert (np.linalg.norm(way[-1] - end, axis=1) <= QUIET["tolerance"]).all()


def test_a_cube_on_the_table_is_pushed_some_of_its_way() -> None:
    curriculum = toy.Curriculum(HORIZON, p=1.0)
    venv = ImaginedGoalVecEnv(make_vec(PUSH, 4, 1), BentPredictor(), curriculum)
    env = ReachFirstVecEnv(venv, noise=0.0, max_steps=40)
    env.seed(0)
    env.set_reach(StraightActor(), 1.0)
    before = env.reset()["achieved_goal"].copy()  # type: ignore[call-overload]
    for _ in range(45):
        obs: Any = env.step(np.zeros((4, 4), np.float32))[0]
    moved = obs["achieved_goal"] - before
    assert (moved[:, 0] > 0.04).all() and (np.abs(moved[:, 1]) < 0.03).all()


@pytest.mark.parametrize(("env_id", "metres"), [(PUSH, BEHIND), (PICK, 0.0), (TASK, 0.0)])
def test_the_task_decides_about_the_standoff(env_id: str, metres: float) -> None:
    made = ReachFirstWrapper(gym.make(env_id))
    assert made.reach_settings().standoff == metres
    if env_id != TASK:
        assert ReachFirstVecEnv(make_vec(env_id, 1, 1)).reach_settings().standoff == metres
    assert ReachFirstWrapper(gym.make(env_id), standoff=0.01).reach_settings().standoff == 0.01


def test_reaching_spans_the_range_of_the_actions() -> None:
    """Actions in [-1, 1] of the reach policy are actions in [-0.5, 2] of the environment."""
    low, high = np.full(4, -0.5, np.float32), np.full(4, 2.0, np.float32)

    def scaled() -> gym.Env:
        return RescaleAction(gym.make(TASK), low, high)

    ways = []
    for make in (scaled, lambda: gym.make(TASK)):
        env = ReachFirstVecEnv(DummyVecEnv([make] * 3), **QUIET)
        env.seed(0)
        env.set_reach(StraightActor(), 1.0)
        env.reset()
        stand = np.zeros((3, 4), np.float32) + (0.75 if make is scaled else 0.0)
        ways.append([env.step(stand)[0]["observation"].copy() for _ in range(HORIZON - 1)])
    np.testing.assert_allclose(ways[0], ways[1], atol=1e-6)


@pytest.mark.parametrize("face", FACES)
def test_one_seed_one_way(face: str) -> None:
    ways = []
    for _ in range(2):
        env = FACES[face](share=0.5, noise=0.3)
        env.seed(5)
        ways.append(effectors(env, 3 * HORIZON))
    np.testing.assert_array_equal(ways[0], ways[1])
    env.seed(6)
    assert not np.array_equal(effectors(env, 3 * HORIZON), ways[0])


def test_goes_on_from_its_state_exactly() -> None:
    def make() -> ReachFirstVecEnv:
        env = ReachFirstVecEnv(make_vec(PUSH, 2, 1))
        env.set_reach(StraightActor(), 0.8)
        return env

    def play(env: ReachFirstVecEnv, steps: int) -> Any:
        shown = [env.step(np.zeros((2, 4), np.float32)) for _ in range(steps)]
        return [(*step, [info["executed_action"] for info in infos]) for *step, infos in shown]

    env, other = make(), make()
    env.seed(3)
    env.reset()
    play(env, 53)
    assert env.approach.reaching.any(), "the state would say too little"
    state = env.get_state()
    assert state is not None
    expected = play(env, 60)
    other.set_state(state)
    np.testing.assert_equal(play(other, 60), expected)
    np.testing.assert_array_equal(env.take_counts(), other.take_counts())


class FlatEnv(gym.Env[np.ndarray, np.ndarray]):
    observation_space = gym.spaces.Box(-1.0, 1.0, (3,))
    action_space = gym.spaces.Box(-1.0, 1.0, (4,))


class PlanarEnv(ReachToyEnv):
    """Has goals in a plane."""

    def __init__(self) -> None:
        super().__init__()
        plane = gym.spaces.Box(-1.0, 1.0, (2,))
        self.observation_space = gym.spaces.Dict(
            {**self.observation_space.spaces, "achieved_goal": plane, "desired_goal": plane}  # type: ignore[dict-item]
        )


class SwitchEnv(ReachToyEnv):
    """Has actions that are no vectors."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Discrete(4)  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("env", "settings", "sentence"),
    [
        (FlatEnv, {}, r"needs Dict goal observations; this environment lacks \['achieved_goal'"),
        (PlanarEnv, {}, r"goals have the shape \(2,\); what can be followed are positions"),
        (SwitchEnv, {}, r"needs actions in a Box; this environment's are Discrete\(4\)"),
        (ReachToyEnv, {"effector": (4, 5, 6)}, r"effector is \[4, 5, 6\].*must hold"),
        (ReachToyEnv, {"effector": (1, 2)}, "effector must be three whole numbers"),
        (ReachToyEnv, {"tolerance": 0.0}, r"tolerance is 0.0; it must lie in \(0, inf\) metres"),
        (ReachToyEnv, {"standoff": -1.0}, 'standoff must be "auto" or a number of at least 0'),
        (ReachToyEnv, {"standoff": "far"}, "or a number of at least 0, not 'far'"),
        (ReachToyEnv, {"max_steps": 0}, "max_steps is 0; it must be at least 1"),
        (ReachToyEnv, {"hight": 0.1}, "has no setting 'hight'; did you mean 'height'"),
        (ReachToyEnv, {"share": 0.3}, "has no setting 'share'; give it to ReachCallback"),
    ],
)
def test_what_cannot_be_meant_is_one_sentence(
    env: Any, settings: dict[str, Any], sentence: str
) -> None:
    makers: list[Callable[..., Any]] = [
        lambda: ReachFirstWrapper(env(), **settings),
        lambda: ReachFirstVecEnv(DummyVecEnv([env]), **settings),
    ]
    for make in makers:
        with pytest.raises(ValueError, match=sentence) as refusal:
            make()
        assert "\n" not in str(refusal.value)


def test_normalised_observations_are_refused() -> None:
    with pytest.raises(ValueError, match="put it inside VecNormalize, not around it"):
        ReachFirstVecEnv(VecNormalize(DummyVecEnv([ReachToyEnv])))


@pytest.mark.parametrize("face", FACES)
def test_actions_that_are_changed_on_their_way_to_reaching_are_refused(face: str) -> None:
    class Halved(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_async(self, actions: np.ndarray) -> None:
            self.venv.step_async(0.5 * actions)

        def step_wait(self) -> Any:
            return self.venv.step_wait()

    for env in (FACES[face](share=0.0), Halved(FACES[face](share=0.0))):
        model = DDPG(
            "MultiInputPolicy",
            env,
            replay_buffer_class=FollowObjectReplayBuffer,
            seed=0,
            train_freq=HORIZON,
            policy_kwargs={"net_arch": [8]},
        )
        if isinstance(env, Halved):
            with pytest.raises(ValueError, match="put ReachFirstWrapper outside of that wrapper"):
                model.learn(3)
        else:
            model.learn(3 * HORIZON)


def test_a_state_of_another_number_of_copies_is_refused() -> None:
    two, three = (
        ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * n), **REACH).approach
        for n in (2, 3)
    )
    with pytest.raises(ValueError, match="the saved reaching is of 2 environments, and there are"):
        three.load_state_dict(two.state_dict())
    three.load_state_dict(three.state_dict())
