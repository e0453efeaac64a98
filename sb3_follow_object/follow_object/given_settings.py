"""Settings of a `FollowObject`: its preset's, and over them those that are given."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from typing import Any, Literal

from ..any_task.derived import derived
from ..any_task.tasks import effector_of, effector_seen_in, steps_to_reach
from ..common.numbers import checked_whole
from ..common.reports import Report
from ..envs import IDS
from ..envs.goal_envs import known_id
from ..settings.fields import check_names, checked, settings_of
from ..settings.learning import AlgorithmSettings
from ..settings.presets import MARKS, method_of, run_config
from ..settings.run_config import RunConfig, check_plain
from ..settings.stages import StageSettings

_WHO = "FollowObject"


def run_settings(
    full_id: str,
    method: str | None,
    preset: str | None,
    given: Mapping[str, Any],
    lift: bool | Literal["auto"],
    seed: int,
    report: Report,
) -> dict[str, Any]:
    """Return every setting of a `FollowObject`; warn of one that a save could not hold.

    Args:
        full_id: the task, with the module that registers it where one does.
        method: one of `METHODS`; None takes "fo", or what the settings make of it.
        preset: whose settings are taken where none are given; None, the settings' own defaults.
        given: settings by their names; of those that are mappings, the names given win.
        lift: the opposite of the setting object_on_table; "auto" leaves it as it is.
        seed: of the run.
        report: called with a sentence where looking at a task of others may take minutes.

    Raises:
        ValueError: a name or a value is not known, out of range or in the wrong place.
    """
    if lift != "auto":
        given = {**given, "object_on_table": _on_table(lift, given.get("object_on_table"))}
    env_id, before = known_id(full_id), asdict(StageSettings())
    if preset is not None:
        of_preset = run_config(full_id, method=method, preset=preset, seed=seed, report=report)
        before |= of_preset.settings
    elif env_id not in IDS and given.get("imagine", before["imagine"]):
        with suppress(ValueError):  # refused where what is found is asked for
            derived(env_id, report)
    settings = checked(StageSettings, _merged(before, given), _WHO)
    for name, each in settings_of(StageSettings).items():
        if each.group is not None and settings[name] is None and name != "reach":
            settings[name] = {}
    if settings["reach"] is None:
        del settings["reach"]
    else:
        settings["reach"] = _reach_in(settings["reach"], env_id, settings["imagine"])
    if settings["n_test_episodes"] is None:
        settings["n_test_episodes"] = settings["n_envs"]
    found = method_of({**settings, **settings["algorithm"]}, settings["imagine"])
    if method is not None and method != found:
        raise ValueError(f"with these settings it is method {found!r}, not {method!r}: {MARKS}")
    settings = {"env_id": env_id, **settings, "seed": checked_whole("seed", seed, 0)}
    try:
        check_plain(settings, "save()")
    except ValueError as error:
        warnings.warn(f"{error}; all else can be done", stacklevel=3)  # of who makes one
    return settings


def check_places(given: Mapping[str, Any], preset: str | None) -> None:
    """Raise a ValueError for what is not known, or said elsewhere.

    Args:
        given: settings by their names.
        preset: as it was given.
    """
    if preset is not None and "imagine" in given:
        raise ValueError('the method says whether goals are imagined: give method="rher" or "her"')
    for name in given.keys() - settings_of(StageSettings).keys():
        if name == "torch_threads":
            raise ValueError("torch_threads is of a run folder: algorithm={'update_threads': ...}")
        if name in settings_of(RunConfig):
            raise ValueError(
                f"{name} is of a run folder, which train() makes; learn() takes env steps"
            )
        if name in settings_of(AlgorithmSettings):
            raise ValueError(f"{name} is of the robot's algorithm: algorithm={{{name!r}: ...}}")
    check_names(given, settings_of(StageSettings), _WHO)


def _merged(before: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with what is given in their place, mappings name by name."""
    return {**before} | {
        name: _merged(before[name], value)
        if isinstance(value, Mapping) and isinstance(before.get(name), Mapping)
        else value
        for name, value in given.items()
    }


def _reach_in(reach: Mapping[str, Any], env_id: str, imagine: bool) -> dict[str, Any]:
    """Return the setting `reach` with what a task of others says of it: effector and steps.

    Raises:
        ValueError: no part of the robot is told in the observation.
    """
    if env_id in IDS:
        return dict(reach)
    found: dict[str, Any] = {"max_steps": steps_to_reach(env_id)}
    if "effector" not in reach:
        effector = effector_of(env_id) if imagine else effector_seen_in(env_id)
        if effector is not None:
            found["effector"] = effector
    return {**found, **reach}


def _on_table(lift: object, on_table: bool | None) -> bool:
    if not isinstance(lift, bool):
        raise ValueError(f'lift must be True, False or "auto", not {lift!r}')
    if on_table is not None:
        raise ValueError("lift and object_on_table say the same; give one of them")
    return not lift
