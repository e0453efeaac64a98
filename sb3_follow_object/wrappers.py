"""Wrappers that show each episode the goal that the curriculum wants (paper, section 4.3).

The shown goal stands in every observation, in the reward and in ``is_success``; the original one
stays in the info. So a replay buffer around a wrapper stores what the policy saw.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from .curriculum import Curriculum
from .envs import IDS, physics_id
from .goal_predictor import GoalPredictor
from .imagination import draw_goals, imagine
from .predictor_files import POSITION

MODES = ("train", "test")
SUCCESS_METHODS = ("is_success", "_is_success")  # ours, and gymnasium-robotics'
STREAM = 0x60A1  # parts the goals' random numbers from those of the environment's own seed
SHARED = ("predictor", "curriculum")  # what all copies of a vectorised environment share
AUTO = "auto"  # the predictor that `get_predictor` keeps for the environment's task

Observation = dict[str, np.ndarray]


class ImaginedGoalWrapper(gym.Wrapper[Observation, np.ndarray, Observation, np.ndarray]):
    """Show imagined goals in one gymnasium environment (paper, Algorithm 1).

    Infos carry ``original_goal`` (3,) in metres, ``imagined_level`` (0 where the original goal is
    shown) and, after each step, ``is_success`` for the shown and ``original_success`` for the
    original goal. When an episode ends is left to the environment: one that terminates on its goal
    still does so on the original one.

    A wrapper that is given a Curriculum imagines goals at once. One that is given settings shows
    original goals until a CurriculumCallback takes it up at the start of training. So the same
    YAML makes the environment that trains and those that evaluate or play.

    Args:
        env: environment with Dict goal observations, ``compute_reward`` and a success method.
        predictor: F_phi; or the folder it was saved in; or "auto", the one that ``get_predictor``
            keeps for this task. The last two are loaded when first needed.
        curriculum: its k_max is read at each reset; or keyword arguments of ``Curriculum`` besides
            the horizon.

    Attributes:
        active: whether episodes that begin show imagined goals.

    Raises:
        ValueError: the environment has no 3-D goals, rewards or success for any goal, the
            predictor and the curriculum have different horizons, or a setting is wrong.
    """

    def __init__(
        self,
        env: gym.Env,
        predictor: GoalPredictor | str | os.PathLike[str] = AUTO,
        curriculum: Curriculum | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(env)
        self._dtype = _check(env.observation_space, env.has_wrapper_attr)
        self._compute_reward = env.get_wrapper_attr("compute_reward")
        self._is_success = env.get_wrapper_attr(_success_method(env.has_wrapper_attr))
        self.active = isinstance(curriculum, Curriculum)
        self.curriculum = (
            curriculum if isinstance(curriculum, Curriculum) else _curriculum(env, curriculum)
        )
        self._predictor = predictor
        if isinstance(predictor, GoalPredictor):
            _check_horizons(predictor, self.curriculum)
        self._rng = np.random.default_rng()
        self._shown = self._original = np.zeros(POSITION, self._dtype)
        self._level = 0

    @property
    def predictor(self) -> GoalPredictor:
        """F_phi, loaded (or, with "auto", learned) when it is first asked for."""
        if not isinstance(self._predictor, GoalPredictor):
            self._predictor = _find_predictor(self._predictor, self.env)
            _check_horizons(self._predictor, self.curriculum)
        return self._predictor

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode and draw its goal."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, STREAM])
        obs, info = self.env.reset(seed=seed, options=options)
        self._original = obs["desired_goal"].copy()
        self._shown, self._level = self._original, 0
        if self.active:
            shown, level = draw_goals(
                self.predictor,
                self.curriculum,
                obs["achieved_goal"][None],
                obs["desired_goal"][None],
                self._rng,
            )
            self._shown, self._level = shown[0].astype(self._dtype), int(level[0])
        return self._relabel(obs), {**info, **self._facts()}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Step the environment; reward and success are those of the shown goal."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        achieved = obs["achieved_goal"]
        if self._level > 0:
            reward = float(self._compute_reward(achieved, self._shown, info))
        info = {
            **info,
            **self._facts(),
            "is_success": bool(self._is_success(achieved, self._shown)),
            "original_success": bool(self._is_success(achieved, self._original)),
        }
        return self._relabel(obs), float(reward), terminated, truncated, info

    def load_curriculum(self, state: dict[str, Any]) -> None:
        """Follow a curriculum that advances elsewhere (``Curriculum.state_dict``), from now on."""
        self.curriculum.load_state_dict(state)
        self.active = True

    def _relabel(self, obs: Observation) -> Observation:
        return {**obs, "desired_goal": self._shown.copy()}

    def _facts(self) -> dict[str, Any]:
        return {"original_goal": self._original.copy(), "imagined_level": self._level}


class ImaginedGoalVecEnv(VecEnvWrapper):
    """Show imagined goals in a vectorised environment (paper, Algorithm 1).

    Observations, infos and the ends of episodes are those of ``ImaginedGoalWrapper``, and
    ``terminal_observation`` carries the shown goal too. Put VecMonitor outside, so that returns
    are those of the shown goals.

    Args:
        venv: vectorised environment with Dict goal observations; ``compute_reward`` and the
            success method of its first copy must accept batches of goals.
        predictor: F_phi.
        curriculum: its k_max is read when an episode starts; share it with the test environment.
        mode: "train" draws original or imagined goals; "test" shows h_max, the imagined goal of
            level k_max, in every episode.

    Raises:
        ValueError: as ``ImaginedGoalWrapper``, or an unknown mode.
    """

    def __init__(
        self,
        venv: VecEnv,
        predictor: GoalPredictor,
        curriculum: Curriculum,
        mode: str = "train",
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"mode must be one of {list(MODES)}, got {mode!r}.")
        super().__init__(venv)
        self._dtype = _check(venv.observation_space, venv.has_attr)
        _check_horizons(predictor, curriculum)
        self._success_method = _success_method(venv.has_attr)
        self.predictor = predictor
        self.curriculum = curriculum
        self.mode = mode
        self._rng = np.random.default_rng()
        self._shown = np.zeros((venv.num_envs, POSITION), self._dtype)
        self._original = self._shown.copy()
        self._level = np.zeros(venv.num_envs, dtype=np.int64)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments and the draw of goals; takes effect at the next reset."""
        seeds = self.venv.seed(seed)
        first = seed if seed is not None else seeds[0]
        self._rng = np.random.default_rng(None if first is None else [first, STREAM])
        return seeds

    def reset(self) -> Observation:
        """Start an episode in every copy and draw the goals."""
        obs = cast(Observation, self.venv.reset())
        self._draw(np.arange(self.num_envs), obs)
        self.reset_infos = [
            {**info, **facts}
            for info, facts in zip(self.venv.reset_infos, self._facts(), strict=True)
        ]
        return self._relabel(obs)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step; rewards and success are those of the shown goals."""
        venv_obs, rewards, dones, infos = self.venv.step_wait()
        obs = cast(Observation, venv_obs)
        ended = np.flatnonzero(dones)
        achieved = np.array(obs["achieved_goal"])
        for i in ended:
            achieved[i] = infos[i]["terminal_observation"]["achieved_goal"]

        imagined = np.flatnonzero(self._level)
        if imagined.size:
            rewards = rewards.copy()
            rewards[imagined] = self._ask(
                "compute_reward",
                achieved[imagined],
                self._shown[imagined],
                [infos[i] for i in imagined],
            )
        success, original_success = (
            self._ask(
                self._success_method,
                np.concatenate([achieved, achieved]),
                np.concatenate([self._shown, self._original]),
            )
            .astype(bool)
            .reshape(2, -1)
        )
        infos = [
            {**info, **facts, "is_success": reached, "original_success": original_reached}
            for info, facts, reached, original_reached in zip(
                infos, self._facts(), success.tolist(), original_success.tolist(), strict=True
            )
        ]
        for i in ended:
            last = infos[i]["terminal_observation"]
            infos[i]["terminal_observation"] = {**last, "desired_goal": self._shown[i].copy()}
        if ended.size:
            self._draw(ended, obs)
        return self._relabel(obs), rewards, dones, infos

    def has_attr(self, attr_name: str) -> bool:
        """Whether ``get_attr`` has an answer."""
        return attr_name in SHARED or super().has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the copies; predictor and curriculum are the same for all."""
        if attr_name in SHARED:
            return [getattr(self, attr_name) for _ in self._get_indices(indices)]
        return super().get_attr(attr_name, indices)

    def get_state(self) -> dict[str, Any]:
        """Return the goals, the generator's state and, where it offers one, the inner state.

        Only with an inner state can running episodes be continued by ``set_state``; without one,
        reset after it. The curriculum, shared with others, is not part of it.
        """
        state = {
            "shown": self._shown.copy(),
            "original": self._original.copy(),
            "level": self._level.copy(),
            "rng": copy.deepcopy(self._rng.bit_generator.state),
        }
        if hasattr(self.venv, "get_state"):
            state["venv"] = self.venv.get_state()
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from ``get_state`` of a wrapper of the same size."""
        for name in ("shown", "original", "level"):
            current, saved = getattr(self, f"_{name}"), np.asarray(state[name])
            if saved.shape != current.shape:
                raise ValueError(
                    f"The state was saved for {len(saved)} environments, this one has "
                    f"{self.num_envs}."
                )
            setattr(self, f"_{name}", saved.astype(current.dtype))
        self._rng.bit_generator.state = state["rng"]
        if "venv" in state:
            self.venv.set_state(state["venv"])  # type: ignore[attr-defined]

    def _draw(self, rows: np.ndarray, obs: Observation) -> None:
        """Give the episodes that start in ``rows`` their goals."""
        start, goal = obs["achieved_goal"][rows], obs["desired_goal"][rows]
        if self.mode == "test":
            level = np.full(len(rows), self.curriculum.k_max)
            shown = imagine(self.predictor, self.curriculum, start, goal, level)
        else:
            shown, level = draw_goals(self.predictor, self.curriculum, start, goal, self._rng)
        self._shown[rows], self._original[rows], self._level[rows] = shown, goal, level

    def _ask(self, method: str, *args: Any) -> np.ndarray:
        """Return what the first copy's method says of each row of ``args``."""
        answer = np.asarray(self.venv.env_method(method, *args, indices=[0])[0])
        if answer.size != len(args[0]):
            raise ValueError(
                f"The environment's {method} must accept batches: for {len(args[0])} goals it "
                f"returned the shape {answer.shape}."
            )
        return answer.reshape(-1)

    def _relabel(self, obs: Observation) -> Observation:
        return {**obs, "desired_goal": self._shown.copy()}

    def _facts(self) -> list[dict[str, Any]]:
        """What the infos of each copy say of its episode."""
        return [
            {"original_goal": goal, "imagined_level": level}
            for goal, level in zip(self._original.copy(), self._level.tolist(), strict=True)
        ]


