"""Copies of a training's environment that show h_max and differ in nothing else.

What runs in this process is copied layer by layer, whoever put the layers there and whatever was
set in them since. Environments of others may hold what cannot be copied, such as a simulator's
handle: they are made again from gymnasium's spec, and then compared with the original.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec, load_env_creator
from gymnasium.utils import EzPickle
from gymnasium.wrappers import HumanRendering, RecordVideo
from gymnasium.wrappers.utils import RunningMeanStd
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from ..common.reports import named_reason
from ..envs.faces import BatchVecEnv, SingleEnv
from ..imagination.curriculum import Curriculum
from ..imagination.vec_env import ImaginedGoalVecEnv, imagination_of
from ..imagination.wrapper import ImaginedGoalWrapper
from ..reach.vec_env import ReachFirstVecEnv
from ..reach.wrapper import ReachFirstWrapper

# They watch, some into files, and change nothing that a policy or a replay buffer sees.
_WATCHERS = (Monitor, RecordVideo, HumanRendering)
# The same; and observations are normalised by the model's own VecNormalize.
_VEC_WATCHERS = (VecMonitor, VecVideoRecorder, VecNormalize)
# What acts for the learner in training has no place in a test.
_HELPERS = (ReachFirstWrapper,)
_VEC_HELPERS = (ReachFirstVecEnv,)
_ASKER = "CurriculumCallback without a test_env"

Memo = dict[int, Any]  # of copy.deepcopy: what stands for an object, by the object's id


def copies_for_tests(training_env: VecEnv) -> VecEnv:
    """Return as many copies of the training's environment, which show h_max of its curriculum.

    Predictor and curriculum are the training's own. An environment that is drawn in a window is
    not drawn in a copy.

    Raises:
        ValueError: a part of the environment cannot be copied, or it imagines no goals.
    """
    predictor, curriculum = imagination_of(training_env, _ASKER)
    shared: Memo = {id(thing): thing for thing in (predictor, curriculum)}
    return _copy_vec_env(training_env, shared, curriculum)


def _copy_vec_env(env: VecEnv, memo: Memo, curriculum: Curriculum) -> VecEnv:
    if isinstance(env, VecEnvWrapper):
        inner = memo[id(env.venv)] = _copy_vec_env(env.venv, memo, curriculum)
        if isinstance(env, (*_VEC_WATCHERS, *_VEC_HELPERS)):
            return inner
        memo[id(env.class_attributes)] = env.class_attributes  # SB3's notes on the class
        twin = _copy_contents(env, memo)
        if isinstance(twin, ImaginedGoalVecEnv):
            twin.mode = "test"
        return twin
    if isinstance(env, BatchVecEnv):
        return _without_window(_copy(env, memo))
    if isinstance(env, DummyVecEnv):
        for one in env.envs:
            memo[id(one)] = _copy_env(one, memo, curriculum)
        return _copy_contents(env, memo)
    if isinstance(env, SubprocVecEnv):
        return _remade_from_processes(env, curriculum)
    raise _cannot(type(env).__name__, "it is a VecEnv of an unknown kind")


def _copy_env(env: gym.Env, memo: Memo, curriculum: Curriculum) -> gym.Env:
    """Copy one environment of this process with all its wrappers."""
    if not isinstance(env, gym.Wrapper):
        return _copy_base(env, memo)
    inner = memo[id(env.env)] = _copy_env(env.env, memo, curriculum)
    if isinstance(env, (*_WATCHERS, *_HELPERS)):
        return inner
    if any(isinstance(value, RunningMeanStd) for value in vars(env).values()):
        reason = "it keeps statistics of its own that a copy would not follow; VecNormalize would"
        raise _cannot(type(env).__name__, reason)
    if not isinstance(env, ImaginedGoalWrapper):
        return _copy(env, memo)
    for ours, theirs in ((env.predictor, env.predictor), (env.curriculum, curriculum)):
        memo[id(ours)] = theirs
    twin = _copy(env, memo)
    twin.mode, twin.active = "test", True
    return twin


def _copy_base(env: gym.Env, memo: Memo) -> gym.Env:
    if isinstance(env, SingleEnv):
        return _without_window(_copy(env, memo))
    spec = getattr(env, "spec", None)
    if spec is None:
        raise _cannot(type(env).__name__, "gymnasium.make did not make it")
    made = _make(spec)
    twin = made.unwrapped
    _check_alike(type(env).__name__, made, lambda: _settings(twin), _settings(env))
    return twin


def _remade_from_processes(env: SubprocVecEnv, curriculum: Curriculum) -> VecEnv:
    """Make environments again, here, from what those of other processes tell of themselves."""
    copies = []
    for index, spec in enumerate(env.get_attr("spec")):
        if spec is None:
            reason = "gymnasium.make did not make it"
            raise _cannot("an environment of another process", reason)
        twin = _make(replace(spec, additional_wrappers=()))
        for layer in spec.additional_wrappers:
            twin = _rewrapped(twin, layer, env, curriculum)
        names = [name for name in _reachable(twin) if env.has_attr(name)]
        theirs = {name: env.get_attr(name, indices=[index])[0] for name in names}
        _check_alike(spec.id, twin, lambda twin=twin: _reachable(twin), theirs)  # type: ignore[misc]
        copies.append(_without_window(twin))
    return DummyVecEnv([lambda one=one: one for one in copies])  # type: ignore[misc]


def _rewrapped(
    env: gym.Env, layer: WrapperSpec, training_env: VecEnv, curriculum: Curriculum
) -> gym.Env:
    """Put a wrapper of another process around a copy."""
    try:
        wrapper: Any = load_env_creator(layer.entry_point)
    except (AttributeError, ImportError) as error:
        raise _cannot(layer.name, f"its class cannot be imported here ({error})") from error
    if wrapper is ImaginedGoalWrapper:
        predictor, _ = imagination_of(training_env, _ASKER)
        wrapped = ImaginedGoalWrapper(env, predictor, curriculum)
        wrapped.mode = "test"
        return wrapped
    if issubclass(wrapper, (*_WATCHERS, *_HELPERS)):
        return env
    if layer.kwargs is None:
        reason = "it is in another process and no gymnasium.utils.RecordConstructorArgs"
        raise _cannot(layer.name, reason)
    return wrapper(env=env, **layer.kwargs)


def _make(spec: EnvSpec) -> gym.Env:
    """Make an environment as a spec says, without a window."""
    windowless = {"render_mode": None} if spec.kwargs.get("render_mode") == "human" else {}
    try:
        return gym.make(spec, **windowless)
    except Exception as error:  # an environment of somebody's may raise anything
        raise _cannot(spec.id, f"making it again failed ({named_reason(error)})") from error


def _copy(env: Any, memo: Memo) -> Any:
    """Copy an environment or a wrapper, inside which all is copied already."""
    try:
        twin = copy.deepcopy(env, memo)
    except Exception as error:  # what somebody's holds may raise anything
        raise _cannot(type(env).__name__, named_reason(error)) from error
    if isinstance(env, EzPickle):  # made again from its arguments
        _check_alike(type(env).__name__, twin, lambda: _settings(twin), _settings(env))
    return twin


def _copy_contents(env: Any, memo: Memo) -> Any:
    """Copy a VecEnv attribute by attribute: SB3's own wrappers know no other way."""
    twin = memo[id(env)] = object.__new__(type(env))
    try:
        vars(twin).update(copy.deepcopy(vars(env), memo))
    except Exception as error:
        raise _cannot(type(env).__name__, named_reason(error)) from error
    return twin


