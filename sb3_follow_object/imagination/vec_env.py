"""Imagined goals in a vectorised environment (paper, section 4.3).

The shown goal stands in every observation, in the reward and in ``is_success``; the original one
stays in the info. So a replay buffer around a wrapper stores what the policy saw.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial
from typing import Any, cast

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from ..any_task.context import bodies_in, read_context
from ..common.answers import check_shape, one_each
from ..common.vec_env_copies import CopyableVecEnvWrapper, let_vec_envs_be_copied
from ..envs import IDS
from ..envs.robot_copies import ProcessVecEnv
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
    terminal_observation,
)
from .goal_predictor import GoalPredictor
from .imagined_goals import ahead, draw_goals, imagine

let_vec_envs_be_copied()

MODES = ("train", "test")
SHARED = ("predictor", "curriculum")  # what all copies of a vectorised environment share


class ImaginedGoalVecEnv(CopyableVecEnvWrapper):
    """Show imagined goals in a vectorised environment (paper, Algorithm 1).

    Observations, infos and the ends of episodes are those of ``ImaginedGoalWrapper``, and
    ``terminal_observation`` carries the shown goal too. Put VecMonitor outside, so that returns
    are those of the shown goals.

    It imagines from its first reset, as ``ImaginedGoalWrapper`` does that is given a Curriculum.

    Args:
        venv: vectorised environment with Dict goal observations; ``compute_reward`` and the
            success method of its first copy must accept batches of goals.
        predictor: F_phi.
        curriculum: its k_max is read when an episode starts; share it with the test environment.
        mode: "train" draws original or imagined goals; "test" shows h_max, the imagined goal of
            level k_max, in every episode.

    Raises:
        ValueError: as ``ImaginedGoalWrapper``, an unknown mode, or what is no GoalPredictor or
            Curriculum.
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
        if is_vecenv_wrapped(venv, VecNormalize):
            raise ValueError(
                "ImaginedGoalVecEnv needs goals in metres: put it inside VecNormalize, not around "
                "it"
            )
        if not isinstance(venv, VecEnv):
            raise ValueError(
                f"ImaginedGoalVecEnv takes a VecEnv, not {type(venv).__name__}; around a single "
                "environment put ImaginedGoalWrapper"
            )
        if not isinstance(predictor, GoalPredictor) or not isinstance(curriculum, Curriculum):
            raise ValueError(
                "ImaginedGoalVecEnv takes a GoalPredictor (get_predictor makes one) and a "
                f"Curriculum, not {type(predictor).__name__} and {type(curriculum).__name__}"
            )
        check_reaches_outside(hasattr(venv, "set_reach") or venv.has_attr("set_reach"))
        check_imagines_once(curriculum_of(venv) is not None)
        super().__init__(venv)
        self._space, self._dtype = checked_goals(venv.observation_space, venv.has_attr)
        check_horizons(predictor, curriculum)
        # Somebody's spec may not go from one process to another; that of ours does.
        if predictor.env_id in IDS and venv.has_attr("spec"):
            check_made_for(predictor, venv.get_attr("spec", [0])[0])
        self._success_method = needed_success_method(venv.has_attr)
        self.predictor = predictor
        self.curriculum = curriculum
        self.mode = mode
        self._rng = np.random.default_rng()
        self._shown = np.zeros((venv.num_envs, self._space.size), self._dtype)
        self._original = self._shown.copy()
        self._level = np.zeros(venv.num_envs, dtype=np.int64)
        self._may_go_on = np.zeros(venv.num_envs, dtype=bool)
        self._start = np.zeros((venv.num_envs, self._space.size))
        self._contexts = np.zeros((venv.num_envs, len(predictor.context)))
        _read_contexts(venv, [], predictor.context)  # refused now rather than at the first reset

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
        achieved, goals = np.array(obs["achieved_goal"]), np.array(obs["desired_goal"])
        for i in ended:
            last = terminal_observation(infos[i])
            for array, key in ((achieved, "achieved_goal"), (goals, "desired_goal")):
                check_shape(last[key], (self._space.size,), f"the terminal observation {key!r}")
                array[i] = last[key]
        check_goal_stays(goals, self._original)

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
            last = {**last, "desired_goal": self._shown[i].copy()}
            infos[i] |= {"terminal_observation": last, LAST: last}
        arrived = success & (self._level > 0) & (np.asarray(dones) == 0)
        for i in np.flatnonzero(arrived & self._may_go_on):
            self._shown[i], self._level[i] = self._original[i], 0
            infos[i][GOES_ON] = True
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

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the copies.

        Raises:
            ValueError: it is the predictor or the curriculum, which all copies share.
        """
        if attr_name in SHARED:
            raise ValueError(
                f"{attr_name} is shared by all copies: make another ImaginedGoalVecEnv with it"
            )
        super().set_attr(attr_name, value, indices)

    def get_state(self) -> dict[str, Any]:
        """Return the goals, the generator's state and, where it offers one, the inner state.

        Only with an inner state can running episodes be continued by ``set_state``; without one,
        reset after it. The curriculum, shared with others, is not part of it.
        """
        state: dict[str, Any] = {
            "shown": self._shown.copy(),
            "original": self._original.copy(),
            "level": self._level.copy(),
            "may_go_on": self._may_go_on.copy(),
            "start": self._start.copy(),
            "rng": copy.deepcopy(self._rng.bit_generator.state),
        }
        if self.predictor.context:
            state["contexts"] = self._contexts.copy()
        if hasattr(self.venv, "get_state"):
            state["venv"] = self.venv.get_state()
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from ``get_state`` of a wrapper of the same size."""
        contexts = ("contexts",) if self.predictor.context else ()
        new = [name for name in ("start", "may_go_on") if name in state]  # since 0.2.0
        for name in ("shown", "original", "level", *new, *contexts):
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

    def ahead(self, rows: np.ndarray, distance: float) -> np.ndarray:
        """Return where F_phi sees each episode's object after so much of its way, (m, 3) metres.

        Args:
            rows: copies whose episodes have just begun, (m,).
            distance: metres from where the object is.
        """
        start, goal, contexts = self._start[rows], self._original[rows], self._contexts[rows]
        return ahead(self.predictor, start, goal, distance, contexts)

    def _draw(self, rows: np.ndarray, obs: Observation) -> None:
        """Give the episodes that start in ``rows`` their goals."""
        for key in ("achieved_goal", "desired_goal"):
            check_shape(obs[key], self._shown.shape, f"the observation {key!r}")
        start, goal = obs["achieved_goal"][rows], obs["desired_goal"][rows]
        predictor, curriculum = self.predictor, self.curriculum
        contexts = self._contexts[rows] = _read_contexts(self.venv, rows, predictor.context)
        self._may_go_on[rows] = False
        if self.mode == "test":
            level = np.full(len(rows), curriculum.k_max)
            shown = imagine(predictor, curriculum, start, goal, level, contexts)
        else:
            shown, level = draw_goals(predictor, curriculum, start, goal, self._rng, contexts)
            self._may_go_on[rows] = curriculum.draw_going_on(len(rows), self._rng)
        with np.errstate(under="ignore"):
            self._shown[rows], self._original[rows], self._level[rows] = shown, goal, level
        self._start[rows] = start

    def _ask(self, method: str, *args: Any) -> np.ndarray:
        """Return what the first copy's method says of each row of ``args``."""
        answer = self.venv.env_method(method, *args, indices=[0])[0]
        return one_each(answer, len(args[0]), f"the environment's {method}")

    def _relabel(self, obs: Observation) -> Observation:
        return {**obs, "desired_goal": self._shown.copy()}

    def _facts(self) -> list[dict[str, Any]]:
        """What the infos of each copy say of its episode."""
        facts: list[dict[str, Any]] = [
            {"original_goal": goal, "imagined_level": level}
            for goal, level in zip(self._original.copy(), self._level.tolist(), strict=True)
        ]
        if self.predictor.context:
            for fact, context in zip(facts, self._contexts.copy(), strict=True):
                fact["context"] = context
        return facts


