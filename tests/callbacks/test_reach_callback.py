"""The reach policy is taught beside any learner, what it does is stored, and it fades."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, TransformObservation
from reaching import HORIZON, REACH, STEP, TASK, StraightActor, learner
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
)

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.env_copies import copies_for_tests
from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.callbacks.reach_callback import ReachCallback
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper
from sb3_follow_object.reach.policy import ReachPolicy
from sb3_follow_object.reach.vec_env import ReachFirstVecEnv
from sb3_follow_object.reach.wrapper import ReachFirstWrapper

TINY: dict[str, Any] = {"n_updates": 2, "batch_size": 16}
N = 2


class Predictor(toy.StraightPredictor):
    """The toy's straight paths in this one's horizon."""

    def __init__(self) -> None:
        self.horizon = HORIZON


def curriculum(**options: Any) -> toy.Curriculum:
    return toy.Curriculum(HORIZON, **{"p": 0.5, "k_max": 4, "threshold": 0.0, **options})


def reaching_env(scale: float | None = None) -> gym.Env:
    env: gym.Env = gym.make(TASK)
    if scale is not None:
        env = RescaleAction(env, np.full(4, -scale, np.float32), np.full(4, scale, np.float32))
    return ReachFirstWrapper(env, **REACH)


def imagining_env() -> gym.Env:
    return ReachFirstWrapper(
        ImaginedGoalWrapper(gym.make(TASK), Predictor(), curriculum()), **REACH
    )


def imagining_vec_env() -> VecEnv:
    venv = DummyVecEnv([lambda: gym.make(TASK)] * N)
    return ReachFirstVecEnv(ImaginedGoalVecEnv(venv, Predictor(), curriculum()), **REACH)


FACES: dict[str, Callable[[], VecEnv]] = {
    "DummyVecEnv": lambda: DummyVecEnv([reaching_env] * N),
    "SubprocVecEnv": lambda: SubprocVecEnv([reaching_env] * N),
    "scaled actions": lambda: DummyVecEnv([lambda: reaching_env(3.0)] * N),
    "VecEnv": lambda: ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * N), **REACH),
    "VecNormalize": lambda: VecNormalize(VecMonitor(imagining_vec_env()), norm_reward=False),
    "imagined goals": lambda: DummyVecEnv([imagining_env] * N),
}


class Logged(BaseCallback):
    """What was recorded at the end of each rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.rows.append(dict(self.logger.name_to_value))

    def column(self, name: str) -> list[float]:
        return [row[name] for row in self.rows]