def _without_window(env: Any) -> Any:
    if env.unwrapped.render_mode == "human":
        env.unwrapped.render_mode = None
    return env


def _settings(thing: Any) -> dict[str, Any]:
    """The public attributes of an environment or wrapper that are plain values."""
    return {
        name: copy.deepcopy(value)
        for name, value in vars(thing).items()
        if not name.startswith("_") and name != "render_mode" and _is_plain(value)
    }


def _reachable(env: gym.Env) -> dict[str, Any]:
    """The same of an environment and all its wrappers, as get_attr finds them from outside."""
    found: dict[str, Any] = {}
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, ImaginedGoalWrapper):
            found = {**_settings(env), **found}
        env = env.env
    return {**_settings(env), **found}


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_is_plain(one) for one in (*value.keys(), *value.values()))
    if isinstance(value, list | tuple):
        return all(_is_plain(one) for one in value)
    if isinstance(value, np.ndarray):
        return value.dtype != object
    return value is None or isinstance(value, bool | int | float | str | np.generic)


def _equal(one: Any, other: Any) -> bool:
    try:
        np.testing.assert_equal(one, other)  # goes into lists and dicts, and NaN equals NaN
    except (AssertionError, TypeError, ValueError):
        return False
    return True


def _check_alike(
    what: str, twin: gym.Env, read: Callable[[], Mapping[str, Any]], theirs: Mapping[str, Any]
) -> None:
    """Refuse an environment that was made again and has other settings than the original.

    What changes while the twin is played is no setting.

    Args:
        what: is copied.
        twin: what was made.
        read: reads the twin's plain values.
        theirs: the original's.
    """
    ours = read()
    other = [name for name in theirs if name not in ours or not _equal(ours[name], theirs[name])]
    if not other:
        return
    _play(twin)
    later = read()
    other = [
        name
        for name in other
        if name not in later or (name in ours and _equal(ours[name], later[name]))
    ]
    if other:
        name = other[0]
        reason = f"its {name}, {theirs[name]!r}, was set after it was made"
        raise _cannot(what, reason)


def _play(env: gym.Env, steps: int = 10) -> None:
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


def _cannot(what: str, reason: str) -> ValueError:
    return ValueError(
        f"CurriculumCallback cannot copy {what} of the training's environment ({reason}): give it "
        "a test_env with the same wrappers and settings, without VecNormalize."
    )
