"""Replay on the learner's device: drawn, relabelled and rewarded there, nothing copied a batch."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from ..common.answers import one_each
from ..common.copies import WholeCopies
from ..common.torch_helpers import own
from ..envs.tasks import SUCCESS_DISTANCE
from .her_replay_buffer import FollowObjectReplayBuffer
from .record_buffer import ACHIEVED, DESIRED, HALVES, NEXT_DESIRED
from .records import Records
from .steps import refuse_margin

_PROBES = 1000  # transitions that an environment's reward is compared on
_FAR = 0.01, 50.0  # metres apart that every second of them is, on a logarithmic scale
_TIE = 1e-5  # metres from the threshold in which rounding may decide


class DistanceReward:
    """The rewards of goal environments that look at a distance only.

    Args:
        threshold: metres; 0 within it, else -1. None: minus the distance.
    """

    def __init__(self, threshold: float | None) -> None:
        self.threshold = threshold

    def __call__(self, achieved: th.Tensor, desired: th.Tensor) -> th.Tensor:
        """Rewards (n,) of goals achieved for goals desired, (n, d) each."""
        distance = (achieved - desired).square().sum(dim=-1).sqrt()
        return -distance if self.threshold is None else -(distance > self.threshold).float()

    @classmethod
    def of(cls, env: VecEnv, goal_size: int) -> DistanceReward:
        """Return what an environment's `compute_reward` computes, found by asking it.

        Raises:
            ValueError: it computes something else.
        """
        threshold = SUCCESS_DISTANCE
        if env.has_attr("distance_threshold"):  # Gymnasium-Robotics
            threshold = float(env.get_attr("distance_threshold", indices=[0])[0])
        rng = np.random.default_rng(0)
        desired = rng.uniform(-1.0, 1.0, (_PROBES, goal_size)).astype(np.float32)
        way = rng.normal(size=desired.shape)
        distance = rng.uniform(0.0, 4.0 * threshold, (_PROBES, 1))
        nearest, farthest = np.log(_FAR)
        distance[1::2] = np.exp(rng.uniform(nearest, farthest, distance[1::2].shape))
        way *= distance / np.linalg.norm(way, axis=1, keepdims=True)
        achieved = desired + way.astype(np.float32)
        infos: list[dict[str, Any]] = [{}] * _PROBES
        answer = one_each(
            env.env_method("compute_reward", achieved, desired, infos, indices=[0])[0],
            _PROBES,
            "the environment's compute_reward",
        )
        clear = np.abs(distance[:, 0] - threshold) > _TIE
        for candidate in (cls(threshold), cls(None)):
            rewards = candidate(th.from_numpy(achieved), th.from_numpy(desired)).numpy()
            if np.allclose(answer[clear], rewards[clear], rtol=1e-5, atol=1e-5):
                return candidate
        raise ValueError(
            "replay on the device can compute rewards of 0 within a distance and -1 beyond, or "
            "minus the distance; this environment's compute_reward gives others"
        )


def device_replay_of(buffer: Any, device: th.device, wanted: bool | None) -> DeviceReplay | None:
    """Return a copy of a replay buffer on the learner's device, if it is wanted and possible.

    Args:
        buffer: of the algorithm.
        device: of the learner.
        wanted: None, on CUDA only and where it is possible; True, else an error.

    Raises:
        ValueError: it is wanted and not possible.
    """
    if wanted is False or (wanted is None and device.type != "cuda"):
        return None
    try:
        return DeviceReplay(buffer, device, np.random.randint(2**31))
    except ValueError as error:
        if wanted:
            raise
        warnings.warn(f"Replay stays on the host: {error}.", stacklevel=3)
        return None


class DeviceReplay(WholeCopies):
    """A copy of a replay buffer on a device, sampled there with a generator of its own.

    What was stored since the last `refresh` is uploaded in one piece. Distribution and rewards are
    the buffer's; the draws are not, as the generators differ.

    Args:
        buffer: stays the place where transitions are stored and saved.
        device: where the copy lies.
        seed: of the generator.

    Raises:
        ValueError: the buffer has a setting or an environment that needs the host.
    """

    def __init__(self, buffer: FollowObjectReplayBuffer, device: th.device, seed: int) -> None:
        self.device = device
        self._env: VecEnv | None = None
        self._take(buffer)
        self.generator = th.Generator(device).manual_seed(seed)
        self._lists: dict[bool, tuple[Any, th.Tensor, th.Tensor]] = {}

    def _take(self, buffer: FollowObjectReplayBuffer) -> None:
        """Make room for a buffer and find out what its environment pays."""
        self._check(buffer)
        assert buffer.achieved is not None
        self._follow_env(buffer)
        self._buffer = buffer
        self._seen = (-1, 0)  # the buffer's revision and time-steps at the last refresh
        self._records = self._room_for(buffer.records)
        self._achieved = self._room_for(buffer.achieved)

    def _follow_env(self, buffer: FollowObjectReplayBuffer) -> None:
        if buffer.env is None:
            raise ValueError("the replay buffer has no environment: call set_env() after loading")
        goal_size = buffer.observations["desired_goal"].shape[-1]
        self.reward = DistanceReward.of(buffer.env, goal_size)
        if buffer.goal_margin > 0.0 and self.reward.threshold is None:
            refuse_margin()
        self._env = buffer.env

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._records, self._achieved = own(self._records), own(self._achieved)

    @staticmethod
    def _check(buffer: Any) -> None:
        if not isinstance(buffer, FollowObjectReplayBuffer):
            raise ValueError("replay on the device needs a FollowObjectReplayBuffer")
        keys = {f"{half}.{key}" for half in HALVES for key in buffer.observations}
        stored = {*buffer.records.views(), ACHIEVED, NEXT_DESIRED}
        reasons = {
            "imagined_ratio > 0": buffer.imagined_ratio > 0.0,
            "scene_distance > 0": buffer.scene_distance > 0.0,
            "cher": buffer.selection is not None,
            "reward_function": buffer.reward_function is not None,
            "copy_info_dict": buffer.copy_info_dict,
            "sample of a subclass": samples_otherwise(buffer),
            "observations that are not vectors of floats": buffer.achieved is None
            or not keys <= stored,
            "actions that are not floats": "actions" not in stored,
        }
        for reason, holds in reasons.items():
            if holds:
                raise ValueError(f"replay on the device has no {reason}; replay on the host has")

    def _room_for(self, records: Records) -> th.Tensor:
        n_slots, n_envs, width = records.array.shape
        return th.zeros((n_slots * n_envs, width), dtype=th.float32, device=self.device)

    def refresh(self, buffer: Any) -> None:
        """Take over what the buffer holds; it and its environment may be others than before.

        Raises:
            ValueError: it has a setting or an environment that needs the host, or holds an episode
                whose goal moved.
            RuntimeError: it holds no finished episode.
        """
        if buffer is not self._buffer:
            self._take(buffer)
        elif buffer.env is not self._env:
            self._follow_env(buffer)
        buffer.check_ready()
        if not buffer.goals_are_shared:
            raise ValueError(
                "replay on the device needs goals that are the same before and after a step; "
                "set replay_on_device to False"
            )
        assert buffer.achieved is not None
        revision, n_steps = self._seen
        new = buffer.n_added - n_steps
        if buffer.revision != revision or new >= buffer.buffer_size:
            parts = [(0, buffer.buffer_size if buffer.full else buffer.pos)]
        elif new <= buffer.pos:
            parts = [(buffer.pos - new, buffer.pos)]
        else:
            parts = [(0, buffer.pos), (buffer.pos - new + buffer.buffer_size, buffer.buffer_size)]
        for first, last in parts:
            rows = slice(first * buffer.n_envs, last * buffer.n_envs)
            for copy, records in (
                (self._records, buffer.records),
                (self._achieved, buffer.achieved),
            ):
                array = records.array[first:last].reshape(-1, copy.shape[1])
                copy[rows].copy_(th.from_numpy(array))
        self._seen = (buffer.revision, buffer.n_added)
        for by_priority in (False, True):
            self._refresh_list(by_priority)

    def _refresh_list(self, by_priority: bool) -> None:
        episodes = self._buffer.table.draw_list(by_priority)
        if by_priority not in self._lists or self._lists[by_priority][0] is not episodes:
            facts = self._buffer.table.facts[episodes.rows, :3].astype(np.int64)
            self._lists[by_priority] = (
                episodes,
                th.from_numpy(episodes.ends).to(self.device),
                th.from_numpy(facts).to(self.device),
            )

    def sample_with_steps(self, n: int) -> tuple[DictReplayBufferSamples, th.Tensor]:
        """Draw and relabel as `FollowObjectReplayBuffer.sample_with_steps` does.

        Every step works on all n transitions, so no size has to come back to the host.

        Args:
            n: number of transitions.
        """
        buffer = self._buffer
        episode, step = self._draw(n)
        flat = self._flat(episode, step)
        fields = buffer.records.fields(self._records.index_select(0, flat))
        achieved = self._achieved_goals(flat)

        length = episode[:, 2]
        strategy = buffer.goal_selection_strategy
        if strategy == GoalSelectionStrategy.FINAL:
            chosen = length - 1
        elif strategy == GoalSelectionStrategy.FUTURE:
            chosen = step + self._below(length - step)
        else:
            chosen = self._below(length)
        goal = self._achieved_goals(self._flat(episode, chosen))
        virtual = self._uniform(n) < buffer.her_ratio
        if buffer.min_goal_distance > 0.0:
            first = self._flat(episode, th.zeros_like(step))
            origins = buffer.records.fields(self._records)["observations.achieved_goal"]
            distance = buffer.goal_space.distance(goal, origins.index_select(0, first))
            virtual &= distance >= buffer.min_goal_distance

        desired = th.where(virtual[:, None], goal, fields[DESIRED])
        fields |= {DESIRED: desired, NEXT_DESIRED: desired, ACHIEVED: achieved}
        if buffer.goal_margin > 0.0:
            judged = buffer.goal_space.as_with_margin(achieved, desired, buffer.goal_margin)
            rewards = self.reward(judged, desired)
        else:
            rewards = th.where(virtual, self.reward(achieved, desired), fields["rewards"])
        later = (chosen - step).float()
        steps = th.where(virtual & (later >= 0.0), later, th.inf)
        obs, next_obs = (
            {key: fields[f"{half}.{key}"] for key in buffer.observations} for half in HALVES
        )
        samples = DictReplayBufferSamples(
            observations=obs,
            actions=fields["actions"],
            next_observations=next_obs,
            dones=(fields["dones"] * (1.0 - fields["timeouts"]))[:, None],
            rewards=rewards[:, None],
        )
        return samples, steps[:, None]

    def _draw(self, n: int) -> tuple[th.Tensor, th.Tensor]:
        """Start, environment and length of episodes (n, 3), and steps within them (n,)."""
        episode = self._episodes(n, by_priority=False)
        if self._buffer.moved_ratio > 0.0 and len(self._lists[True][1]):
            moved = self._uniform(n) < self._buffer.moved_ratio
            episode = th.where(moved[:, None], self._episodes(n, by_priority=True), episode)
        return episode, self._below(episode[:, 2])

    def _episodes(self, n: int, by_priority: bool) -> th.Tensor:
        _, ends, facts = self._lists[by_priority]
        row = th.searchsorted(ends, self._uniform(n) * ends[-1], right=True)
        return facts.index_select(0, row.clamp_(max=len(ends) - 1))

    def _uniform(self, n: int) -> th.Tensor:
        return th.rand(n, generator=self.generator, device=self.device, dtype=th.float64)

    def _below(self, high: th.Tensor) -> th.Tensor:
        """Whole numbers (n,) from 0 up to but not including `high` (n,)."""
        return (self._uniform(len(high)) * high).long().clamp_(max=high - 1)

    def _flat(self, episode: th.Tensor, step: th.Tensor) -> th.Tensor:
        slot = (episode[:, 0] + step) % self._buffer.buffer_size
        return slot * self._buffer.n_envs + episode[:, 1]

    def _achieved_goals(self, flat: th.Tensor) -> th.Tensor:
        assert self._buffer.achieved is not None
        return self._buffer.achieved.fields(self._achieved.index_select(0, flat))[ACHIEVED]


def samples_otherwise(buffer: Any) -> bool:
    """Whether a buffer's batches come from a `sample` that knows nothing of steps to goals."""
    ours, kind = FollowObjectReplayBuffer, type(buffer)
    if not issubclass(kind, ours):
        return True
    return kind.sample is not ours.sample and kind.sample_with_steps is ours.sample_with_steps
