"""Copying SB3's VecEnvs, which copy and pickle know nothing of."""

from __future__ import annotations

import copyreg
import inspect
from functools import cache
from typing import Any, NoReturn

from stable_baselines3.common.vec_env import (
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecTransposeImage,
)

from .copies import WholeCopies

_WRAPPERS: tuple[Any, ...] = (
    VecCheckNan,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecTransposeImage,
)


@cache
def let_vec_envs_be_copied() -> None:
    """Tell copy and pickle how SB3's wrappers are copied, and that processes are not."""
    for wrapper in _WRAPPERS:
        copyreg.pickle(wrapper, reduce_vec_wrapper)
    copyreg.pickle(SubprocVecEnv, _refuse)


def reduce_vec_wrapper(env: VecEnvWrapper) -> tuple[Any, ...]:
    """Reduce a VecEnvWrapper as copy and pickle want it.

    SB3's keep what there is in their class, which nothing can copy and no copy needs.

    Raises:
        ValueError: it writes into a file.
    """
    if getattr(env, "results_writer", None) is not None:
        raise ValueError(
            "a VecMonitor with a filename cannot be copied, as two would write into one file: leave"
            " the filename out, or copy what is inside"
        )
    contents = {name: value for name, value in vars(env).items() if name != "class_attributes"}
    return _vec_wrapper, (type(env), contents)


class CopyableVecEnvWrapper(WholeCopies, VecEnvWrapper):
    """A VecEnvWrapper that copy and pickle can copy."""

    def __reduce__(self) -> tuple[Any, ...]:
        return reduce_vec_wrapper(self)


def _vec_wrapper(kind: type[VecEnvWrapper], contents: dict[str, Any]) -> VecEnvWrapper:
    env = kind.__new__(kind)
    vars(env).update(contents, class_attributes=dict(inspect.getmembers(kind)))
    return env


def _refuse(env: SubprocVecEnv) -> NoReturn:
    raise ValueError(
        "a SubprocVecEnv runs processes, which cannot be copied: copy with a DummyVecEnv, or save "
        "the model and load it with another environment"
    )
