"""Sizes that only make sense together, looked at before anything runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..any_task.tasks import steps_of_object
from ..common.numbers import checked_whole
from ..envs import IDS
from .fields import settings_of
from .learning import AlgorithmSettings
from .run_config import RunConfig
from .stages import CurriculumSettings, StageSettings


def check_buffer(slots: int, n_envs: int, horizon: int, where: str = "") -> None:
    """Raise a ValueError unless a replay buffer holds an episode of every environment.

    Args:
        slots: steps of each environment that it holds, buffer_size // n_envs.
        n_envs: environments.
        horizon: T, steps of an episode.
        where: beginning of the sentence.
    """
    if slots < horizon:
        raise ValueError(
            f"{where}buffer_size leaves {slots} steps for each of {n_envs} environments, fewer "
            f"than the {horizon} of an episode; it must be at least {n_envs * horizon}"
        )


def check_sizes(config: RunConfig) -> None:
    """Raise a ValueError for a new run's settings that are fine alone but not together."""
    horizon = IDS[config.env_id][0].horizon if config.env_id in IDS else None
    check_stages(config.env_id, config.settings, horizon)


def idle_robot(config: RunConfig) -> str:
    """Return a sentence about a run too short for its robot to learn, "" otherwise.

    Such a run is a try of all its parts, with the settings of a long one.
    """
    starts = (config.settings.get("algorithm") or {}).get("learning_starts", 0)
    if starts < config.total_timesteps:
        return ""
    return (
        f"learning_starts is {starts} and n_timesteps {config.total_timesteps}: the robot will act "
        "at random and learn nothing"
    )


def check_stages(env_id: str, given: Mapping[str, Any], horizon: int | None) -> None:
    """Raise a ValueError for settings of the stages that are fine alone but not together.

    Args:
        env_id: the task. What an episode's end decides is told of this package's own alone, whose
            episodes all have the same length.
        given: settings of `FollowObject`.
        horizon: T, steps of the robot's episodes; None where that is not known.
    """
    settings = {**_defaults(StageSettings), **given}
    whole = env_id in IDS
    of_object = None if horizon is None else steps_of_object(env_id, horizon)
    _check_algorithm(settings["algorithm"], settings["n_envs"], horizon, whole, "")
    if _has_object_stage(settings):
        where, n_envs = "object_algorithm: ", settings["object_n_envs"]
        _check_algorithm(settings["object_algorithm"], n_envs, of_object, whole, where)
        _check_object(settings["object_algorithm"] or {}, settings["object_timesteps"])
    if settings["imagine"]:
        curriculum = {**_defaults(CurriculumSettings), **(settings["curriculum"] or {})}
        levels = of_object if curriculum["levels"] == "time" else curriculum["n_levels"]
        checked_whole("curriculum: k_max", curriculum["k_max"], 1, levels)


def _has_object_stage(settings: Mapping[str, Any]) -> bool:
    auxiliary = (settings["algorithm"] or {}).get("auxiliary") or {}
    return bool(settings["imagine"]) or auxiliary.get("name") == "sldr"


def _check_algorithm(
    given: Mapping[str, Any] | None, n_envs: int, horizon: int | None, whole: bool, where: str
) -> None:
    settings = {**_defaults(AlgorithmSettings), **(given or {})}
    size, batch, starts = (settings[n] for n in ("buffer_size", "batch_size", "learning_starts"))
    if batch > size:
        raise ValueError(f"{where}batch_size is {batch}; it must be at most buffer_size, {size}")
    if horizon is None:
        return
    check_buffer(size // n_envs, n_envs, horizon, where)
    frequency = settings["train_freq"]
    steps, unit = frequency if isinstance(frequency, tuple) else (frequency, "step")
    # SB3 learns after the first rollout that brings it beyond learning_starts.
    rollouts = starts // (steps * n_envs) + 1
    if whole and unit == "step" and steps * rollouts < horizon:
        raise ValueError(
            f"{where}learning_starts is {starts}; with train_freq {steps} and {n_envs} "
            f"environments it must be at least {n_envs * horizon}, for before the end of an "
            "episode there is nothing to learn from"
        )


def _check_object(given: Mapping[str, Any], total: int) -> None:
    """Raise a ValueError for an object that never learns, or whose networks no file can hold."""
    starts = given.get("learning_starts", AlgorithmSettings.learning_starts)
    if starts >= total:
        raise ValueError(
            f"object_algorithm: learning_starts is {starts}; it must be less than "
            f"object_timesteps, {total}, or nothing is learned"
        )
    net_arch = (given.get("policy_kwargs") or {}).get("net_arch")
    for widths in net_arch.values() if isinstance(net_arch, dict) else [net_arch]:
        if widths == []:
            raise ValueError(
                "object_algorithm: policy_kwargs: net_arch is without a hidden layer; the object's "
                "networks must have at least one"
            )


def _defaults(group: type) -> dict[str, Any]:
    return {each.field: each.default for each in settings_of(group).values()}
