"""What a step of every environment must be before it counts as stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, unwrap_vec_wrapper


def check_copies(n_envs: int, n_copies: int) -> None:
    """Raise a ValueError unless a replay buffer has places for as many copies as there are."""
    if n_envs != n_copies:
        raise ValueError(
            f"the replay buffer holds steps of {n_envs} environments; this one has {n_copies} "
            "copies"
        )


def check_actions(space: spaces.Space) -> None:
    """Raise a ValueError unless a space's actions can be scaled to [-1, 1], as they are stored."""
    if not isinstance(space, spaces.Box):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        width = np.subtract(space.high, space.low, dtype=np.result_type(space.dtype, np.float32))
    if not ((width > 0.0) & np.isfinite(width)).all():
        raise ValueError(
            "the action space must have finite bounds, each low below its high, to be scaled to "
            f"[-1, 1]; it is {space}"
        )


def check_two_valued(rewards: np.ndarray) -> None:
    """Raise a ValueError unless rewards (n,) are one of two, as `goal_margin` needs them."""
    if ((rewards != rewards.min()) & (rewards != rewards.max())).any():
        refuse_margin()


def refuse_margin() -> NoReturn:
    """Raise the ValueError of rewards that a `goal_margin` would scale."""
    raise ValueError(
        "goal_margin is for environments that pay by whether a goal is near enough; this one's "
        "compute_reward gives more than two rewards: set goal_margin to 0"
    )


def fitted(array: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return an array in a shape that holds as many numbers: nothing is broadcast.

    Raises:
        ValueError: it holds another number of them.
    """
    array = np.asarray(array)
    if array.size != int(np.prod(shape)):
        raise ValueError(f"{what} has the shape {array.shape}, not {shape}")
    return array.reshape(shape)


def told(infos: Sequence[Mapping[str, Any]], key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return what each environment's info says under a key, (n_envs, *shape).

    Raises:
        ValueError: an info lacks it, or it holds another number of numbers.
    """
    for env_idx, info in enumerate(infos):
        if key not in info:
            raise ValueError(
                f"every environment's info must hold {key!r}; that of environment {env_idx} does "
                "not"
            )
    return np.stack([fitted(info[key], shape, f"the info {key!r}") for info in infos])


def refuse_infinite(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise a ValueError that names the array and the environment of the first bad number.

    Args:
        arrays: what the sentence calls each -> (n_envs, ...).
    """
    for name, array in arrays.items():
        finite = np.isfinite(array)
        if not finite.all():
            index = np.argwhere(~finite)[0, 0]
            raise ValueError(f"{name} of environment {index} holds NaN or infinity in float32")


def same_bytes(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether arrays hold the same bytes: in a third of the time that `==` and `all` take."""
    return a.dtype == b.dtype and a.tobytes() == b.tobytes()


def counted_steps(info: Mapping[str, Any]) -> int | None:
    """Steps that SB3's Monitor counted in an episode that ends; None without one."""
    return (info.get("episode") or {}).get("l")


def lost_steps(n_taken: int, n_stored: int) -> bool:
    """Whether other steps were taken in an episode than were stored.

    An algorithm of SB3 whose `learn` is stopped in the middle of a step does not store it, and goes
    on from the observation before it where `reset_num_timesteps` is False: what it stores next
    never happened. A count of half as many again or more is that of a wrapper which repeats
    actions or ends episodes in parts.
    """
    return n_taken != n_stored and n_taken < 1.5 * n_stored


def steps_in_reset(env: VecEnv | None, env_idx: int) -> int:
    """Steps that a Monitor has counted in an episode which stands at its first observation.

    They are those that a wrapper outside of it takes in `reset`, to let things settle; 0 where
    no monitor tells.
    """
    if env is None:
        return 0
    monitor = unwrap_vec_wrapper(env, VecMonitor)
    if monitor is not None:
        return int(monitor.episode_lengths[env_idx])
    # SB3's Monitor lists an episode's rewards, Gymnasium's RecordEpisodeStatistics counts steps.
    for name, kind in (("rewards", list), ("episode_lengths", int)):
        try:
            (count,) = env.get_attr(name, indices=[env_idx])
        except (AttributeError, OSError, EOFError):  # not there, or closed
            continue
        if isinstance(count, kind):
            return len(count) if isinstance(count, list) else count
    return 0
