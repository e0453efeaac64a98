"""The shown goal is the goal everywhere: observations, rewards, success, replay buffer."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import toy
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import DDPG, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.imagined_goals import imagine
from sb3_follow_object.imagination.vec_env import ImaginedGoalVecEnv
from sb3_follow_object.imagination.wrapper import ImaginedGoalWrapper

N = 4
Steps = list[dict[str, Any]]


def vec_env(
    curriculum: Curriculum,
    mode: str = "train",
    n: int = N,
    env: Callable[[], gym.Env] = toy.PointEnv,
) -> ImaginedGoalVecEnv:
    venv = ImaginedGoalVecEnv(DummyVecEnv([env] * n), toy.StraightPredictor(), curriculum, mode)
    venv.seed(0)
    return venv


def play(venv: VecEnv, steps: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    """Play random actions; give each copy's transitions with their true next observation."""
    rng = np.random.default_rng(seed)
    obs = cast(dict[str, np.ndarray], venv.reset())
    for _ in range(steps):
        actions = rng.uniform(-1, 1, (venv.num_envs, *venv.action_space.shape)).astype(np.float32)
        new_obs, rewards, dones, infos = venv.step(actions)
        new_obs = cast(dict[str, np.ndarray], new_obs)
        for i in range(venv.num_envs):
            if dones[i]:
                next_obs = infos[i]["terminal_observation"]
            else:
                next_obs = {key: value[i] for key, value in new_obs.items()}
            yield {
                "copy": i,
                "obs": {key: value[i].copy() for key, value in obs.items()},
                "next_obs": next_obs,
                "reward": rewards[i],
                "done": dones[i],
                "info": infos[i],
            }
        obs = new_obs


def episodes(venv: VecEnv, steps: int) -> list[Steps]:
    """Return the finished episodes, in the order of their ends."""
    running: list[Steps] = [[] for _ in range(venv.num_envs)]
    finished: list[Steps] = []
    for step in play(venv, steps):
        running[step["copy"]].append(step)
        if step["done"]:
            finished.append(running[step["copy"]])
            running[step["copy"]] = []
    return finished


def expected_goal(curriculum: Curriculum, first: dict[str, Any]) -> np.ndarray:
    info = first["info"]
    if info["imagined_level"] == 0:
        return info["original_goal"]
    return imagine(
        toy.StraightPredictor(),
        curriculum,
        first["obs"]["achieved_goal"][None],
        info["original_goal"][None],
        np.array([info["imagined_level"]]),
    )[0]


def check_transitions(curriculum: Curriculum, finished: list[Steps]) -> None:
    """One goal an episode, which obs, next_obs, reward and success all mean."""
    judge = toy.PointEnv()
    for episode in finished:
        shown = episode[0]["obs"]["desired_goal"]
        np.testing.assert_allclose(shown, expected_goal(curriculum, episode[0]), atol=1e-6)
        for step in episode:
            info, achieved = step["info"], step["next_obs"]["achieved_goal"]
            np.testing.assert_array_equal(step["obs"]["desired_goal"], shown)
            np.testing.assert_array_equal(step["next_obs"]["desired_goal"], shown)
            np.testing.assert_array_equal(
                info["original_goal"], episode[0]["info"]["original_goal"]
            )
            assert info["imagined_level"] == episode[0]["info"]["imagined_level"]
            assert info["is_success"] == bool(judge.is_success(achieved, shown))
            assert step["reward"] == float(judge.compute_reward(achieved, shown, {}))
            assert info["original_success"] == bool(
                judge.is_success(achieved, info["original_goal"])
            )


@pytest.mark.parametrize("levels", ["time", "path"])
def test_the_shown_goal_is_the_goal_of_the_whole_episode(levels: str) -> None:
    curriculum = toy.curriculum(k_max=3, levels=levels, p=0.3)
    finished = episodes(vec_env(curriculum), 200)
    assert len(finished) == 80
    check_transitions(curriculum, finished)
    levels_seen = {episode[0]["info"]["imagined_level"] for episode in finished}
    assert levels_seen == {0, 1, 2, 3}
    steps = [step for episode in finished for step in episode]
    # The test would say nothing if both goals were always reached or missed together.
    assert any(step["info"]["is_success"] != step["info"]["original_success"] for step in steps)


