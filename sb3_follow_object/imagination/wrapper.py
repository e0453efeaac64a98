"""The wrapper that shows each episode of one environment its goal (paper, section 4.3).

The shown goal stands in every observation, in the reward and in ``is_success``; the original one
stays in the info. So a replay buffer around a wrapper stores what the policy saw.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import is_wrapped

from ..any_task.context import read_context
from ..any_task.tasks import steps_of_object
from ..common.answers import check_shape, one_number
from ..common.copies import WholeCopies
from ..common.numbers import shown
from ..common.providers import provider
from ..envs import IDS, physics_id
from ..envs.goal_envs import has_method
from ..envs.robot_copies import with_face
from .curriculum import Curriculum
from .goal_env import (
    GOES_ON,
    LAST,
    STREAM,
    Observation,
    check_goal_stays,
    check_horizons,
    check_imagines_once,
    check_made_for,
    check_reaches_outside,
    checked_goals,
    needed_success_method,
)
from .goal_predictor import GoalPredictor
from .imagined_goals import ahead, draw_goals, imagine
from .predictor_files import FACTS_FILE, checked_facts

AUTO = "auto"  # the predictor that is kept for the environment's task, learned where it is not


class ImaginedGoalWrapper(
    WholeCopies, gym.Wrapper[Observation, np.ndarray, Observation, np.ndarray]
):
    """Show imagined goals in one gymnasium environment (paper, Algorithm 1).

    Infos carry ``original_goal`` (3,) in metres, ``imagined_level`` (0 where the original goal is
    shown) and, after each step, ``is_success`` for the shown and ``original_success`` for the
    original goal; ``context`` (c,), too, if F_phi sees the places of other things. With the
    curriculum's ``go_on`` a step that reaches the imagined goal may say ``goes_on``: the
    observation after it shows the original goal, which the next step is for. When an episode ends
    is left to the environment: one that terminates on its goal still does so on the original one.

    A wrapper that is given a Curriculum imagines goals at once. One that is given settings shows
    original goals until a CurriculumCallback takes it up at the start of training. So the same
    YAML makes the environment that trains and those that evaluate or play.

    Args:
        env: environment with Dict goal observations. Where gymnasium made it, what it lacks of
            ``RobotTask`` is added: judging many goals at once, success, rewards of -1 and 0.
        predictor: F_phi; or the folder it was saved in; or "auto", the one that ``get_predictor``
            keeps for this task. The last two are loaded when first needed.
        curriculum: its k_max is read at each reset; or keyword arguments of ``Curriculum`` besides
            the horizon, which is then the predictor's.

    Attributes:
        active: whether episodes that begin show imagined goals.
        mode: "train" draws original or imagined goals; "test" shows h_max, as the copies do that a
            CurriculumCallback makes for its tests.

    Raises:
        ValueError: the environment has no 3-D goals, rewards or success for any goal, or reaches
            first, the predictor and the curriculum have different horizons, or a setting is wrong.
    """

    def __init__(
        self,
        env: gym.Env,
        predictor: GoalPredictor | str | os.PathLike[str] = AUTO,
        curriculum: Curriculum | Mapping[str, Any] | None = None,
    ) -> None:
        if not isinstance(predictor, (GoalPredictor, str, os.PathLike)):
            raise ValueError(
                "predictor must be a GoalPredictor, the folder of one or 'auto', not "
                f"{shown(predictor)}"
            )
        env = with_face(env)
        check_reaches_outside(env.has_wrapper_attr("set_reach"))
        check_imagines_once(is_wrapped(env, ImaginedGoalWrapper))
        super().__init__(env)
        self._space, self._dtype = checked_goals(env.observation_space, env.has_wrapper_attr)
        self._compute_reward = env.get_wrapper_attr("compute_reward")
        judge = needed_success_method(partial(has_method, env.get_wrapper_attr))
        self._is_success = env.get_wrapper_attr(judge)
        self.active = isinstance(curriculum, Curriculum)
        self.mode = "train"
        self.curriculum = (
            curriculum
            if isinstance(curriculum, Curriculum)
            else _curriculum(env, predictor, curriculum)
        )
        self._predictor = predictor
        if isinstance(predictor, GoalPredictor):
            check_horizons(predictor, self.curriculum)
            check_made_for(predictor, env.spec)
        self._rng = np.random.default_rng()
        self._shown = self._original = np.zeros(self._space.size, self._dtype)
        self._level, self._may_go_on = 0, False
        self._start = np.zeros(self._space.size)
        self._context = np.zeros(0)  # where other things stand that F_phi sees

    @property
    def predictor(self) -> GoalPredictor:
        """F_phi, loaded (or, with "auto", learned) when it is first asked for."""
        if not isinstance(self._predictor, GoalPredictor):
            self._predictor = _find_predictor(self._predictor, self.env)
            check_horizons(self._predictor, self.curriculum)
        return self._predictor

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode and draw its goal."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, STREAM])
        obs, info = self.env.reset(seed=seed, options=options)
        for key in ("achieved_goal", "desired_goal"):
            check_shape(obs[key], (self._space.size,), f"the observation {key!r}")
        self._original = obs["desired_goal"].copy()
        self._shown, self._level, self._may_go_on = self._original, 0, False
        self._start = np.array(obs["achieved_goal"], dtype=np.float64)
        if self.active or isinstance(self._predictor, GoalPredictor):
            self._context = read_context(self.predictor.context, self.env)
        if self.active:
            shown, level = self._draw(obs["achieved_goal"][None], obs["desired_goal"][None])
            with np.errstate(under="ignore"):
                self._shown, self._level = shown[0].astype(self._dtype), int(level[0])
            if self.mode == "train":
                self._may_go_on = bool(self.curriculum.draw_going_on(1, self._rng)[0])
        return self._relabel(obs), {**info, **self._facts()}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Step the environment; reward and success are those of the shown goal."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        achieved = obs["achieved_goal"]
        check_goal_stays(obs["desired_goal"], self._original)
        asked = "the environment's step"
        if self._level > 0:
            reward = self._compute_reward(achieved, self._shown, info)
            asked = "the environment's compute_reward"
        paid = one_number(reward, asked)
        info = {
            **info,
            **self._facts(),
            "is_success": self._succeeds(achieved, self._shown),
            "original_success": self._succeeds(achieved, self._original),
        }
        ended = terminated or truncated
        if self._may_go_on and self._level > 0 and info["is_success"] and not ended:
            self._shown, self._level = self._original, 0
            info[GOES_ON] = True
        obs = self._relabel(obs)
        if ended:
            info[LAST] = obs
        return obs, paid, terminated, truncated, info

    def load_curriculum(self, state: dict[str, Any]) -> None:
        """Follow a curriculum that advances elsewhere (``Curriculum.state_dict``), from now on."""
        self.curriculum.load_state_dict(state)
        if not self.active:
            self.active = True
            self._context = read_context(self.predictor.context, self.env)

    def ahead(self, distance: float) -> np.ndarray:
        """Return where F_phi sees the object after so much of its way, (3,); metres both.

        Where no goals are imagined yet it is the original goal.
        """
        if not self.active:
            return self._original
        start, goal, contexts = self._start[None], self._original[None], self._context[None]
        return ahead(self.predictor, start, goal, distance, contexts)[0]

    def _draw(self, start: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the goal shown (1, 3) and its level (1,) in an episode that begins."""
        if self.mode == "test":
            level = np.array([self.curriculum.k_max])
            shown = imagine(
                self.predictor, self.curriculum, start, goal, level, self._context[None]
            )
            return shown, level
        return draw_goals(
            self.predictor, self.curriculum, start, goal, self._rng, self._context[None]
        )

    def _succeeds(self, achieved: np.ndarray, desired: np.ndarray) -> bool:
        return bool(one_number(self._is_success(achieved, desired), "the environment's is_success"))

    def _relabel(self, obs: Observation) -> Observation:
        return {**obs, "desired_goal": self._shown.copy()}

    def _facts(self) -> dict[str, Any]:
        facts = {"original_goal": self._original.copy(), "imagined_level": self._level}
        return {**facts, "context": self._context} if self._context.size else facts