@pytest.fixture
def straight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is taught, what reaches goes straight to the place."""
    monkeypatch.setattr(ReachPolicy, "actor", lambda self: StraightActor())


def check_stored_actions(buffer: Any) -> None:
    """Each stored action is what moved the effector, scaled to [-1, 1]."""
    slots = slice(0, buffer.pos)
    before, after = (
        store["observation"][slots, :, :3]
        for store in (buffer.observations, buffer.next_observations)
    )
    assert buffer.pos >= 5 * HORIZON
    np.testing.assert_allclose(after - before, STEP * buffer.actions[slots, :, :3], atol=1e-5)


# HerDDPG standardises its inputs itself and refuses VecNormalize.
PAIRS = [
    *[("DDPG", face) for face in FACES],
    *[("HerDDPG", face) for face in FACES if face not in ("VecNormalize", "SubprocVecEnv")],
    *[(name, face) for name in ("TD3", "SAC", "TQC") for face in ("VecEnv", "scaled actions")],
]


@pytest.mark.parametrize(("name", "face"), PAIRS)
def test_stored_actions_are_the_executed_ones(name: str, face: str, straight: None) -> None:
    if name == "TQC":
        pytest.importorskip("sb3_contrib")
    env = FACES[face]()
    callback = ReachCallback(share=1.0, **TINY)
    try:
        model = learner(env, name)
        model.learn(6 * N * HORIZON, callback)
    finally:
        env.close()
    check_stored_actions(model.replay_buffer)
    assert callback.success > 0.3, "the effectors did come to their objects"


@pytest.mark.parametrize("face", ["VecEnv", "DummyVecEnv"])
def test_tests_of_h_max_are_stored_as_they_were_played(face: str, straight: None) -> None:
    env = imagining_vec_env() if face == "VecEnv" else DummyVecEnv([imagining_env] * N)
    model, tests = learner(env), CurriculumCallback()
    model.learn(8 * N * HORIZON, [ReachCallback(share=1.0, **TINY), tests])
    assert tests.test_steps >= 3 * N * HORIZON
    check_stored_actions(model.replay_buffer)


@pytest.mark.parametrize("face", ["VecEnv", "DummyVecEnv", "SubprocVecEnv"])
def test_tests_of_h_max_never_reach_first(face: str) -> None:
    env: VecEnv
    if face == "VecEnv":
        env = imagining_vec_env()
        env.set_reach(StraightActor(), 1.0)  # type: ignore[attr-defined]
    else:
        env = (DummyVecEnv if face == "DummyVecEnv" else SubprocVecEnv)([imagining_env] * N)
        env.env_method("set_reach", StraightActor(), 1.0)
    try:
        assert effectors_move(env), "in training they reach"
        assert not effectors_move(copies_for_tests(env))
    finally:
        env.close()


def effectors_move(env: VecEnv) -> bool:
    """Whether the effectors move although the learner stands still."""
    before: Any = env.reset()
    for _ in range(3):
        after: Any = env.step(np.zeros((env.num_envs, 4), np.float32))[0]
    moved = np.linalg.norm((after["observation"] - before["observation"])[:, :3], axis=1)
    return bool((moved > 0.0).any())


def test_validation_in_the_same_wrappers_never_reaches_first(straight: None) -> None:
    env, eval_env = FACES["DummyVecEnv"](), FACES["DummyVecEnv"]()
    model = learner(env)
    validation = OriginalGoalEvalCallback(eval_env, 2, every_steps=3 * N * HORIZON, seed=0)
    model.learn(6 * N * HORIZON, [ReachCallback(share=1.0, **TINY), validation])
    assert validation.n_evaluations == 2
    assert not effectors_move(eval_env)


def test_what_plays_in_the_environment_after_training_gets_no_help(straight: None) -> None:
    env = FACES["VecEnv"]()
    model, callback = learner(env), ReachCallback(share=1.0, fade=False, **TINY)
    shares: list[float] = []

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            shares.append(env.approach.share)  # type: ignore[attr-defined]
            return True

    model.learn(4 * N * HORIZON, [callback, Look()])
    assert shares[-1] == 1.0, "in training they reach"
    assert not effectors_move(env)
    model.learn(2 * N * HORIZON, [callback, Look()], reset_num_timesteps=False)
    assert shares[-1] == 1.0, "and when it goes on"


def test_a_callback_is_not_taught_with_another_effector() -> None:
    model, callback = learner(FACES["VecEnv"]()), ReachCallback(**TINY)
    model.learn(N * HORIZON, callback)
    other = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * N), effector=(3, 4, 5))
    with pytest.raises(ValueError, match=r"was taught with the effector \[0, 1, 2\] .* give a new"):
        learner(other).learn(N * HORIZON, callback)


def test_a_callback_is_not_taught_with_other_observations() -> None:
    callback = ReachCallback(**TINY)
    learner(FACES["VecEnv"]()).learn(N * HORIZON, callback)

    def seen_longer() -> gym.Env:
        env = gym.make(TASK)
        inner = env.observation_space
        assert isinstance(inner, spaces.Dict)
        longer = spaces.Box(-np.inf, np.inf, (inner["observation"].shape[0] + 2,), np.float64)  # type: ignore[index]
        return TransformObservation(
            env,
            lambda obs: {**obs, "observation": np.append(obs["observation"], [0.0, 0.0])},
            spaces.Dict({**inner.spaces, "observation": longer}),
        )

    other = ReachFirstVecEnv(DummyVecEnv([seen_longer] * N), **REACH)
    with pytest.raises(ValueError, match=r"observations and actions of the shapes .* give a new"):
        learner(other).learn(N * HORIZON, callback)


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize(
    ("longer", "changes"),
    [(0, lambda told: told * 100.0 + 7.0), (1, lambda told: np.append(told, 0.5))],
    ids=["scaled", "longer"],
)
def test_a_wrapper_outside_that_changes_the_observation_is_refused(
    longer: int, changes: Callable[[np.ndarray], np.ndarray], normalised: bool
) -> None:
    def make() -> gym.Env:
        env = reaching_env()
        inner = env.observation_space
        assert isinstance(inner, spaces.Dict)
        size = inner["observation"].shape[0] + longer  # type: ignore[index]
        told = spaces.Box(-np.inf, np.inf, (size,), np.float64)
        return TransformObservation(
            env,
            lambda obs: {**obs, "observation": changes(obs["observation"])},
            spaces.Dict({**inner.spaces, "observation": told}),
        )

    env: VecEnv = DummyVecEnv([make] * N)
    model = learner(VecNormalize(env, norm_reward=False) if normalised else env, "DDPG")
    with pytest.raises(ValueError, match=r"a wrapper outside of ReachFirst.* put it inside"):
        model.learn(N * HORIZON, ReachCallback(**TINY))


def test_it_takes_what_every_callback_of_sb3_takes() -> None:
    assert ReachCallback(verbose=1).verbose == 1 and CurriculumCallback(verbose=1).verbose == 1


def test_a_refused_training_may_be_ended() -> None:
    callback = ReachCallback()
    with pytest.raises(ValueError, match="nothing reaches first"):
        learner(DummyVecEnv([lambda: gym.make(TASK)])).learn(HORIZON, callback)
    callback.on_training_end()  # as rl_zoo3 does


def test_a_training_that_was_broken_off_may_be_ended(straight: None) -> None:
    env = FACES["VecEnv"]()
    model, callback = learner(env), ReachCallback(share=1.0, fade=False, **TINY)

    class Breaks(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 3 * HORIZON:
                raise InterruptedError
            return True

    with pytest.raises(InterruptedError):
        model.learn(10**6, [callback, Breaks()])
    assert effectors_move(env)
    callback.on_training_end()
    assert not effectors_move(env)


def test_two_callbacks_of_one_state_do_not_share_it() -> None:
    model, callback = learner(FACES["VecEnv"]()), ReachCallback(**TINY)
    model.learn(4 * N * HORIZON, callback)
    assert callback.policy is not None

    def moments() -> list[np.ndarray]:
        states = callback.policy.policy.critic.optimizer.state.values()  # type: ignore[union-attr]
        return [state["exp_avg"].numpy().copy() for state in states]

    before, other = moments(), ReachCallback(**TINY)
    other.load_state_dict(callback.state_dict(), model)
    learner(FACES["VecEnv"]()).learn(2 * N * HORIZON, other)
    for then, now in zip(before, moments(), strict=True):
        np.testing.assert_array_equal(then, now)


def reports(callback: ReachCallback, *rollouts: tuple[int, int, int, int]) -> list[float]:
    """The shares after rollouts of which copies tell these counts."""
    shares = []
    for counts in rollouts:
        callback._ask = lambda method, *_, told=counts: [np.reshape(told, (2, 2))]  # type: ignore
        callback._count()
        shares.append(callback.share)
    return shares


def test_share_fades_as_the_learner_comes_there_by_itself() -> None:
    callback = ReachCallback(share=0.5)
    assert reports(callback, (8, 0, 4, 4), (8, 0, 0, 8)) == [0.5, 0.5]
    assert callback.success == pytest.approx(0.1 * 0.5 + 0.9 * 0.0 + 0.1 * (1.0 - 0.05))
    fading = reports(callback, *[(0, 8, 0, 8)] * 60)
    assert fading[0] == pytest.approx(0.45)
    assert all(later <= sooner for sooner, later in pairwise(fading))
    assert fading[-1] == 0.0 and min(share for share in fading if share) >= 0.02
    again = reports(callback, *[(8, 0, 0, 0)] * 5)
    assert again[-1] > 0.15, "a learner that no longer comes there is helped again"


def test_share_stays_without_fading_and_where_no_own_episode_ends() -> None:
    assert reports(ReachCallback(share=0.5, fade=False), *[(0, 8, 0, 8)] * 60)[-1] == 0.5
    assert reports(ReachCallback(share=1.0), *[(0, 0, 0, 16)] * 60)[-1] == 1.0


def test_faded_policy_learns_and_reaches_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    env = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * N), **REACH)
    model, callback, logged = learner(env), ReachCallback(share=1.0, **TINY), Logged()
    model.learn(2 * N * HORIZON, callback)
    assert callback.policy is not None
    assert callback.policy._n_updates == 2 * TINY["n_updates"]
    callback.own_success = 0.99  # of a learner that nearly always comes there, and goes on to
    monkeypatch.setattr(callback, "_count", lambda: None)
    model.learn(2 * N * HORIZON, [callback, logged], reset_num_timesteps=False)
    assert logged.column("reach/share") == [0.0, 0.0]
    assert callback.policy._n_updates == 2 * TINY["n_updates"] and not effectors_move(env)


def test_a_policy_that_arrives_learns_less(monkeypatch: pytest.MonkeyPatch) -> None:
    env = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * N), **REACH)
    model, callback = learner(env), ReachCallback(n_updates=8, batch_size=16)
    monkeypatch.setattr(callback, "_count", lambda: None)
    taken = []
    for success in (0.0, 0.5, 1.0):
        callback.success = success
        before = callback.policy._n_updates if callback.policy is not None else 0
        model.learn(N * HORIZON, callback, reset_num_timesteps=False)
        assert callback.policy is not None
        taken.append(callback.policy._n_updates - before)
    assert taken == [8, 4, 1]


def test_it_teaches_once_an_episode_has_ended_however_short_the_rollouts() -> None:
    env = DummyVecEnv([reaching_env])
    model = learner(env, "DDPG", train_freq=4, gradient_steps=1, learning_starts=HORIZON)
    callback, logged = ReachCallback(**TINY), Logged()
    model.learn(3 * HORIZON, [callback, logged])
    assert callback.policy._n_updates == 3 * TINY["n_updates"]  # type: ignore[union-attr]
    assert {"reach/share", "reach/success", "reach/own_success"} <= set(logged.rows[-1])


def trained(seed: int) -> Any:
    env = ReachFirstVecEnv(DummyVecEnv([lambda: gym.make(TASK)] * N), **REACH)
    model, callback = learner(env, "TD3", seed=seed), ReachCallback(**TINY)
    model.learn(6 * N * HORIZON, callback)
    return model.replay_buffer.actions[: model.replay_buffer.pos].copy()


def test_one_seed_of_the_algorithm_one_training() -> None:
    first, second, other = trained(1), trained(1), trained(2)
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"share": 1.5}, r"share is 1.5; it must lie in \[0, 1\]"),
        ({"n_updates": 0}, "n_updates is 0; it must be at least 1"),
        ({"fade": 1}, "fade must be true or false, not 1"),
        ({"shar": 0.5}, "ReachCallback has no setting 'shar'; did you mean 'share'"),
        ({"tolerance": 0.1}, "no setting 'tolerance'; give it to ReachFirstWrapper"),
    ],
)
def test_what_cannot_be_meant_is_one_sentence(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        ReachCallback(**settings)


def test_training_in_which_nothing_can_reach_is_refused() -> None:
    bare = learner(DummyVecEnv([lambda: gym.make(TASK)]))
    with pytest.raises(ValueError, match="needs an environment wrapped in ReachFirstVecEnv or"):
        bare.learn(HORIZON, ReachCallback())
    other = learner(FACES["DummyVecEnv"](), "DDPG", replay_buffer_class=HerReplayBuffer)
    with pytest.raises(ValueError, match="the model has a HerReplayBuffer: give replay_buffer_cl"):
        other.learn(HORIZON, ReachCallback())