def test_original_goals_come_from_the_environment() -> None:
    finished = episodes(vec_env(toy.curriculum()), 50)
    bare = DummyVecEnv([toy.PointEnv] * N)
    bare.seed(0)
    goals = [episode[0]["info"]["original_goal"] for episode in finished]
    theirs = [episode[0]["obs"]["desired_goal"] for episode in episodes(bare, 50)]
    np.testing.assert_array_equal(goals, theirs)


def test_one_coin_an_episode_with_probability_p() -> None:
    curriculum = toy.curriculum(k_max=5, p=0.3)
    finished = episodes(vec_env(curriculum, n=40), 500)
    levels = np.array([episode[0]["info"]["imagined_level"] for episode in finished])
    assert len(levels) == 2000
    shares = np.bincount(levels) / len(levels)
    np.testing.assert_allclose(shares, [0.3, 0.14, 0.14, 0.14, 0.14, 0.14], atol=0.04)
    # Copies that start together draw apart: within a round the coins differ as if independent.
    coins = (levels.reshape(-1, 40) == 0).mean(axis=1)
    assert 0.04 < coins.std() < 0.11  # sqrt(0.3 * 0.7 / 40) = 0.072


def test_the_goal_outlives_a_change_of_k_max() -> None:
    curriculum = toy.curriculum(k_max=2, p=0.0)
    venv = vec_env(curriculum)
    obs = cast(dict[str, np.ndarray], venv.reset())
    for step in range(toy.HORIZON - 1):
        curriculum.k_max = min(2 + step, 9)
        new_obs, *_ = venv.step(np.zeros((N, 3), np.float32))
        np.testing.assert_array_equal(
            cast(dict[str, np.ndarray], new_obs)["desired_goal"], obs["desired_goal"]
        )
    *_, infos = venv.step(np.zeros((N, 3), np.float32))
    assert all(1 <= info["imagined_level"] <= 2 for info in infos)
    assert max(episode[0]["info"]["imagined_level"] for episode in episodes(venv, 100)) == 9


def test_a_finished_curriculum_changes_nothing_but_the_info() -> None:
    bare = DummyVecEnv([toy.PointEnv] * N)
    bare.seed(0)
    for ours, theirs in zip(
        play(vec_env(toy.curriculum(k_max=10, p=0.0)), 30), play(bare, 30), strict=True
    ):
        assert ours["info"]["imagined_level"] == 0
        assert ours["info"]["is_success"] == ours["info"]["original_success"]
        for part in ("obs", "next_obs"):
            for key in ours[part]:
                np.testing.assert_array_equal(ours[part][key], theirs[part][key])
        assert ours["reward"] == theirs["reward"]


def test_mode_test_shows_h_max_in_every_episode() -> None:
    curriculum = toy.curriculum(k_max=4, p=1.0)
    finished = episodes(vec_env(curriculum, "test"), 50)
    assert {episode[0]["info"]["imagined_level"] for episode in finished} == {4}
    check_transitions(curriculum, finished)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_goals_keep_the_environments_dtype(dtype: str) -> None:
    venv = vec_env(toy.curriculum(), env=lambda: toy.PointEnv(dtype))
    for step in play(venv, 12):
        assert step["obs"]["desired_goal"].dtype == np.dtype(dtype)
        assert step["next_obs"]["desired_goal"].dtype == np.dtype(dtype)


def test_arrays_are_not_shared_between_steps() -> None:
    venv = vec_env(toy.curriculum())
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    for step in play(venv, 25):
        for array in (step["next_obs"]["desired_goal"], step["info"]["original_goal"]):
            seen.append((array, array.copy()))
    for array, copied in seen:
        np.testing.assert_array_equal(array, copied)


def test_seeds_decide_everything() -> None:
    def goals(seed: int) -> np.ndarray:
        venv = vec_env(toy.curriculum())
        venv.seed(seed)
        return np.array([step["obs"]["desired_goal"] for step in play(venv, 40)])

    np.testing.assert_array_equal(goals(1), goals(1))
    assert not np.array_equal(goals(1), goals(2))


