"""The environment that a curriculum is tested in differs from the training's in nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy
from gymnasium.wrappers import (
    NormalizeReward,
    RescaleAction,
    StickyAction,
    TimeLimit,
    TransformReward,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.env_copies import copies_for_tests
from sb3_follow_object.envs import make_vec
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper

N = 2
PUSH = "FollowObject/PushSideGap-v0"


class TunablePoint(toy.PointEnv):
    """A point whose reward has a weight, as an argument and as an attribute."""

    def __init__(self, weight: float = 1.0) -> None:
        super().__init__()
        self.weight = weight
        self.episodes = 0
        self.config = {"steps": [1, 2]}

    def reset(self, **options: Any) -> Any:
        self.episodes += 1
        return super().reset(**options)

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return self.weight * super().compute_reward(achieved, desired, info)


gym.register("TunablePoint-v0", entry_point=TunablePoint, max_episode_steps=toy.HORIZON)
gym.register("FarPoint-v0", entry_point=f"{__name__}:TunablePoint", max_episode_steps=toy.HORIZON)


class Scaled(gym.ActionWrapper):
    """A wrapper that gymnasium knows nothing of."""

    scale = 0.5

    def action(self, action: np.ndarray) -> np.ndarray:
        return self.scale * action


class Halved(VecEnvWrapper):
    """The same of a VecEnv."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.scale = 1.0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(self.scale * actions)

    def step_wait(self) -> Any:
        return self.venv.step_wait()


def horizon_of(task: str) -> int:
    return gym.spec(task).max_episode_steps or 0


def imagined(env: gym.Env, horizon: int = toy.HORIZON) -> ImaginedGoalWrapper:
    predictor = toy.StraightPredictor()
    predictor.horizon = horizon
    return ImaginedGoalWrapper(env, predictor, toy.Curriculum(horizon, k_max=3))


def single(make: Callable[[], gym.Env]) -> VecEnv:
    return DummyVecEnv([make] * N)


def batched(**options: Any) -> ImaginedGoalVecEnv:
    horizon = horizon_of(PUSH)
    predictor = toy.StraightPredictor()
    predictor.horizon = horizon
    return ImaginedGoalVecEnv(
        make_vec(PUSH, N, 1, **options), predictor, toy.Curriculum(horizon, k_max=3)
    )


def point(wrap: Callable[[gym.Env], gym.Env] = lambda env: env, **options: Any) -> VecEnv:
    return single(lambda: imagined(wrap(gym.make("TunablePoint-v0", **options))))


def fetch(**options: Any) -> VecEnv:
    return single(lambda: imagined(gym.make(PUSH, **options), options.get("max_episode_steps", 50)))


def changed(env: Any, **attributes: Any) -> VecEnv:
    """Set attributes of the innermost environments."""
    inner = env.unwrapped
    for one in getattr(inner, "envs", [inner]):
        vars(one.unwrapped).update(attributes)
    return env


def halved(env: VecEnv) -> VecEnv:
    outer = Halved(env)
    outer.scale = 0.3  # set after it was made
    return outer


def outside(wrap: Callable[[gym.Env], gym.Env]) -> VecEnv:
    return single(lambda: wrap(imagined(gym.make("TunablePoint-v0"))))


ENVIRONMENTS: dict[str, Callable[[], VecEnv]] = {
    "bare": point,
    "sticky action inside": lambda: point(partial(StickyAction, repeat_action_probability=0.7)),
    "own wrapper inside": lambda: point(Scaled),
    "own wrapper outside": lambda: outside(Scaled),
    "time limit by hand": lambda: point(partial(TimeLimit, max_episode_steps=4)),
    "lambda in a wrapper": lambda: point(lambda env: TransformReward(env, lambda r: 3.0 * r)),
    "argument": lambda: point(weight=2.0),
    "monitor": lambda: outside(Monitor),
    "different copies": lambda: DummyVecEnv(
        [partial(lambda w: imagined(gym.make("TunablePoint-v0", weight=w)), w) for w in (1.0, 5.0)]
    ),
    "our task": fetch,
    "our task's reward set later": lambda: changed(fetch(), reward_type="dense"),
    "our task's collision": lambda: fetch(collision="full"),
    "our task's steps": lambda: fetch(max_episode_steps=7),
    "our task's actions": lambda: single(
        lambda: imagined(RescaleAction(gym.make(PUSH), np.float32(-0.1), np.float32(0.1)), 50)
    ),
    "a batch": batched,
    "a batch's reward": lambda: batched(reward_type="dense"),
    "a batch's reward set later": lambda: changed(batched(), reward_type="dense"),
    "a batch's collision": lambda: batched(collision="full"),
    "a monitored batch": lambda: VecMonitor(batched()),
    "a stacked batch": lambda: VecFrameStack(batched(), 3),
    "stacked inside": lambda: VecFrameStack(point(), 2),
    "own VecEnvWrapper": lambda: halved(point()),
}


