"""Environments of others, shown as this package reads one: goals, success, rewards of -1 and 0."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..common.answers import one_each, one_number
from .goal_envs import check_goal_keys, has_method, missing_goal_keys, success_method
from .goal_space import POSITIONS

Judge = Callable[..., Any]
GoalOf = Callable[[gym.Env, Any], tuple[Any, Any]]
EffectorOf = Callable[[gym.Env], Any]

_GOALS = ("achieved_goal", "desired_goal")
_FAR = 10.0  # metres, farther than any goal is reached from
_OFF = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, _FAR)  # metres from a goal, to see what is paid


class RobotTask(gym.Wrapper):
    """A goal environment that says what reaching a goal is, of any environment that can tell.

    Observations are a Dict of observation, achieved_goal and desired_goal; rewards are 0 on the
    goal and -1 elsewhere; `compute_reward` and `is_success` judge any goals, in batches too, and
    the info says `is_success`. Whatever the environment has of this is asked; two functions say
    the rest.

    Args:
        env: any environment with a Box of actions.
        goal: of (env, observation) -> achieved and desired goal, (3,) metres each; None where the
            observations hold them.
        is_success: of (achieved, desired) -> whether the goal is reached; None asks the
            environment's method of that name, or else its `compute_reward`.
        object: name of the body that goals are about; None finds it.
        effector: of (env) -> position of what touches the object, (3,) metres; is told at the end
            of the observations. None where they tell it already.

    Attributes:
        shifted: whether the environment pays 1 on the goal and 0 elsewhere.
        told_effector: entries of the observation that `effector` has added; None, it adds none.

    Raises:
        ValueError: there are no goals; at the first reset, nobody says when one is reached.
    """

    def __init__(
        self,
        env: gym.Env,
        goal: GoalOf | None = None,
        is_success: Judge | None = None,
        object: str | None = None,
        effector: EffectorOf | None = None,
    ) -> None:
        super().__init__(env)
        self.followed_object = object
        self.shifted = False
        self.told_effector: tuple[int, int, int] | None = None
        self._goal = goal
        self._effector = effector
        self._given = is_success
        self._judge: Judge | None = None
        self._batches = False
        if goal is not None:
            self.observation_space = _goal_space(env)
        elif missing_goal_keys(env.observation_space):
            check_goal_keys(env.observation_space, _name(env))
        if effector is not None:
            self.observation_space = _with_effector(self.observation_space, env)
            n = spaces.flatdim(self.observation_space["observation"])
            self.told_effector = n - 3, n - 2, n - 1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode."""
        obs, info = self.env.reset(seed=seed, options=options)
        shown = self.observation(obs)
        if self._judge is None:
            self._find_judge(np.asarray(shown["desired_goal"], dtype=np.float64))
        return shown, info

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Step the environment; the reward is 0 on the goal, else -1."""
        obs, _, terminated, truncated, info = self.env.step(action)
        shown = self.observation(obs)
        success = bool(self.is_success(shown["achieved_goal"], shown["desired_goal"]))
        info = {**info, "is_success": success}
        return shown, float(success) - 1.0, terminated, truncated, info

    def observation(self, obs: Any) -> dict[str, np.ndarray]:
        """Return an observation of the environment with its goals, and with the effector."""
        shown = obs if self._goal is None else self._with_goals(obs, self._goal)
        if self._effector is None:
            return shown
        place = np.array(self._effector(self.env.unwrapped), dtype=np.float64)
        if place.shape != (POSITIONS.size,):
            raise ValueError(
                f"effector= must return a position of the shape (3,), not {place.shape}"
            )
        told = np.concatenate([shown["observation"], place])
        kind = cast(spaces.Dict, self.observation_space)["observation"].dtype
        return {**shown, "observation": told.astype(kind)}

    def _with_goals(self, obs: Any, goal: GoalOf) -> dict[str, np.ndarray]:
        goals = goal(self.env.unwrapped, obs)
        for name, value in zip(("achieved", "desired"), goals, strict=True):
            if np.shape(value) != (POSITIONS.size,):
                raise ValueError(
                    f"goal= must return two positions of the shape (3,); the {name} one has the "
                    f"shape {np.shape(value)}"
                )
        achieved, desired = (np.array(each, dtype=np.float64) for each in goals)
        return {
            "observation": np.concatenate(_parts(_without_goals(obs))),
            "achieved_goal": achieved,
            "desired_goal": desired,
        }

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Rewards (...) of achieved goals (..., 3) for desired ones; `info` is unused."""
        return np.asarray(self.is_success(achieved_goal, desired_goal), dtype=np.float32) - 1.0

    def is_success(self, achieved_goal: Any, desired_goal: Any) -> Any:
        """Whether goals (..., 3) are reached, bool (...); row by row where that is all there is."""
        achieved, desired = np.asarray(achieved_goal), np.asarray(desired_goal)
        if self._judge is None:
            self._find_judge(desired.reshape(-1, desired.shape[-1])[0])
        assert self._judge is not None
        if achieved.ndim == 1:
            return one_number(self._judge(achieved, desired), "is_success") > 0.5
        rows = achieved.reshape(-1, achieved.shape[-1]), desired.reshape(-1, desired.shape[-1])
        if self._batches:
            answer = one_each(self._judge(*rows), len(rows[0]), "is_success")
        else:
            pairs = zip(*rows, strict=True)
            answer = np.array([one_number(self._judge(a, d), "is_success") for a, d in pairs])
        return (answer > 0.5).reshape(achieved.shape[:-1])

    def _find_judge(self, desired: np.ndarray) -> None:
        """Find who says whether goals are reached, and whether of many at once."""
        judge = self._given or _success_method(self.env)
        if (
            has_method(self.env.get_wrapper_attr, "compute_reward")
            and self._goal is None
            and self._given is None
        ):
            self.shifted = pays_one(self.env, desired, _name(self.env))
        elif judge is None:
            where = "is_success" if self._goal is not None else "compute_reward or is_success"
            raise ValueError(
                f"{_name(self.env)} does not tell when a goal is reached, by {where}; say it with "
                "is_success="
            )
        if judge is None:
            judge = self._pays_most
        if not one_number(judge(desired, desired), "is_success"):
            raise ValueError(f"{_name(self.env)} says of its goal that it is not reached there")
        self._batches = _answers_batches(judge, desired)
        self._judge = judge

    def _pays_most(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """Whether the environment's reward is the one that it pays on the goal."""
        reward = self.env.get_wrapper_attr("compute_reward")(achieved, desired, {})
        return np.asarray(reward) > (0.5 if self.shifted else -0.5)


def needs_face(env: gym.Env) -> bool:
    """Whether an environment, which is reset and stepped, lacks what `RobotTask` adds."""
    if missing_goal_keys(env.observation_space) or not has_method(
        env.get_wrapper_attr, "compute_reward"
    ):
        return True
    success, reward = _success_method(env), env.get_wrapper_attr("compute_reward")
    if success is None:
        return True
    obs, _ = env.reset(seed=0)
    desired = np.asarray(obs["desired_goal"], dtype=np.float64)
    told = env.step(env.action_space.sample())[4]
    return not (
        "is_success" in told
        and _paid(env, desired, _FAR) < 0.0
        and _answers_batches(lambda a, d: reward(a, d, {}), desired)
        and _answers_batches(success, desired)
    )


def pays_one(env: gym.Env, desired: np.ndarray, who: str) -> bool:
    """Whether `compute_reward` pays 1 on a goal and 0 elsewhere, rather than 0 and -1.

    Args:
        env: has `compute_reward`.
        desired: a goal (3,).
        who: beginning of the sentence about other rewards.

    Raises:
        ValueError: it pays otherwise, on the goal or at some distance from it.
    """
    on = _paid(env, desired, 0.0)
    for off in _OFF:
        paid = _paid(env, desired, off)
        allowed = (on - 1.0,) if off == _FAR else (on, on - 1.0)
        if on not in (0.0, 1.0) or paid not in allowed:
            raise ValueError(
                f"{who} pays {on:g} on the goal and {paid:g} at {off:g} m from it; the rewards "
                "must be 0 and -1, or 1 and 0"
            )
    return on == 1.0


def _paid(env: gym.Env, desired: np.ndarray, off: float) -> float:
    """What an environment's `compute_reward` pays so far from a goal (3,), in metres."""
    achieved = desired + off / np.sqrt(np.size(desired))
    reward = env.get_wrapper_attr("compute_reward")(achieved, desired, {})
    return one_number(reward, "compute_reward") + 0.0  # no minus before a zero


def _success_method(env: gym.Env) -> Judge | None:
    name = success_method(env.get_wrapper_attr)
    method: Judge | None = None if name is None else env.get_wrapper_attr(name)
    return method


def _answers_batches(judge: Judge, desired: np.ndarray) -> bool:
    """Whether a function says of rows what it says of each alone."""
    achieved = desired + np.array([0.0, _FAR, 0.01])[:, None]
    alone = [one_number(judge(row, desired), "the judge of goals") for row in achieved]
    try:
        told = one_each(judge(achieved, np.tile(desired, (3, 1))), 3, "the judge of goals")
    except Exception:  # a function of somebody's for one goal may raise anything
        return False
    return bool(np.allclose(told.astype(float), alone, atol=1e-6))


def _goal_space(env: gym.Env) -> spaces.Dict:
    """The space of an environment's observations with goals that are positions."""
    space = env.observation_space
    shown = _without_goals(space.spaces if isinstance(space, spaces.Dict) else space)
    _check_parts(shown, env)
    size = spaces.flatdim(spaces.Dict(dict(shown)) if isinstance(shown, Mapping) else shown)
    sizes = {"observation": size, "achieved_goal": POSITIONS.size, "desired_goal": POSITIONS.size}
    return spaces.Dict(
        {key: spaces.Box(-np.inf, np.inf, (n,), np.float64) for key, n in sizes.items()}
    )


def _with_effector(space: spaces.Space, env: gym.Env) -> spaces.Dict:
    """The space of observations that end with a position."""
    keys = dict(cast(spaces.Dict, space).spaces)
    box = keys["observation"]
    if not isinstance(box, spaces.Box) or len(box.shape) != 1:
        raise ValueError(f"{_name(env)}: effector= needs observations that are a row of numbers")
    kind: Any = np.result_type(box.dtype, np.float32)
    anywhere = np.full(POSITIONS.size, np.inf, dtype=kind)
    low, high = np.append(box.low, -anywhere), np.append(box.high, anywhere)
    return spaces.Dict({**keys, "observation": spaces.Box(low, high, dtype=kind)})


def _without_goals(held: Any) -> Any:
    """What an observation, or its space, holds besides goals that `goal=` says otherwise."""
    if not isinstance(held, Mapping):
        return held
    return {name: value for name, value in held.items() if name not in _GOALS}


def _check_parts(space: Any, env: gym.Env, at: str = "") -> None:
    """Raise a ValueError where an observation holds what is no number of a measure."""
    if isinstance(space, Mapping):
        for key, part in space.items():
            _check_parts(part, env, f" at {key!r}")
    elif not isinstance(space, spaces.Box) or (space.dtype == np.uint8 and len(space.shape) > 1):
        kind = "pictures" if isinstance(space, spaces.Box) else f"a {type(space).__name__}"
        raise ValueError(
            f"{_name(env)}: its observations hold {kind}{at}, which cannot be put in a row with "
            "others' numbers; leave that out, or say it as numbers in a Box"
        )


def _parts(obs: Any) -> list[np.ndarray]:
    """The vectors that an observation is made of, in the order of their names."""
    if isinstance(obs, dict):
        return [part for name in sorted(obs) for part in _parts(obs[name])]
    return [np.asarray(obs, dtype=np.float64).ravel()]


def _name(env: gym.Env) -> str:
    """An environment's name for errors alone: its wrappers keep it once it has been asked for."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