def test_a_state_continues_the_same_draws() -> None:
    class StatefulVecEnv(DummyVecEnv):
        def get_state(self) -> bytes:
            return pickle.dumps(self.envs)

        def set_state(self, state: bytes) -> None:
            self.envs = pickle.loads(state)

    def make() -> ImaginedGoalVecEnv:
        inner = StatefulVecEnv([toy.PointEnv] * N)
        venv = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), toy.curriculum())
        venv.seed(0)
        return venv

    def go_on(venv: ImaginedGoalVecEnv) -> list[Any]:
        results = [venv.step(np.full((N, 3), 0.5, np.float32)) for _ in range(25)]
        return [(obs["desired_goal"], rewards) for obs, rewards, *_ in results]  # type: ignore[call-overload,index]

    first, second = make(), make()
    first.reset()
    for _ in range(7):
        first.step(np.zeros((N, 3), np.float32))
    state = first.get_state()
    expected = go_on(first)
    second.reset()
    second.set_state(state)
    for ours, theirs in zip(go_on(second), expected, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])
    with pytest.raises(ValueError, match="saved for 4 environments"):
        vec_env(toy.curriculum(), n=3).set_state(state)


def test_subprocesses() -> None:
    curriculum = toy.curriculum(k_max=3)
    inner = SubprocVecEnv([toy.PointEnv] * 2)
    venv = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), curriculum)
    venv.seed(0)
    try:
        check_transitions(curriculum, episodes(venv, 40))
    finally:
        venv.close()


def test_a_monitor_outside_counts_the_shown_rewards() -> None:
    venv = VecMonitor(vec_env(toy.curriculum(p=0.0)))
    for episode in episodes(venv, 20):
        returns = sum(step["reward"] for step in episode)
        assert episode[-1]["info"]["episode"]["r"] == pytest.approx(returns)


# One gymnasium environment


def single(curriculum: Curriculum, seed: int = 0) -> ImaginedGoalWrapper:
    env = ImaginedGoalWrapper(toy.PointEnv(), toy.StraightPredictor(), curriculum)
    env.reset(seed=seed)
    return env


def test_the_gymnasium_wrapper_shows_goals_in_the_same_way() -> None:
    curriculum = toy.curriculum(k_max=3, p=0.3)
    venv = DummyVecEnv([lambda: single(curriculum)] * 2)
    finished = episodes(venv, 200)
    check_transitions(curriculum, finished)
    levels = {episode[0]["info"]["imagined_level"] for episode in finished}
    assert levels == {0, 1, 2, 3}


def test_the_gymnasium_wrapper_is_a_valid_environment() -> None:
    check_env(single(toy.curriculum()), skip_render_check=True)


def test_the_gymnasium_wrapper_follows_its_seed() -> None:
    envs = [single(toy.curriculum()), single(toy.curriculum())]
    first, second = ([env.reset(seed=s)[0]["desired_goal"] for s in range(20)] for env in envs)
    np.testing.assert_array_equal(first, second)
    obs, info = envs[0].reset(seed=3)
    assert info["imagined_level"] in (0, 1, 2)
    np.testing.assert_array_equal(
        info["original_goal"], toy.PointEnv().reset(seed=3)[0]["desired_goal"]
    )
    assert obs["desired_goal"].shape == (3,)


def test_a_fetch_task_of_gymnasium_robotics() -> None:
    gymnasium_robotics = pytest.importorskip("gymnasium_robotics")
    gym.register_envs(gymnasium_robotics)
    curriculum = toy.curriculum(p=0.0, k_max=3)

    def make() -> gym.Env:
        return gym.make("FetchPush-v4", max_episode_steps=toy.HORIZON)

    one = ImaginedGoalWrapper(make(), toy.StraightPredictor(), curriculum)
    many = ImaginedGoalVecEnv(DummyVecEnv([make] * 2), toy.StraightPredictor(), curriculum)
    for venv in (DummyVecEnv([lambda: one]), many):
        venv.seed(0)
        finished = episodes(venv, 11)
        assert finished
        check_transitions(curriculum, finished)
    one.close()
    many.close()


# With stock algorithms


