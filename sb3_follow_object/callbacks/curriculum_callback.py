"""Callback that tests h_max and advances k_max."""

from __future__ import annotations

import warnings
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecNormalize,
    is_vecenv_wrapped,
    unwrap_vec_wrapper,
)

from ..ddpg.whole_episodes import WholeEpisodesDDPG
from ..imagination.curriculum import Curriculum
from ..imagination.goal_env import check_unstacked
from ..imagination.vec_env import ImaginedGoalVecEnv, imagination_of
from ..replay.episode_buffer import EpisodeReplayBuffer
from ..replay.following import end_running_episodes, episodes_are_whole, follow_env
from ..settings.stages import CurriculumTestSettings
from .copyable import CopyableCallback
from .env_copies import copies_for_tests
from .rollout import Observation, OnStep, check_hears_rollouts, noise_free, run_episodes

_ASKER = "CurriculumCallback"
_BY_LIMIT = "TimeLimit.truncated"  # what SB3's copies say of an episode that has ended
_ENDED_EARLY = (
    "an episode was terminated, not ended by its time limit: imagined goals are for episodes that "
    "go on, and at -1 a step a robot learns to end what it cannot reach; turn that off in the "
    "environment"
)


class CurriculumCallback(CopyableCallback):
    """Test the policy on h_max without noise and advance k_max (paper, Algorithm 1).

    A test is due after every ``every`` cycles. A cycle is as many ended episodes as there are
    copies, at least, and ends with a rollout; rollouts of a few steps add up to one. Nothing is
    tested once the curriculum is finished. Records curriculum/k_max, curriculum/test_success and
    curriculum/test_steps.

    The model carries the curriculum's state as ``model.curriculum_state``, which SB3 saves with it:
    training that goes on from a loaded model goes on at its k_max. A model that has not trained
    begins at the curriculum's first one, whatever another has come to in these wrappers.

    The training's environment goes on to imagine goals after training: evaluate in another.

    Args:
        test_env: ImaginedGoalVecEnv with mode="test", or wrappers around one, sharing the
            training's curriculum, and not in VecNormalize: a model that was trained in one
            normalises by itself; None makes as many copies of the training's environment, with all
            that it is wrapped in, when training starts.
        n_episodes: episodes of a test, >= 1; None, one of every copy.
        every: cycles between tests, >= 1.
        store: whether to put the tests' transitions into the model's replay buffer. It is done
            where that keeps the buffer's episodes whole: with as many copies as the training has,
            and when no training episode is half-way.

    Attributes:
        test_steps: environment steps spent in tests so far, all copies counted; they are part of
            the model's num_timesteps.

    Raises:
        ValueError: an argument is outside its range, test_env does not show h_max or is in
            VecNormalize, or training starts in an environment that imagines no goals, with a
            test_env of another curriculum, or without one where none can be copied.
    """

    def __init__(
        self,
        test_env: VecEnv | None = None,
        n_episodes: int | None = CurriculumTestSettings.n_episodes,
        every: int = CurriculumTestSettings.every,
        store: bool = CurriculumTestSettings.store,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if test_env is not None:
            imagined = unwrap_vec_wrapper(test_env, ImaginedGoalVecEnv)
            if imagined is None or imagined.mode != "test":
                raise ValueError("test_env must be an ImaginedGoalVecEnv with mode='test'.")
            if is_vecenv_wrapped(test_env, VecNormalize):
                raise ValueError(
                    "test_env is in VecNormalize; the model's own normalises already: leave it out."
                )
        settings = CurriculumTestSettings(n_episodes=n_episodes, every=every, store=store)
        self._test_env = test_env
        self._copied: VecEnv | None = None  # the training's, where the test's is a copy of it
        self.n_episodes = settings.n_episodes
        self.every = settings.every
        self.store = settings.store
        self.test_steps = 0
        self._cycles = 0
        self._ended = 0  # episodes of the cycle that goes on
        self._is_training = False
        self._warned = False  # of episodes that end by themselves
        self._trained: BaseAlgorithm | None = None  # the model that training began with last

    @property
    def test_env(self) -> VecEnv:
        """The environment that tests run in; one of the callback's own exists once training has."""
        if self._test_env is None:
            raise RuntimeError("the test environment is made when training starts")
        return self._test_env

    @property
    def curriculum(self) -> Curriculum:
        """The curriculum that the tests advance."""
        return imagination_of(self.test_env, _ASKER)[1]

    @property
    def _replay_buffer(self) -> Any:
        return getattr(self.model, "replay_buffer", None)

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training needs (JSON types); the curriculum has its own state."""
        return {
            "test_steps": self.test_steps,
            "cycles": self._cycles,
            "ended": self._ended,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self.test_steps = int(state["test_steps"])
        self._cycles = int(state["cycles"])
        self._ended = int(state.get("ended", 0))  # saves of before had none

    def _on_training_start(self) -> None:
        check_hears_rollouts(self)
        check_unstacked(self.training_env)
        self._check_goes_on()
        self._follow_training_env()
        broken_off = self._is_training and self.model.num_timesteps > 0
        # Who knows what step the environment stands at after an exception? Ours do.
        if broken_off and not isinstance(self.model, WholeEpisodesDDPG):
            self._begin_new_episodes()
        if self.model.num_timesteps == 0:  # the environment was reset, wherever it stood
            end_running_episodes(self._replay_buffer)
        self._is_training = True
        another = self._trained is not self.model
        if self._trained is not None and self.model.num_timesteps == 0:
            self.test_steps = 0  # counted anew, as SB3 does its steps unless told otherwise
            self._cycles = self._ended = 0
        before = imagination_of(self.training_env, _ASKER)[1].state_dict()
        if another and hasattr(self.model, "curriculum_state"):
            self.curriculum.load_state_dict(self.model.curriculum_state)
        elif another and self.model.num_timesteps == 0:
            self.curriculum.restart()  # whatever another model has come to in these wrappers
        self._trained = self.model
        self._share_curriculum()
        if self.curriculum.state_dict() != before:  # running episodes show goals of other levels
            self._begin_new_episodes()

    def _check_goes_on(self) -> None:
        """Refuse a buffer that takes the goal that an episode goes on to for its last one's."""
        buffer, curriculum = self._replay_buffer, imagination_of(self.training_env, _ASKER)[1]
        if curriculum.go_on and not isinstance(buffer, EpisodeReplayBuffer):
            theirs = "the model" if buffer is None else type(buffer).__name__
            raise ValueError(
                f"curriculum.go_on shows another goal within an episode, which {theirs} would take "
                "for the goal of the step before: take FollowObjectReplayBuffer, or leave go_on out"
            )

    def _follow_training_env(self) -> None:
        """Let the tests and the replay buffer have what training has, whatever was replaced."""
        if self._test_env is None or self._is_outdated_copy():
            if self._test_env is not None:
                self._test_env.close()
            self._test_env, self._copied = copies_for_tests(self.training_env), self.training_env
            # NumPy's global stream is the one that SB3 seeds.
            self._test_env.seed(int(np.random.randint(2**31 - 1000)))
        elif self._copied is None:
            _check_curriculum(self.training_env, self.curriculum)
        buffer = self._replay_buffer
        if buffer is not None:
            follow_env(buffer, self.training_env)

    def _is_outdated_copy(self) -> bool:
        """Whether tests run in a copy of what training no longer has."""
        if self._copied is None or self._test_env is None:
            return False
        ours, theirs = (imagination_of(env, _ASKER) for env in (self._test_env, self.training_env))
        return self._copied is not self.training_env or ours != theirs

    def _begin_new_episodes(self) -> None:
        model: Any = self.model
        end_running_episodes(self._replay_buffer)
        model._last_obs = self.training_env.reset()
        model._last_episode_starts = np.ones(self.training_env.num_envs, dtype=bool)
        normaliser = model.get_vec_normalize_env()
        if normaliser is not None:
            model._last_original_obs = normaliser.get_original_obs()

    def _on_training_end(self) -> None:
        # Where another callback stopped the training in the middle of a step, SB3 does not store it
        # and would go on from the observation before it; without one it resets the environment.
        model, self._is_training = cast(Any, self.model), False
        if model._last_obs is not self.locals.get("new_obs", model._last_obs):
            model._last_obs = None
            end_running_episodes(self._replay_buffer)

    def _on_step(self) -> bool:
        dones, infos = self.locals["dones"], self.locals["infos"]
        self._ended += int(np.sum(dones))
        if not self._warned and any(dones):
            pairs = zip(dones, infos, strict=True)
            self._warned = any(done and info.get(_BY_LIMIT) is False for done, info in pairs)
            if self._warned:
                warnings.warn(_ENDED_EARLY, stacklevel=2)
        return True

    def _on_rollout_end(self) -> None:
        if self._ended >= self.training_env.num_envs:
            self._cycles += 1
            self._ended = 0
        if self._cycles >= self.every and not self.curriculum.finished:
            self._cycles = 0
            self._test()
        # A rollout's end, and a test's, may lie beyond the last step; schedules end at 0.
        model: Any = self.model
        model._current_progress_remaining = max(0.0, model._current_progress_remaining)
        self.logger.record("curriculum/k_max", self.curriculum.k_max)
        self.logger.record("curriculum/test_steps", self.test_steps)

    def _test(self) -> None:
        buffer = self._open_buffer()
        try:
            episodes = run_episodes(
                noise_free(self.model, learning=True),
                self.test_env,
                self.n_episodes or self.test_env.num_envs,
                on_step=None if buffer is None else self._storing(buffer),
            )
        finally:  # those still running too, so that training starts its own
            end_running_episodes(buffer)
        self.test_steps += episodes.env_steps
        model = self.model
        model.num_timesteps += episodes.env_steps  # tests cost steps like any others
        self.logger.record("curriculum/test_success", episodes.success_rate)
        passed = self.curriculum.report(episodes.success_rate, len(episodes.success))
        self._share_curriculum()
        if passed and self.verbose:
            print(
                f"k_max {self.curriculum.k_max} of {self.curriculum.n_levels} "
                f"after {self.num_timesteps} steps"
            )

    def _share_curriculum(self) -> None:
        """Tell the model and the copies of the curriculum inside the training's environments."""
        state = self.curriculum.state_dict()
        self.model.curriculum_state = state  # type: ignore[attr-defined]
        if self.training_env.has_attr("load_curriculum"):
            self.training_env.env_method("load_curriculum", state)

    def _open_buffer(self) -> Any:
        """Return the replay buffer if test episodes can go into it now, else None."""
        buffer = self._replay_buffer
        if not self.store or buffer is None or self.test_env.num_envs != buffer.n_envs:
            return None
        return buffer if episodes_are_whole(buffer) else None

    def _storing(self, buffer: Any) -> OnStep:
        continuous = isinstance(self.model.action_space, spaces.Box)

        def store(
            obs: Observation,
            actions: np.ndarray,
            rewards: np.ndarray,
            dones: np.ndarray,
            infos: list[dict[str, Any]],
            next_obs: Observation,
        ) -> None:
            # Buffers of SB3 hold actions scaled to [-1, 1].
            stored = self.model.policy.scale_action(actions) if continuous else actions
            # Not in VecNormalize here, where it would be what that has made of the last one.
            infos = [{k: info[k] for k in info if k != "terminal_observation"} for info in infos]
            buffer.add(obs, next_obs, stored, rewards, dones, infos)

        return store


def _check_curriculum(training_env: VecEnv, curriculum: Curriculum) -> None:
    """Raise a ValueError unless the training imagines goals by the curriculum of the tests."""
    theirs = imagination_of(training_env, _ASKER)[1]
    # Wrappers of single environments have copies of it, which are told of every change.
    if is_vecenv_wrapped(training_env, ImaginedGoalVecEnv) and theirs is not curriculum:
        raise ValueError("test_env must have the Curriculum object that the training has.")
