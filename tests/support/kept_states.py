"""States of the object's stage that a run could be resumed from."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_follow_object.object_stage.policy import StopWhenSolved


class _Keep(BaseCallback):
    def __init__(self, solved: StopWhenSolved, states: list[dict[str, Any]]) -> None:
        super().__init__()
        self.solved = solved
        self.states = states

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.states.append(copy.deepcopy(self.solved.state_dict()))


def keeping(states: list[dict[str, Any]]) -> Callable[[StopWhenSolved], BaseCallback]:
    """Return what `learn_predictor` takes as callback: each rollout's state goes into the list."""
    return lambda solved: _Keep(solved, states)
