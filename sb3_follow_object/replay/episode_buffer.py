"""Which episodes a replay buffer holds, from one's beginning to its loss, and draws steps of."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

from ..envs.goal_envs import episode_steps
from ..envs.goal_space import GoalSpace, goal_space
from ..imagination.goal_env import GOES_ON, LAST
from ..settings.sizes import check_buffer
from .episode_table import EpisodeTable
from .record_buffer import Gathered, RecordReplayBuffer
from .steps import counted_steps, fitted, lost_steps, steps_in_reset, told

GRAVITY = 9.81  # m/s^2
_EPISODES = 1000  # whose goals say where goals lie
EXECUTED = "executed_action"  # in an info: what was done in place of the action given
GIVEN = "given_action"  # in an info beside it: which action that was


class EpisodeReplayBuffer(RecordReplayBuffer):
    """RecordReplayBuffer that knows its finished episodes; `FollowObjectReplayBuffer` says more."""

    imagined_ratio: float
    moved_ratio: float
    moved_distance: float
    moved_priority: str
    step_seconds: float
    min_goal_distance: float
    scene_distance: float
    original_goals: np.ndarray
    contexts = np.zeros((0, 0, 0), dtype=np.float32)
    _far: np.ndarray
    _amiss = np.zeros(0, dtype=bool)
    _warned_of_clipping = False
    _in_reset: Mapping[int, int] = MappingProxyType({})  # steps by environment, once it was asked
    rng: np.random.Generator
    table: EpisodeTable
    n_added: int

    @property
    def goal_space(self) -> GoalSpace:
        """What is known of the environment's goals."""
        return goal_space(self.observations["desired_goal"].shape[2:])

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of every environment; arguments as in HerReplayBuffer.

        What an info says was executed is stored in place of the action. A step that does not begin
        where the last one ended begins another episode: the environment was reset meanwhile. An
        episode is dropped, so that it is never sampled, whose info says "diverged" at its end, or
        whose steps were not all stored (`lost_steps`); what a wrapper does in `reset` is no step.

        Raises:
            ValueError: an array has another shape than the environments', or holds NaN or infinity,
                an info lacks what others hold, or a wrapper changed the action before it was
                replaced; nothing is stored.
        """
        if self.n_added == 0:
            self.check_first()
        next_obs = self._with_last_observations(next_obs, done, infos)
        ahead = next_obs["desired_goal"]
        next_obs = _for_one_goal(obs, next_obs, infos)
        if any(EXECUTED in info for info in infos):
            action = self._executed(action, infos)
        pos = self.pos
        rows = [
            self.table.row_of(int(self.ep_start[pos, env_idx]), int(env_idx))
            for env_idx in self.ep_length[pos].nonzero()[0]
        ]
        # Until the step has been taken, the episode that it overwrites is there.
        kept = (
            [(store[pos], store[pos].copy()) for store in self._stores().values()] if rows else []
        )
        shared = self.goals_are_shared
        try:
            # What is too small for float32 becomes 0, what is too large is refused.
            with np.errstate(under="ignore", over="ignore"):
                self._write(obs, next_obs, action, reward, done, infos)
                self._write_facts(infos)
        except BaseException:
            if self.goals_are_shared != shared:
                self._share_goals(shared)
            for slot, content in kept:
                slot[...] = content
            raise
        for row in sorted(rows):
            self._forget_episode(row)
        running = self._current_ep_start != pos
        if running.any():
            self.end_episodes(self._broken_off(running))
        goes_on = next_obs["desired_goal"] is not ahead
        dtype = self.observations["desired_goal"].dtype
        self._goals_ahead = np.array(ahead, dtype) if goes_on else None
        self.ep_start[pos] = self._current_ep_start
        if self.copy_info_dict:
            self.infos[pos] = infos
        self.pos = (pos + 1) % self.buffer_size
        self.full |= self.pos == 0
        self.n_added += 1
        self._end_finished(np.asarray(done, dtype=bool).reshape(self.n_envs), infos)

    def _write_facts(self, infos: list[dict[str, Any]]) -> None:
        """Write what infos say of goals that were not shown, and of other things' places."""
        if not self.original_goals.size:
            return
        pos, shape = self.pos, self.original_goals.shape[2:]
        shown = self.observations["desired_goal"][pos]
        for env_idx, (info, goal) in enumerate(zip(infos, shown, strict=True)):
            goal = fitted(info.get("original_goal", goal), shape, "the original goal")
            self.original_goals[pos, env_idx] = goal
        if self.contexts.size:
            self.contexts[pos] = told(infos, "context", self.contexts.shape[2:])

    def _with_last_observations(
        self, next_obs: dict[str, np.ndarray], done: np.ndarray, infos: list[dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """Return next observations in which nothing is clipped that this package's wrappers tell.

        VecNormalize keeps raw observations, but of an episode's last one only what it has scaled
        and clipped, and SB3 cannot undo the clipping: a first lift would be a lift of millimetres.
        The wrappers of imagined goals and of reaching tell it as it was (`LAST`), where no wrapper
        outside of them ends the episode. What these add or change stays clipped, entry by entry,
        with a warning, once.
        """
        ended = np.flatnonzero(done)
        normalizer = unwrap_vec_normalize(self.env) if ended.size and self.env else None
        if normalizer is None:
            return next_obs
        next_obs = {key: np.array(value) for key, value in next_obs.items()}
        for env_idx in ended:
            seen = infos[env_idx].get("terminal_observation")
            if not isinstance(seen, dict):
                continue
            row = {key: value[env_idx] for key, value in next_obs.items()}
            last = {
                key: value
                for key, value in (infos[env_idx].get(LAST) or {}).items()
                if key in row and np.shape(value) == row[key].shape
            }
            scaled: Any = normalizer.normalize_obs({**row, **last})
            # What another wrapper has changed since is not what the policy saw.
            same = {key for key in last if np.array_equal(scaled[key], seen[key])}
            for key in same:
                next_obs[key][env_idx] = last[key]
            self._warn_if_clipped(normalizer, {key: seen[key] for key in seen if key not in same})
        return next_obs

    def _warn_if_clipped(self, normalizer: VecNormalize, seen: dict[str, np.ndarray]) -> None:
        """Warn, once, where VecNormalize has clipped what is stored of a last observation."""
        if self._warned_of_clipping or not normalizer.norm_obs:
            return
        limit = np.float32(normalizer.clip_obs)
        for key in normalizer.norm_obs_keys or ():
            if key in seen and (np.abs(seen[key]) >= limit).any():
                self._warned_of_clipping = True
                warnings.warn(
                    f"VecNormalize has clipped {key!r} of an episode's last observation at "
                    f"clip_obs {limit:g}, and so it is stored: nothing told it as it was. Put the "
                    "environment into ImaginedGoalWrapper or ReachFirstWrapper with its time limit "
                    "and what changes observations inside, or raise clip_obs",
                    stacklevel=4,
                )
                return

    def _executed(self, chosen: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """Return what was executed in place of the actions chosen, both scaled (n_envs, d)."""
        shape = self.action_space.shape
        assert shape is not None
        if any(GIVEN in info for info in infos):
            given = self._scaled(told(infos, GIVEN, shape))
            if not np.allclose(given, chosen, rtol=0.0, atol=1e-4):
                raise ValueError(
                    "a wrapper outside of ReachFirstWrapper changes the actions on their way to "
                    "it, so what it tells to have executed is none of the policy's: put "
                    "ReachFirstWrapper outside of that wrapper"
                )
        return self._scaled(told(infos, EXECUTED, shape))

    def _scaled(self, actions: np.ndarray) -> np.ndarray:
        """Scale an environment's actions (n_envs, action_dim) to [-1, 1], as they are stored."""
        assert isinstance(self.action_space, spaces.Box)
        low, high = self.action_space.low, self.action_space.high
        return 2.0 * (actions - low) / (high - low) - 1.0

    def _end_finished(self, done: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """End the episodes that the step ended; drop those that are not to be sampled."""
        for env_idx in done.nonzero()[0]:
            n_steps = (self.pos - self._current_ep_start[env_idx]) % self.buffer_size
            lost = self._has_lost_steps(int(env_idx), infos[env_idx], int(n_steps))
            if "diverged" in infos[env_idx] or lost:
                self._current_ep_start[env_idx] = self.pos
            else:
                self._compute_episode_length(int(env_idx))
        if self.full:  # one that is as long as the buffer would overwrite itself
            for env_idx in ((self._current_ep_start == self.pos) & ~done).nonzero()[0]:
                self._compute_episode_length(int(env_idx))

    def _has_lost_steps(self, env_idx: int, info: Mapping[str, Any], n_stored: int) -> bool:
        """Whether an episode that ends had other steps than its `reset` took and were stored."""
        counted = counted_steps(info)
        before = self._in_reset.get(env_idx, 0)
        if counted is None or (counted == n_stored and not before):
            return False
        # The environment stands where the next episode begins. Most take no steps in `reset`, so
        # that one is asked after its first surprise, which is judged by the next episode's.
        after = steps_in_reset(self.env, env_idx)
        self._in_reset = {**self._in_reset, env_idx: after}
        return lost_steps(counted - (before or after), n_stored)

    def end_episodes(self, env_indices: np.ndarray | None = None) -> None:
        """End running episodes where they stand, as a time limit would: they are sampled then.

        Args:
            env_indices: of the environments, by default all, (n,) int; where none runs, none ends.
        """
        for env_idx in range(self.n_envs) if env_indices is None else env_indices:
            # One as long as the buffer would start here too, but the step that filled it ended it.
            if self._current_ep_start[env_idx] != self.pos:
                self._compute_episode_length(int(env_idx))

    def reset(self) -> None:
        """Forget all steps and episodes, as a new buffer has none."""
        super().reset()
        self.table = EpisodeTable()
        self.n_added = 0
        self._in_reset = {}

    def _forget_episode(self, row: int) -> None:
        """Make an episode that is about to be overwritten invisible to sampling."""
        env_idx = self.table.env[row]
        slots = (self.table.start[row] + np.arange(self.table.length[row])) % self.buffer_size
        self.ep_length[slots, env_idx] = 0
        self.table.remove(row)

    def _compute_episode_length(self, env_idx: int) -> None:
        start = int(self._current_ep_start[env_idx])
        super()._compute_episode_length(env_idx)
        # An episode as long as the whole buffer starts and ends on the same slot.
        length = (self.pos - start) % self.buffer_size or self.buffer_size
        slots = (start + np.arange(length)) % self.buffer_size
        self.ep_length[slots, env_idx] = length
        origin = self.observations["achieved_goal"][start, env_idx]
        path = self.next_observations["achieved_goal"][slots, env_idx]
        if self.min_goal_distance > 0.0:
            distance = self.goal_space.distance(path, origin)
            self._far[slots, env_idx] = distance >= self.min_goal_distance
        if self.scene_distance > 0.0:
            self._amiss[slots, env_idx] = self._is_amiss(path, self.original_goals[start, env_idx])
        self.table.insert(start, env_idx, length, self._priority(origin, path))

    def _is_amiss(self, path: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Whether places (n, d) are where earlier episodes' goals lay, not by their own (d,)."""
        facts = self.table.facts[:_EPISODES]
        start, env_idx, *_ = facts[facts[:, 2] > 0].T
        goals = np.concatenate([self.original_goals[start, env_idx], goal[None]])
        distance = self.goal_space.distance
        nearest = distance(path[:, None], goals[None]).min(axis=1)
        own = distance(path, goal)
        amiss: np.ndarray = (nearest < self.scene_distance) & (own >= self.scene_distance)
        return amiss

    def _priority(self, origin: np.ndarray, path: np.ndarray) -> float:
        """Priority of an episode from where the achieved goal began (d,) and went (length, d)."""
        space = self.goal_space
        if space.distance(path, origin).max() <= self.moved_distance:
            return 0.0
        if self.moved_priority == "uniform":
            return 1.0
        before = np.concatenate([origin[None], path[:-1]])
        speed = space.distance(path, before) / self.step_seconds
        energy = GRAVITY * space.height(path) + 0.5 * speed**2  # a unit mass's
        gains = np.diff(energy, prepend=GRAVITY * space.height(origin))
        return float(np.clip(gains, 0.0, None).sum())

    def _draw(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        row, step = self.table.draw(n, self.rng)
        if self.moved_ratio > 0.0 and self.table.n_transitions(with_priority=True):
            chosen = np.flatnonzero(self.rng.random(n) < self.moved_ratio)
            row[chosen], step[chosen] = self.table.draw(len(chosen), self.rng, by_priority=True)
        return row, step

    def _flat(self, episode: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Indices slot * n_envs + environment (n,) of steps of episodes, facts (n, 4)."""
        slot = episode[:, 0] + step
        slot -= self.buffer_size * (slot >= self.buffer_size)
        return slot * self.n_envs + episode[:, 1]

    def sample_pairs(
        self, n: int, rng: np.random.Generator
    ) -> tuple[Gathered, Gathered, np.ndarray]:
        """Draw stored transitions, each with a later one of its episode or itself.

        Args:
            n: how many.
            rng: drawn from in place of the buffer's own generator.

        Returns:
            the transitions, the later ones, and how many steps later these are, (n,) int.
        """
        row, step = self.table.draw(n, rng)
        episode = self.table.facts.take(row, axis=0)
        later = rng.integers(episode[:, 2] - step)
        first, then = (self._flat(episode, at) for at in (step, step + later))
        return (
            self._gather(first, self._achieved_goals(first)),
            self._gather(then, self._achieved_goals(then)),
            later,
        )

    def check_first(self) -> None:
        """Raise a ValueError where the buffer cannot hold an episode of every environment.

        Not done as it is made: what is loaded only to act may have next to none.
        """
        steps = None if self.env is None else episode_steps(self.env)
        if steps is not None:
            check_buffer(self.buffer_size, self.n_envs, steps)

    def is_ready(self) -> bool:
        """Whether an episode has ended, so that there is something to draw from."""
        return self.table.n_transitions() > 0

    def check_ready(self) -> None:
        """Raise RuntimeError while there is nothing to draw from."""
        if self.is_ready():
            return
        if self.full:
            raise RuntimeError(
                "the replay buffer has forgotten its last finished episode while others run: let "
                f"buffer_size hold two episodes of every environment; it holds {self.buffer_size} "
                "steps of each"
            )
        raise RuntimeError(
            "the replay buffer holds no finished episode yet: set learning_starts to at least "
            "one episode of every environment; or, where a loaded model goes on with "
            "reset_num_timesteps=False, load its replay buffer too"
        )

    def moved_share(self) -> float:
        """Share of the stored transitions that belong to episodes in which the object moved."""
        total = self.table.n_transitions()
        return self.table.n_transitions(with_priority=True) / total if total else 0.0


def _for_one_goal(
    obs: dict[str, np.ndarray], next_obs: dict[str, np.ndarray], infos: list[dict[str, Any]]
) -> dict[str, np.ndarray]:
    """Next observations with the goal of the step, where the next step is for another."""
    rows = [row for row, info in enumerate(infos) if info.get(GOES_ON)]
    if not rows:
        return next_obs
    goals = np.array(next_obs["desired_goal"])
    goals[rows] = obs["desired_goal"][rows]
    return {**next_obs, "desired_goal": goals}