def imagination_of(env: VecEnv | None, asker: str) -> tuple[GoalPredictor, Curriculum]:
    """Return the predictor and the curriculum that an environment's goals come from.

    Raises:
        ValueError: the environment imagines no goals; the message begins with ``asker``.
    """
    if env is None or not env.has_attr("curriculum"):
        raise ValueError(
            f"{asker} needs an environment wrapped in ImaginedGoalVecEnv or ImaginedGoalWrapper; "
            "this one imagines no goals"
        )
    predictor = env.get_attr("predictor", indices=[0])[0]
    return predictor, env.get_attr("curriculum", indices=[0])[0]


def _find_predictor(source: str | os.PathLike[str], env: gym.Env) -> GoalPredictor:
    """Return the F_phi that "auto" or a folder means for an environment's task."""
    if env.spec is None:
        raise ValueError(
            f"predictor={str(source)!r} needs an environment made by gymnasium.make, "
            "whose id says which task it is; give a GoalPredictor."
        )
    if source == AUTO:
        # Late: learning one needs the classes that need this module.
        from .predictors import get_predictor

        return get_predictor(env.spec.id)
    physics = physics_id(env.spec.id) if env.spec.id in IDS else None
    return GoalPredictor.load(source, env_id=env.spec.id, physics=physics)


