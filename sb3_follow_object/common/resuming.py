"""What a training needs besides its networks and its replay to go on as if never stopped."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv


def env_state(env: VecEnv) -> Any:
    """Return the state of an environment that can tell it, else None.

    What wraps one that cannot has a state that nothing goes on from.
    """
    if not hasattr(env.unwrapped, "get_state"):
        return None
    return env.get_state() if hasattr(env, "get_state") else None


def set_env_state(env: VecEnv, state: Any) -> None:
    """Let an environment go on from `env_state`; without one it is left as it is."""
    if state is not None:
        env.set_state(state)  # type: ignore[attr-defined]


def global_generators() -> dict[str, Any]:
    """Return the state of NumPy's and PyTorch's global random generators."""
    return {"numpy": np.random.get_state(), "torch": th.get_rng_state()}


def set_global_generators(state: dict[str, Any]) -> None:
    """Go on from `global_generators`."""
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