def play(env: VecEnv, seed: int = 3, steps: int = 60) -> list[Any]:
    """All that an environment shows with h_max in every episode."""
    env.seed(seed)
    rng = np.random.default_rng(0)
    shown: list[Any] = [env.reset()]
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (N, *env.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        obs, rewards, dones, infos = env.step(actions)
        facts = [
            {key: info[key] for key in ("is_success", "original_goal", "imagined_level")}
            for info in infos
        ]
        shown += [obs, rewards, dones, facts]
    return shown


def in_test_mode(env: VecEnv) -> VecEnv:
    """Let the training's own environment show h_max."""
    layers: list[Any] = [env]
    while layers:
        layer = layers.pop()
        if isinstance(layer, ImaginedGoalVecEnv | ImaginedGoalWrapper):
            layer.mode = "test"
        elif isinstance(layer, VecEnvWrapper):
            layers.append(layer.venv)
        elif isinstance(layer, gym.Wrapper):
            layers.append(layer.env)
        else:
            layers += layer.envs
    return env


@pytest.mark.parametrize("make", ENVIRONMENTS.values(), ids=ENVIRONMENTS)
def test_tests_are_played_in_the_environment_of_the_training(make: Callable[[], VecEnv]) -> None:
    env = make()
    env.seed(0)
    env.reset()
    env.step(np.zeros((N, *env.action_space.shape), np.float32))  # type: ignore[misc]
    twin = copies_for_tests(env)
    assert twin.num_envs == N
    assert twin.observation_space == env.observation_space
    assert twin.action_space == env.action_space
    twin_shown = play(twin)
    # The test neither disturbs the training nor differs from it.
    assert env.get_attr("curriculum")[0] is twin.get_attr("curriculum")[0]
    np.testing.assert_equal(twin_shown, play(in_test_mode(env)))


def test_the_training_goes_on_as_if_nothing_had_been_copied() -> None:
    for make in (point, batched):
        alone, copied = make(), make()
        for env in (alone, copied):
            env.seed(0)
            env.reset()
        play(copies_for_tests(copied))
        actions = np.full((N, *alone.action_space.shape), 0.1, np.float32)  # type: ignore[misc]
        for _ in range(30):
            for ours, theirs in zip(alone.step(actions)[:3], copied.step(actions)[:3], strict=True):
                np.testing.assert_equal(ours, theirs)


def test_observations_are_normalised_by_the_models_own_vec_normalize() -> None:
    twin = copies_for_tests(VecNormalize(VecMonitor(batched())))
    assert type(twin) is ImaginedGoalVecEnv


def test_files_of_the_training_are_its_own(tmp_path: Path) -> None:
    env = outside(lambda one: Monitor(one, str(tmp_path / "log")))
    before = (tmp_path / "log.monitor.csv").read_text()
    twin = copies_for_tests(VecMonitor(env, str(tmp_path / "vec")))
    play(twin)
    assert (tmp_path / "log.monitor.csv").read_text() == before
    twin.close()


def test_windows_are_not_opened_twice() -> None:
    env = fetch(render_mode="human")
    assert env.get_attr("render_mode") == ["human"] * N
    assert copies_for_tests(env).get_attr("render_mode") == [None] * N


class HoldsAFile(gym.Wrapper):
    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.file = open(__file__)  # noqa: SIM115


REFUSED: dict[str, tuple[Callable[[], VecEnv], str]] = {
    "set later": (lambda: changed(point(), weight=2.0), "its weight, 2.0, was set after"),
    "set later, deep": (
        lambda: changed(point(), config={"steps": [1, 3]}),
        r"its config, .* was set after it was made",
    ),
    "added later": (lambda: changed(point(), colour="red"), "its colour, 'red', was set after"),
    "holds a file": (lambda: point(HoldsAFile), "cannot copy HoldsAFile .*TextIOWrapper"),
    "own statistics": (lambda: outside(NormalizeReward), "keeps statistics of its own"),
    "not made": (
        lambda: single(lambda: imagined(TunablePoint())),
        r"cannot copy TunablePoint .*gymnasium.make did not make it",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_copied_is_named_with_the_way_out(name: str) -> None:
    make, sentence = REFUSED[name]
    env = make()
    with pytest.raises(
        ValueError, match=r"CurriculumCallback cannot copy .*give it a test_env"
    ) as e:
        copies_for_tests(env)
    assert e.match(sentence) and "\n" not in str(e.value)
    env.close()


def remote(wrap: Callable[[gym.Env], gym.Env], **changes: Any) -> gym.Env:
    env = gym.make("FarPoint-v0", weight=2.0)
    vars(env.unwrapped).update(changes)
    return Monitor(imagined(wrap(env)))


STICKY = partial(StickyAction, repeat_action_probability=0.7)


def test_environments_of_other_processes_are_made_again_alike() -> None:
    make = partial(remote, STICKY)
    env = SubprocVecEnv([make] * N, start_method="fork")
    try:
        twin = copies_for_tests(env)
        np.testing.assert_equal(play(twin), play(in_test_mode(DummyVecEnv([make] * N))))
    finally:
        env.close()


@pytest.mark.parametrize(
    ("wrap", "changes", "sentence"),
    [
        (STICKY, {"weight": 3.0}, "its weight, 3.0, was set after it was made"),
        (Scaled, {}, "cannot copy Scaled .*no gymnasium.utils.RecordConstructorArgs"),
    ],
)
def test_what_other_processes_do_not_tell_is_refused(
    wrap: Any, changes: dict[str, Any], sentence: str
) -> None:
    env = SubprocVecEnv([partial(remote, wrap, **changes)], start_method="fork")
    try:
        with pytest.raises(ValueError, match=f"{sentence}.*give it a test_env"):
            copies_for_tests(env)
    finally:
        env.close()


def test_a_test_env_may_be_wrapped_as_the_training_is() -> None:
    env = batched()
    test_env = ImaginedGoalVecEnv(make_vec(PUSH, N, 1), env.predictor, env.curriculum, "test")
    callback = CurriculumCallback(VecFrameStack(test_env, 3))
    assert callback.curriculum is env.curriculum