@pytest.mark.parametrize("algorithm", [DDPG, TD3, SAC])
@pytest.mark.parametrize("outside", [True, False])
def test_stock_replay_buffers_store_the_shown_goals(algorithm: Any, outside: bool) -> None:
    curriculum = toy.curriculum(k_max=4)
    env: VecEnv = vec_env(curriculum) if outside else DummyVecEnv([lambda: single(curriculum)] * N)
    model = algorithm(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"copy_info_dict": True},
        learning_starts=2 * N * toy.HORIZON,
        buffer_size=1000,
        batch_size=16,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    )
    model.learn(5 * N * toy.HORIZON)
    buffer = model.replay_buffer
    judge = toy.PointEnv()
    assert buffer.pos == 5 * toy.HORIZON
    shown = buffer.observations["desired_goal"][: buffer.pos]
    achieved = buffer.next_observations["achieved_goal"][: buffer.pos]
    np.testing.assert_array_equal(shown, buffer.next_observations["desired_goal"][: buffer.pos])
    np.testing.assert_array_equal(
        buffer.rewards[: buffer.pos], judge.compute_reward(achieved, shown, {})
    )
    by_episode = shown.reshape(5, toy.HORIZON, N, 3)
    assert (by_episode == by_episode[:, :1]).all()
    levels = {info["imagined_level"] for row in buffer.infos[: buffer.pos] for info in row}
    assert levels == {0, 1, 2, 3, 4}
    for slot, infos in enumerate(buffer.infos[: buffer.pos]):
        for i, info in enumerate(infos):
            is_original = np.array_equal(shown[slot, i], info["original_goal"])
            assert is_original == (info["imagined_level"] == 0)


def test_attributes_that_replay_buffers_ask_for() -> None:
    curriculum = toy.curriculum()
    for venv in (vec_env(curriculum), DummyVecEnv([lambda: single(curriculum)] * N)):
        assert venv.get_attr("curriculum") == [curriculum] * N
        assert venv.get_attr("predictor", indices=[0])[0].horizon == toy.HORIZON


# Refusals


def without(*names: str) -> gym.Env:
    """A toy environment that lacks methods."""

    class Poor(toy.PointEnv):
        def __getattribute__(self, name: str) -> Any:
            if name in names:
                raise AttributeError(name)
            return super().__getattribute__(name)

    return Poor()


class FlatGoals(toy.PointEnv):
    """A toy environment whose goals are points of a plane."""

    def __init__(self) -> None:
        super().__init__()
        goal = spaces.Box(-1, 1, (2,), np.float64)
        box = cast(spaces.Dict, self.observation_space)["observation"]
        self.observation_space = spaces.Dict(
            {"observation": box, "achieved_goal": goal, "desired_goal": goal}
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), r"lacks \['achieved_goal', 'desired_goal', 'obs"),
        (FlatGoals, r"shape \(3,\), this environment's goals have the shape \(2,\)"),
        (lambda: without("compute_reward"), "compute_reward"),
        (lambda: without("is_success"), "is_success"),
    ],
)
def test_environments_without_goals_are_refused(make: Callable[[], gym.Env], message: str) -> None:
    predictor, curriculum = toy.StraightPredictor(), toy.curriculum()
    with pytest.raises(ValueError, match=message):
        ImaginedGoalWrapper(make(), predictor, curriculum)
    with pytest.raises(ValueError, match=message):
        ImaginedGoalVecEnv(DummyVecEnv([make]), predictor, curriculum)


def test_other_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="mode must be one of"):
        vec_env(toy.curriculum(), "tset")
    with pytest.raises(ValueError, match="imagines 10 steps, but the curriculum has horizon 50"):
        vec_env(Curriculum(50))


def test_rewards_that_take_no_batches_are_refused() -> None:
    class OneByOne(toy.PointEnv):
        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return np.float32(np.linalg.norm(achieved - desired) <= 0.05) - 1

    venv = vec_env(toy.curriculum(p=0.0), env=OneByOne)
    venv.reset()
    with pytest.raises(ValueError, match="compute_reward must accept batches"):
        venv.step(np.zeros((N, 3), np.float32))


# What comes from outside


