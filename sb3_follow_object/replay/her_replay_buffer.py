"""A hindsight replay buffer whose sampling does not slow down as it fills."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from ..common.answers import one_each
from ..common.numbers import checked_whole
from ..imagination.curriculum import Curriculum
from ..imagination.goal_env import check_unstacked
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.imagined_goals import imagine_afar
from ..imagination.vec_env import curriculum_of, imagination_of
from ..settings.learning import ReplaySettings
from .cher import GoalSelection
from .episode_buffer import EpisodeReplayBuffer
from .episode_table import EpisodeTable
from .record_buffer import NEXT_DESIRED
from .steps import check_actions, check_copies, check_two_valued

RewardFunction = Callable[[np.ndarray, np.ndarray, list[dict[str, Any]]], np.ndarray]
Strategy = GoalSelectionStrategy | str
IMAGINED_RATIO = "imagined_ratio > 0"  # what needs an environment that imagines goals


class FollowObjectReplayBuffer(EpisodeReplayBuffer):
    """SB3's HerReplayBuffer with imagined goals, moved-object sampling and float32 storage.

    Takes the place of `HerReplayBuffer` in any off-policy algorithm of SB3.
    The distribution of the samples is that of HerReplayBuffer when `imagined_ratio` and
    `moved_ratio` are 0; a virtual transition is then chosen per transition with probability
    n_sampled_goal / (n_sampled_goal + 1) rather than in an exact share.

    Args:
        imagined_ratio: share in [0, 1] of the virtual transitions relabelled with a goal that
            F_phi imagines from the episode's start and original goal, at a level of the current
            curriculum, instead of with an achieved goal, until the curriculum is finished. 0 is the
            paper's setting. Above 0, the environment must be wrapped in `ImaginedGoalVecEnv` or
            `ImaginedGoalWrapper`.
        moved_ratio: share in [0, 1] of each batch drawn only from episodes in which the achieved
            goal moved by more than `moved_distance`; the rest is drawn from all. 0 is the paper's.
        moved_distance: metres.
        moved_priority: how that share is drawn: "uniform", or "energy", in proportion to the
            energy that the object was given in the episode (Zhao and Tresp, Energy-Based Hindsight
            Experience Prioritization), so that lifting counts for more than pushing. The third
            coordinate of a goal is then its height.
        step_seconds: duration of an environment step, for the object's speed.
        min_goal_distance: metres; a hindsight goal nearer than this to where the episode's achieved
            goal began was reached before anything was done. Such a transition keeps the goal that
            was shown, so that episodes that moved nothing do not teach to stay. 0 is the paper's.
        scene_distance: metres; hindsight takes it that all would have gone the same way had the
            goal been another. Where something stands around each goal, as a tube or a shelf does,
            it would not have: a hindsight goal that lies within this of where earlier episodes'
            goals lay, but not of its own episode's, is then not used. That begins once imagined
            goals are over, around which nothing stands. 0 is the paper's.
        goal_margin: share in [0, 1) of the tolerance at whose outer edge a goal does not count as
            reached in what is learned from: a policy whose actions have a price moves the object as
            little as will do, and what stops at the edge often stops beyond it. For environments
            that pay by whether a goal is near enough, one of two rewards. 0 is the paper's.
        cher: keyword arguments of `GoalSelection`, which then chooses each batch from more
            candidates; None chooses nothing.
        reward_function: called as f(achieved (n, d), desired (n, d), infos) -> (n,); by default the
            `compute_reward` of the first environment is asked, which costs a round trip between
            processes in a SubprocVecEnv.
        seed: of the buffer's own generator; by default drawn from NumPy's global one, which SB3
            seeds as it makes a model. A stock algorithm's `set_random_seed` does not reach it
            later: call `seed` too. That of `HerDDPG` does.

    The other arguments are HerReplayBuffer's.

    Raises:
        ValueError: an argument is outside its range, or actions have no bounds; at the first step,
            an episode does not fit, or imagined goals are asked for without the wrapper that
            imagines them; or, at a sample with `goal_margin`, there are more than two rewards.
    """

    goal_margin = scene_distance = 0.0  # of buffers pickled before there were any
    _predictor: GoalPredictor | None = None  # the environment's, once it was asked for it

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        env: VecEnv,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = ReplaySettings.handle_timeout_termination,
        n_sampled_goal: int = ReplaySettings.n_sampled_goal,
        goal_selection_strategy: Strategy = ReplaySettings.goal_selection_strategy,
        copy_info_dict: bool = ReplaySettings.copy_info_dict,
        imagined_ratio: float = ReplaySettings.imagined_ratio,
        moved_ratio: float = ReplaySettings.moved_ratio,
        moved_distance: float = ReplaySettings.moved_distance,
        moved_priority: str = ReplaySettings.moved_priority,
        step_seconds: float = ReplaySettings.step_seconds,
        min_goal_distance: float = ReplaySettings.min_goal_distance,
        scene_distance: float = ReplaySettings.scene_distance,
        goal_margin: float = ReplaySettings.goal_margin,
        cher: dict[str, Any] | None = None,
        reward_function: RewardFunction | None = None,
        seed: int | None = None,
    ):
        settings = ReplaySettings(
            n_sampled_goal=n_sampled_goal,
            goal_selection_strategy=goal_selection_strategy,
            handle_timeout_termination=handle_timeout_termination,
            copy_info_dict=copy_info_dict,
            imagined_ratio=imagined_ratio,
            moved_ratio=moved_ratio,
            moved_distance=moved_distance,
            moved_priority=moved_priority,  # type: ignore[arg-type]  # a word is checked there
            step_seconds=step_seconds,
            min_goal_distance=min_goal_distance,
            scene_distance=scene_distance,
            goal_margin=goal_margin,
            cher=cher,
            seed=seed,
        )
        n_envs = checked_whole("n_envs", n_envs, 1)
        buffer_size = checked_whole("buffer_size", buffer_size, 1)
        check_actions(action_space)
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            env,
            device=device,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=settings.handle_timeout_termination,
            n_sampled_goal=settings.n_sampled_goal,
            goal_selection_strategy=settings.goal_selection_strategy,
            copy_info_dict=settings.copy_info_dict,
        )
        self.imagined_ratio = settings.imagined_ratio
        self.moved_ratio = settings.moved_ratio
        self.moved_distance = settings.moved_distance
        self.moved_priority = settings.moved_priority
        self.step_seconds = settings.step_seconds
        self.min_goal_distance = settings.min_goal_distance
        self.scene_distance = settings.scene_distance
        self.goal_margin = settings.goal_margin
        self.selection = None if settings.cher is None else GoalSelection(**settings.cher)
        self.reward_function = reward_function
        goal_shape = self.observations["desired_goal"].shape
        if self.moved_priority == "energy" and goal_shape[-1] < 3:
            raise ValueError(
                f"moved_priority 'energy' reads a height in metres from goals of 3 numbers; these "
                f"have {goal_shape[-1]}: take 'uniform'"
            )
        self.n_added = 0  # time-steps so far
        if env is not None:
            self._check_asked(env)  # raises now rather than at the first sample
            if curriculum_of(env) is not None:  # else whoever was loaded may only act there
                self._make_room_for_contexts(env)
        self.rng = np.random.default_rng(
            np.random.randint(2**31) if settings.seed is None else settings.seed
        )

        keeps_goals = self.imagined_ratio > 0.0 or self.scene_distance > 0.0
        self.original_goals = np.zeros(goal_shape if keeps_goals else (0,), dtype=np.float32)
        if not self.copy_info_dict:
            self.infos = np.empty((0, n_envs), dtype=object)  # one unused dict a slot otherwise
        # Whether what a slot achieved is far enough from where its episode began.
        self._far = np.zeros(self.dones.shape if self.min_goal_distance > 0.0 else (0,), dtype=bool)
        # Whether that is where other episodes' goals lie and its own does not.
        self._amiss = np.zeros(self.dones.shape if self.scene_distance > 0.0 else (0,), dtype=bool)
        self.table = EpisodeTable()
        self.revision = 0  # counts how often the content was loaded or forgotten

    def seed(self, seed: int) -> None:
        """Begin the buffer's own generator anew.

        Raises:
            ValueError: it is no whole number of at least 0.
        """
        self.rng = np.random.default_rng(checked_whole("seed", seed, 0))

    def set_env(self, env: VecEnv) -> None:
        """Ask another environment for rewards and imagined goals from now on.

        Episodes that ran in an earlier one end where they stand. An algorithm of SB3 does not tell
        its replay buffer of `set_env`; `HerDDPG` and `CurriculumCallback` do.

        Raises:
            ValueError: it has another number of copies, or lacks what the buffer asks for.
        """
        self.check_env(env)
        if self.env is not None and env is not self.env:
            self.end_episodes()
        self.env, self._predictor = env, None
        if self.size() == 0:
            self._make_room_for_contexts(env)

    def _make_room_for_contexts(self, env: VecEnv) -> None:
        """Let what F_phi sees of other things' places be stored, where it will be asked."""
        if self.imagined_ratio > 0.0:
            context = imagination_of(env, IMAGINED_RATIO)[0].context
            if context:
                env.get_attr("predictor")  # each wrapper tells its context once it has one
            shape = (self.buffer_size, self.n_envs, len(context))
            self.contexts = np.zeros(shape, dtype=np.float32)

    def check_env(self, env: VecEnv) -> None:
        """Raise a ValueError for an environment that `set_env` refuses."""
        self._check_asked(env)
        if self.imagined_ratio > 0.0:
            n, stored = len(imagination_of(env, IMAGINED_RATIO)[0].context), self.contexts.shape[-1]
            if self.size() and n != stored:
                raise ValueError(
                    f"the environment's predictor sees {n} numbers of other things' places, but the"
                    f" replay buffer holds {stored} of each step; give the model a new buffer"
                )

    def check_first(self) -> None:
        """Refuse to begin where imagined goals are asked for and nothing imagines any, too."""
        super().check_first()
        if self.imagined_ratio > 0.0:
            try:
                imagination_of(self.env, IMAGINED_RATIO)
            except ValueError as error:
                raise ValueError(
                    f"{error}; where the model has had another environment since it was made, call "
                    "model.replay_buffer.set_env(model.env)"
                ) from error

    def _check_asked(self, env: VecEnv) -> None:
        check_copies(self.n_envs, env.num_envs)
        check_unstacked(env)
        asks = self.reward_function is None and self.her_ratio > 0.0
        if asks and not env.has_attr("compute_reward"):
            raise ValueError(
                "hindsight needs an environment with compute_reward(achieved, desired, infos), "
                "this one has none; or give a reward_function"
            )

    def state_dict(self) -> dict[str, Any]:
        """Return the content and the generator, as views that later additions change.

        Raises:
            ValueError: with `copy_info_dict`; infos are Python objects.
        """
        if self.copy_info_dict:
            raise ValueError("a replay buffer's state has no infos: leave copy_info_dict out")
        used = self.buffer_size if self.full else self.pos
        return {
            "buffer_size": self.buffer_size,
            "pos": self.pos,
            "full": self.full,
            "current_episode_start": self._current_ep_start,
            **({} if self._goals_ahead is None else {"goals_ahead": self._goals_ahead}),
            "slots": {name: store[:used] for name, store in self._stores().items()},
            "table": self.table.state_dict(),
            "rng": self.rng.bit_generator.state,
            "selection": None if self.selection is None else self.selection.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict` of a buffer of the same shape and size.

        Raises:
            ValueError: the state belongs to a buffer with other stores, shapes or slots, or to one
                without the `cher` that this one has; nothing is changed.
        """
        self._check_content(state)
        if self.selection is not None and state["selection"] is None:
            raise ValueError("the saved replay buffer was without cher, and this one has it")
        slots = state["slots"]
        self._share_goals(NEXT_DESIRED not in slots)
        self.ep_length[:] = 0  # of episodes that are there now
        for name, store in self._stores().items():
            store[: len(slots[name])] = slots[name]
        self.pos, self.full = state["pos"], state["full"]
        self.revision += 1
        self._current_ep_start = state["current_episode_start"].copy()
        ahead = state.get("goals_ahead")
        self._goals_ahead = None if ahead is None else ahead.copy()
        self.table.load_state_dict(state["table"])
        self.rng.bit_generator.state = state["rng"]
        if self.selection is not None:
            self.selection.load_state_dict(state["selection"])

    def reset(self) -> None:
        """Forget everything that was stored; only the generator goes on from where it is.

        A `HerDDPG` whose buffer this is has to be told, by its `expect_new_replay`.
        """
        super().reset()
        self.revision += 1
        if self.selection is not None:
            self.selection.n_batches = 0

    def _stores(self) -> dict[str, np.ndarray]:
        stores = super()._stores()
        of_size = {
            "original_goals": self.original_goals,
            "contexts": self.contexts,
            "far": self._far,
            "amiss": self._amiss,
        }
        return stores | {name: store for name, store in of_size.items() if store.size}

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_predictor": None}  # the environment's, as is `env`

    def selection_log(self) -> dict[str, float]:
        """Return what there is to log about how batches are chosen."""
        if self.selection is None:
            return {}
        return {"cher/proximity_weight": float(self.selection.proximity_weights(1)[0])}

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        """Draw transitions and relabel them in one vectorised pass.

        Args:
            batch_size: number of transitions.
            env: to normalise observations and rewards, as in SB3.

        Raises:
            RuntimeError: before the end of the first episode.
            ValueError: rewards or imagined goals of another shape, or not finite.
        """
        return self.sample_with_steps(batch_size, env)[0]

    def sample_with_steps(
        self, batch_size: int, env: VecNormalize | None = None, n_batches: int = 1
    ) -> tuple[DictReplayBufferSamples, th.Tensor]:
        """Draw as `sample` does, and say how soon the episode itself reached each goal.

        Args:
            batch_size: number of transitions in all.
            env: as in `sample`.
            n_batches: gradient steps that they are for: batch_size / n_batches each, in this order.

        Returns:
            The transitions, and (batch_size, 1) float: -1s that the episode was paid from the
            transition until it stood on the hindsight goal; infinite where the goal shown is kept.
        """
        self.check_ready()
        with np.errstate(under="ignore"):
            return self._sample_with_steps(batch_size, env, n_batches)

    def _sample_with_steps(
        self, batch_size: int, env: VecNormalize | None, n_batches: int
    ) -> tuple[DictReplayBufferSamples, th.Tensor]:
        if env is not None and self.env is not None and unwrap_vec_normalize(self.env) is not env:
            self.set_env(env)  # of an algorithm that was given another environment
        if self.selection is not None:
            batch_size *= self.selection.candidates
        row, step = self._draw(batch_size)
        episode = self.table.facts.take(row, axis=0)
        flat = self._flat(episode, step)
        achieved = self._achieved_goals(flat)
        steps_to_goal = np.full(batch_size, np.inf, dtype=np.float32)
        virtual = np.flatnonzero(self.rng.random(batch_size) < self.her_ratio)
        relabelled = episode.take(virtual, axis=0)
        goals, steps, usable = self._hindsight_goals(relabelled, step.take(virtual))
        if usable is not None:
            kept = np.flatnonzero(usable)
            virtual, steps = virtual.take(kept), steps.take(kept)
            goals = goals.take(kept, axis=0)
        goals = self._goals_in(goals)
        if self.imagined_ratio > 0.0 and not self._imagination()[1].finished:
            chosen = np.flatnonzero(self.rng.random(len(virtual)) < self.imagined_ratio)
            goals[chosen] = self._imagined_goals(episode[virtual[chosen]])
            steps[chosen] = np.inf
        steps_to_goal[virtual] = steps
        batch = self._gather(flat, achieved)
        for desired in batch.desired_goals():
            for i in range(goals.shape[1]):  # half the time of all at once, for a few coordinates
                desired[virtual, i] = goals[:, i]
        # With a margin rewards for the goals that were shown are others than those that were paid.
        judged = np.arange(batch_size) if self.goal_margin > 0.0 else virtual
        reached = self._goals_in(achieved.take(judged, axis=0))
        shown = batch.observations["desired_goal"].take(judged, axis=0)
        batch.rewards[judged] = self._reward(reached, shown, flat.take(judged))
        if self.goal_margin > 0.0:
            check_two_valued(batch.rewards)

        if self.selection is not None:
            chosen = self.selection.choose(
                batch.observations["desired_goal"],
                batch.observations["achieved_goal"],
                n_batches,
                self.rng,
            )
            batch, steps_to_goal = batch.pick(chosen), steps_to_goal[chosen]
        obs, next_obs = (
            self._normalize_obs(observations, env)
            for observations in (batch.observations, batch.next_observations)
        )
        assert isinstance(obs, dict) and isinstance(next_obs, dict)
        rewards = self._normalize_reward(batch.rewards, env)
        samples = DictReplayBufferSamples(
            observations={key: self._to_tensor(value) for key, value in obs.items()},
            actions=self._to_tensor(batch.actions),
            next_observations={key: self._to_tensor(value) for key, value in next_obs.items()},
            dones=self._to_tensor(batch.dones).reshape(-1, 1),
            rewards=self._to_tensor(rewards).reshape(-1, 1),
        )
        return samples, self._to_tensor(steps_to_goal).reshape(-1, 1)

    def _to_tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(np.asarray(array, dtype=np.float32)).to(self.device)

    def _hindsight_goals(
        self, episode: np.ndarray, step: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Achieved goals of the same episode, by the strategy, not yet cut to (n, d).

        Second, the steps from the transition to the one that achieved the goal (n,), float;
        infinite for goals of the past. Third, if not all are, which goals are of use (n,).
        """
        length = episode[:, 2]
        if self.goal_selection_strategy == GoalSelectionStrategy.FINAL:
            chosen = length - 1
        elif self.goal_selection_strategy == GoalSelectionStrategy.FUTURE:
            chosen = self.rng.integers(step, length)
        else:
            chosen = self.rng.integers(0, length)
        flat = self._flat(episode, chosen)
        steps = (chosen - step).astype(np.float32)
        if self.goal_selection_strategy == GoalSelectionStrategy.EPISODE:
            steps[steps < 0] = np.inf
        return self._achieved_goals(flat), steps, self._usable(flat)

    def _usable(self, flat: np.ndarray) -> np.ndarray | None:
        """Which of these transitions' achieved goals may be hindsight goals (n,); None, all."""
        far = self._take(self._far, flat) if self.min_goal_distance > 0.0 else None
        if self.scene_distance == 0.0 or not self._is_finished():
            return far
        as_asked = ~self._take(self._amiss, flat)
        return as_asked if far is None else far & as_asked

    def _is_finished(self) -> bool:
        """Whether no imagined goals are shown any more, around which nothing stands."""
        curriculum = curriculum_of(self.env)
        return curriculum is None or curriculum.finished

    def _imagination(self) -> tuple[GoalPredictor, Curriculum]:
        """The environment's predictor, which another process sends but once, and its curriculum."""
        if self._predictor is None or self.env is None:
            self._predictor, curriculum = imagination_of(self.env, IMAGINED_RATIO)
            return self._predictor, curriculum
        return self._predictor, self.env.get_attr("curriculum", indices=[0])[0]

    def _imagined_goals(self, episode: np.ndarray) -> np.ndarray:
        """F_phi(o_1, g, k) of each episode at a level that it could have shown, (n, d)."""
        predictor, curriculum = self._imagination()
        first = episode[:, 0], episode[:, 1]
        start = self.observations["achieved_goal"][first]
        goal = self.original_goals[first]
        lowest, *_ = curriculum.drawable()
        level = self.rng.integers(lowest, curriculum.k_max, size=len(episode), endpoint=True)
        contexts = self.contexts[first] if self.contexts.size else None
        return imagine_afar(predictor, curriculum, start, goal, level, self.rng, contexts)[0]

    def _reward(self, achieved: np.ndarray, desired: np.ndarray, flat: np.ndarray) -> np.ndarray:
        """Rewards (n,) of goals achieved for goals desired (n, d) in the transitions `flat`."""
        if not len(flat):
            return np.zeros(0, dtype=np.float32)
        if self.goal_margin > 0.0:
            achieved = self.goal_space.as_with_margin(achieved, desired, self.goal_margin)
        # Where no infos are kept, one empty dict does for all.
        infos = list(self._take(self.infos, flat)) if self.copy_info_dict else [{}] * len(flat)
        if self.reward_function is not None:
            answer, asked = self.reward_function(achieved, desired, infos), "reward_function"
        elif self.env is None:
            raise RuntimeError("the replay buffer has no environment: call set_env() after loading")
        else:
            answer, asked = self._ask(achieved, desired, infos), "the environment's compute_reward"
        return one_each(answer, len(flat), asked)

    def _ask(self, achieved: np.ndarray, desired: np.ndarray, infos: list[dict[str, Any]]) -> Any:
        assert self.env is not None
        try:
            return self.env.env_method("compute_reward", achieved, desired, infos, indices=[0])[0]
        except (OSError, EOFError) as error:
            raise ValueError(
                f"the replay buffer's environment does not answer ({error}); after "
                "model.set_env(env), call model.replay_buffer.set_env(model.env)"
            ) from error
