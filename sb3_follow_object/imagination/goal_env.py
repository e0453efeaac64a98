"""What an environment must have so that imagined goals can be shown in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecFrameStack, is_vecenv_wrapped

from ..common.answers import check_shape
from ..envs import IDS
from ..envs.goal_envs import SUCCESS_METHODS, missing_goal_keys
from ..envs.goal_space import GoalSpace, followed_space
from .curriculum import Curriculum
from .goal_predictor import GoalPredictor

Observation = dict[str, np.ndarray]

LAST = "last_observation"  # in an info that ends an episode: its last observation, as it was
GOES_ON = "goes_on"  # in an info: the next step is for another goal than this one was
STREAM = 0x60A1  # parts the goals' random numbers from those of the environment's own seed


def check_horizons(predictor: GoalPredictor, curriculum: Curriculum) -> None:
    """Raise a ValueError unless both have the same T."""
    if predictor.horizon != curriculum.horizon:
        raise ValueError(
            f"The predictor imagines {predictor.horizon} steps, "
            f"but the curriculum has horizon {curriculum.horizon}: give "
            f"Curriculum({predictor.horizon}), or an F_phi learned in episodes of "
            f"{curriculum.horizon} steps (register_task makes a task of that horizon)."
        )


def check_made_for(predictor: GoalPredictor, spec: EnvSpec | None) -> None:
    """Refuse an F_phi of one task of this package for another of them.

    Args:
        predictor: F_phi; what is not of the package may be fitted to anybody's paths.
        spec: of the environment, where it has one.
    """
    if spec is None or spec.id == predictor.env_id:
        return
    if spec.id in IDS and predictor.env_id in IDS:
        raise ValueError(
            f"The predictor was made for env_id {predictor.env_id!r}, not for {spec.id!r}: fit one "
            "for that task."
        )


def checked_goals(
    space: spaces.Space, has: Callable[[str], bool]
) -> tuple[GoalSpace, np.dtype[Any]]:
    """Refuse what cannot be wrapped; return the space of goals and their dtype."""
    missing = missing_goal_keys(space)
    if missing:
        raise ValueError(
            "Imagined goals need an environment with Dict goal observations, "
            f"this one lacks {missing}."
        )
    goals = cast(spaces.Dict, space)["desired_goal"]
    assert goals.dtype is not None
    found = followed_space(goals.shape)
    if not has("compute_reward"):
        raise ValueError(
            "Imagined goals need an environment with compute_reward(achieved, desired, info), "
            "this one has none."
        )
    return found, goals.dtype


def check_reaches_outside(reaches: bool) -> None:
    """Refuse an environment inside of which reaching is: it would reach for unseen goals."""
    if reaches:
        raise ValueError(
            "imagined goals go inside of reaching first: put ReachFirstVecEnv or ReachFirstWrapper "
            "around ImaginedGoalVecEnv or ImaginedGoalWrapper, not inside it"
        )


def check_imagines_once(imagines: bool) -> None:
    """Refuse an environment that shows imagined goals already: they are not the task's own."""
    if imagines:
        raise ValueError(
            "the environment imagines goals already: leave one of ImaginedGoalWrapper (rl_zoo3's "
            "env_wrapper) and ImaginedGoalVecEnv out"
        )


def check_unstacked(env: Any) -> None:
    """Raise a ValueError for an environment in VecFrameStack."""
    if is_vecenv_wrapped(env, VecFrameStack):
        raise ValueError(
            "VecFrameStack (rl_zoo3's frame_stack) stacks goals too, for which the environment "
            "has no reward; leave it out"
        )


def terminal_observation(info: dict[str, Any]) -> Observation:
    """Return the observation that an episode ended with.

    Raises:
        ValueError: the vectorised environment does not tell it.
    """
    last = info.get("terminal_observation")
    if not isinstance(last, dict):
        raise ValueError(
            "the vectorised environment's info has no 'terminal_observation' at the end of an "
            f"episode, but {last!r}; it must hold the last observation, as a dict"
        )
    return last


def with_terminal_observations(
    obs: Observation, dones: np.ndarray, infos: list[dict[str, Any]]
) -> Observation:
    """Return the observations that the step led to, undoing the automatic reset.

    Args:
        obs: observation of each copy after the step, of a new episode where `dones`.
        dones: (n_envs,) bool.
        infos: one dict a copy, with `terminal_observation` where done.
    """
    if not dones.any():
        return obs
    obs = {key: value.copy() for key, value in obs.items()}
    for i in np.flatnonzero(dones):
        for key, value in terminal_observation(infos[i]).items():
            check_shape(value, obs[key][i].shape, f"the terminal observation {key!r}")
            obs[key][i] = value
    return obs


def check_goal_stays(given: np.ndarray, original: np.ndarray) -> None:
    """Refuse an environment whose goal moves: imagined ones are made for that of its first step.

    Args:
        given: the environment's goals after a step, (..., 3) metres.
        original: those that its episodes began with, of the same shape.

    Raises:
        ValueError: one differs.
    """
    if not np.array_equal(np.asarray(given).astype(original.dtype, copy=False), original):
        raise ValueError(
            "Imagined goals need an environment whose goal stays the same within an episode; "
            f"this one's moved from {np.asarray(original).tolist()} to "
            f"{np.asarray(given).tolist()}."
        )


def needed_success_method(has: Callable[[str], bool]) -> str:
    """Return the name of the environment's method that judges any goal."""
    for name in SUCCESS_METHODS:
        if has(name):
            return name
    raise ValueError(
        "Imagined goals need an environment with is_success(achieved, desired), this one has none."
    )
