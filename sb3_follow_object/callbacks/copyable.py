"""Callbacks that can be copied and pickled, also after a training."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from ..common.copies import WholeCopies


class CopyableCallback(WholeCopies, BaseCallback):
    """SB3's callback without the variables of the training loop, which a training brings anew.

    Copied together with its model, or in one pickle, it belongs to the model's copy.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "locals": {}, "globals": {}}