def _curriculum(env: gym.Env, settings: Mapping[str, Any] | None) -> Curriculum:
    """Return a curriculum of the environment's horizon."""
    if env.spec is None or env.spec.max_episode_steps is None:
        raise ValueError(
            "The environment does not say how long its episodes are (spec.max_episode_steps); "
            "give a Curriculum."
        )
    try:
        return Curriculum(env.spec.max_episode_steps, **(settings or {}))
    except TypeError as error:
        raise ValueError(f"The curriculum cannot have these settings: {error}.") from error


def _check_horizons(predictor: GoalPredictor, curriculum: Curriculum) -> None:
    if predictor.horizon != curriculum.horizon:
        raise ValueError(
            f"The predictor imagines {predictor.horizon} steps, "
            f"but the curriculum has horizon {curriculum.horizon}."
        )


def _check(space: spaces.Space, has: Callable[[str], bool]) -> np.dtype[Any]:
    """Refuse what cannot be wrapped; return the dtype of goals."""
    keys = set(space.spaces) if isinstance(space, spaces.Dict) else set()
    missing = {"observation", "achieved_goal", "desired_goal"} - keys
    if missing:
        raise ValueError(
            f"Imagined goals need an environment with Dict goal observations, "
            f"this one lacks {sorted(missing)}."
        )
    goals = cast(spaces.Dict, space)["desired_goal"]
    if goals.shape != (POSITION,) or goals.dtype is None:
        raise ValueError(
            f"Imagined goals are object positions of shape (3,), "
            f"this environment's goals have the shape {goals.shape}."
        )
    if not has("compute_reward"):
        raise ValueError(
            "Imagined goals need an environment with compute_reward(achieved, desired, info), "
            "this one has none."
        )
    return goals.dtype


def _success_method(has: Callable[[str], bool]) -> str:
    """Return the name of the environment's method that judges any goal."""
    for name in SUCCESS_METHODS:
        if has(name):
            return name
    raise ValueError(
        "Imagined goals need an environment with is_success(achieved, desired), this one has none."
    )