def _read_contexts(venv: VecEnv, rows: Sequence[int] | np.ndarray, names: Sequence[str]) -> Any:
    """Return what F_phi sees beside start and goal, of some copies as they are now, (m, c).

    Raises:
        ValueError: the copies cannot be looked into.
    """
    if not names:
        return np.zeros((len(rows), 0))
    copies = venv.unwrapped
    if isinstance(copies, ProcessVecEnv):
        read = copies.apply(partial(read_context, names), rows)
    elif isinstance(copies, DummyVecEnv):
        read = [read_context(names, copies.envs[row]) for row in rows]
    else:
        raise ValueError(
            f"the predictor sees the place of {', '.join(bodies_in(names))}, which the copies of a "
            f"{type(copies).__name__} cannot be asked for; give each of them an "
            "ImaginedGoalWrapper, or take a DummyVecEnv"
        )
    return np.reshape(read, (len(rows), len(names)))


def curriculum_of(env: VecEnv | None) -> Curriculum | None:
    """Return the curriculum that an environment's goals come from; None where it imagines none.

    An environment's own attribute of that name is another thing.
    """
    if env is None or not env.has_attr("curriculum"):
        return None
    (found,) = env.get_attr("curriculum", indices=[0])
    return found if isinstance(found, Curriculum) else None


def imagination_of(env: VecEnv | None, asker: str) -> tuple[GoalPredictor, Curriculum]:
    """Return the predictor and the curriculum that an environment's goals come from.

    Raises:
        ValueError: the environment imagines no goals; the message begins with ``asker``.
    """
    curriculum = curriculum_of(env)
    if env is None or curriculum is None:
        raise ValueError(
            f"{asker} needs an environment wrapped in ImaginedGoalVecEnv or ImaginedGoalWrapper; "
            "this one imagines no goals"
        )
    predictor = env.get_attr("predictor", indices=[0])[0]
    return predictor, curriculum
