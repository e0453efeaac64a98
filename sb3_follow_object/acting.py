"""Exploring with an actor while the one that learns is still being updated."""

from __future__ import annotations

import copy

import numpy as np
import torch as th
from stable_baselines3.td3.policies import Actor


class EarlierActor:
    """A copy of an actor as it was when `follow` was called last.

    On CUDA it is asked on a stream of its own, so that asking waits for no update of the actor
    that was begun since.

    Args:
        actor: to copy; its weights and moments of inputs.
    """

    def __init__(self, actor: Actor) -> None:
        self.actor = copy.deepcopy(actor)
        del self.actor.optimizer
        self.actor.requires_grad_(False)
        on_gpu = actor.device.type == "cuda"
        # Of high priority: asked in the midst of updates, it goes first.
        self._stream = th.cuda.Stream(actor.device, priority=-1) if on_gpu else None

    @th.no_grad()
    def follow(self, actor: Actor) -> None:
        """Become equal to an actor as the work given to the GPU so far leaves it."""
        ours, theirs = ([*each.parameters(), *each.buffers()] for each in (self.actor, actor))
        th._foreach_copy_(ours, theirs)
        if self._stream is not None:
            self._stream.wait_stream(th.cuda.current_stream(actor.device))

    def act(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        """Deterministic actions (n_envs, action_dim) in the space's units."""
        with th.cuda.stream(self._stream):
            return self.actor.predict(observations, deterministic=True)[0]