class Answers(toy.PointEnv):
    """Somebody's methods, which give one goal's answer in an array of one."""

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.asarray(toy.PointEnv.is_success(self, achieved, desired))[..., None] - 1.0

    def is_success(self, achieved: Any, desired: Any) -> Any:
        return np.asarray(super().is_success(achieved, desired))[..., None]

    def step(self, action: np.ndarray) -> Any:
        self.position = self.position + toy.STEP * np.clip(action, -1, 1)
        self.steps += 1
        paid = float(toy.PointEnv.is_success(self, self.position, self.goal)) - 1.0
        return self._observe(), paid, False, self.steps >= toy.HORIZON, {}


def many(env: type[gym.Env], **options: Any) -> VecEnv:
    return vec_env(toy.curriculum(p=0.0, **options), env=env)


def one(env: type[gym.Env], **options: Any) -> VecEnv:
    curriculum = toy.curriculum(p=0.0, **options)
    wrapped = ImaginedGoalWrapper(env(), toy.StraightPredictor(), curriculum)
    return DummyVecEnv([lambda: wrapped])


@pytest.mark.parametrize("make", [many, one])
def test_answers_in_arrays_of_one_are_numbers(make: Callable[..., VecEnv]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        finished = episodes(make(Answers, k_max=5), 20)
    check_transitions(toy.curriculum(k_max=5), finished)


def returning(method: str, answer: Any) -> type[gym.Env]:
    class Odd(Answers):
        pass

    setattr(Odd, method, lambda self, *asked: answer)
    return Odd


@pytest.mark.parametrize("make", [many, one])
@pytest.mark.parametrize("method", ["compute_reward", "is_success"])
@pytest.mark.parametrize(
    "answer", [None, np.zeros(7), np.zeros((4, 2)), "yes", [1.0, [2.0]], np.nan, [np.nan] * 4]
)
def test_other_answers_are_a_sentence(
    answer: Any, method: str, make: Callable[..., VecEnv]
) -> None:
    with pytest.raises(ValueError, match=f"the environment's {method} (must|returned)"):
        episodes(make(returning(method, answer)), 2)


@pytest.mark.parametrize("make", [many, one])
@pytest.mark.parametrize("when", [3, toy.HORIZON])
def test_goals_that_move_within_an_episode_are_refused(
    when: int, make: Callable[..., VecEnv]
) -> None:
    class Moving(toy.PointEnv):
        def step(self, action: np.ndarray) -> Any:
            if self.steps == when - 1:
                self.goal = self.goal + 0.01
            return super().step(action)

    venv = make(Moving)
    assert sum(1 for _ in play(venv, when - 1)) == (when - 1) * venv.num_envs
    with pytest.raises(ValueError, match=r"goal stays the same within an episode; .* moved"):
        episodes(venv, when)


def test_observations_and_imagined_goals_of_another_shape_are_refused() -> None:
    class Flat(toy.PointEnv):
        def _observe(self) -> dict[str, np.ndarray]:
            return {**super()._observe(), "desired_goal": np.zeros((1, 3))}

    wrapped = ImaginedGoalWrapper(Flat(), toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match=r"'desired_goal' must have the shape \(3,\), not \(1, 3"):
        wrapped.reset()

    class One(toy.StraightPredictor):
        def predict(self, *asked: Any) -> np.ndarray:
            return super().predict(*asked)[:1]

    venv = ImaginedGoalVecEnv(DummyVecEnv([toy.PointEnv] * N), One(), toy.curriculum(p=0.0))
    with pytest.raises(ValueError, match=r"the predictor imagines must have the shape \(4, 3\)"):
        venv.reset()


def test_a_vectorised_environment_must_tell_how_episodes_end() -> None:
    class Forgets(DummyVecEnv):
        def step_wait(self) -> Any:
            obs, rewards, dones, infos = super().step_wait()
            for info in infos:
                info.pop("terminal_observation", None)
            return obs, rewards, dones, infos

    inner = Forgets([toy.PointEnv] * 2)
    venv = ImaginedGoalVecEnv(inner, toy.StraightPredictor(), toy.curriculum())
    with pytest.raises(ValueError, match="no 'terminal_observation' at the end of an episode"):
        episodes(venv, toy.HORIZON)