def _find_predictor(source: str | os.PathLike[str], env: gym.Env) -> GoalPredictor:
    """Return the F_phi that "auto" or a folder means for an environment's task."""
    if env.spec is None:
        raise ValueError(
            f"predictor={str(source)!r} needs an environment made by gymnasium.make, "
            "whose id says which task it is; give a GoalPredictor."
        )
    if source == AUTO:
        found: GoalPredictor = provider("predictor", AUTO)(env.spec.id)
        return found
    # Of a task of others it may be fitted to anybody's paths, whose physics has any name.
    physics = physics_id(env.spec.id) if env.spec.id in IDS else None
    return GoalPredictor.load(source, env_id=env.spec.id, physics=physics)


def _curriculum(
    env: gym.Env,
    predictor: GoalPredictor | str | os.PathLike[str],
    settings: Mapping[str, Any] | None,
) -> Curriculum:
    """Return a curriculum of the predictor's horizon; before there is one, of the object's."""
    horizon = _horizon(predictor)
    if horizon is None:
        if env.spec is None or env.spec.max_episode_steps is None:
            raise ValueError(
                "The environment does not say how long its episodes are (spec.max_episode_steps); "
                "give a Curriculum."
            )
        horizon = steps_of_object(env.spec.id, env.spec.max_episode_steps)
    try:
        return Curriculum(horizon, **(settings or {}))
    except TypeError as error:
        raise ValueError(f"The curriculum cannot have these settings: {error}.") from error


def _horizon(predictor: GoalPredictor | str | os.PathLike[str]) -> int | None:
    """Return T of a predictor, or of the one that its folder says it holds; None, of none yet."""
    if isinstance(predictor, GoalPredictor):
        return predictor.horizon
    if predictor == AUTO or not (facts := Path(predictor) / FACTS_FILE).exists():
        return None
    return int(checked_facts(facts)["horizon"])
