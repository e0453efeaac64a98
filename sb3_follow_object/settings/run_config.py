"""What decides a run in a folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from ..common.numbers import checked_whole, shown
from .fields import Flag, Group, Number, Whole, checked, setting
from .stages import THREADS, StageSettings

CONFIG = "config.json"  # what a run's folder holds it as


@dataclass(frozen=True)
class RunConfig(Group):
    """What decides a run.

    Attributes:
        env_id: the task.
        method: name of the method, for tables.
        seed: decides every random stream of the run, >= 0.
        total_timesteps: env steps in all, object stage and curriculum tests counted.
        settings: keyword arguments of `FollowObject` besides env_id and seed.
        eval_every: env steps between two validations on original goals, >= 1.
        n_eval_episodes: episodes a validation, >= 1; its steps are not counted, nothing learns
            from them.
        solved_at: success rate of `solved_validations` validations in a row that ends the run
            before its steps; 0, none does.
        solved_validations: see `solved_at`, >= 1.
        n_final_episodes: fresh episodes of the last policy's final test, >= 1.
        checkpoint_minutes: wall time between two checkpoints, > 0; does not change the result.
        keep_checkpoints: how many of the last checkpoints are kept, >= 1.
        keep_last_checkpoint: whether a finished run keeps one, to be given more steps later; one
            that ended as solved takes none.
        torch_threads: of PyTorch in the robot's gradient steps, >= 1; all else takes one.
        module: that registers the task when it is imported; None for the package's own tasks and
            those that gymnasium knows by itself.

    Raises:
        ValueError: an unknown setting, one out of its range, or a Python object among them.
    """

    title = "Of the run (`train`)"
    env_id: str
    method: str = "fo"
    seed: int = 0
    total_timesteps: Annotated[
        Whole,
        setting(
            "env steps in all: object stage, training, tests of h_max; `--steps`",
            name="n_timesteps",
            ge=1,
        ),
    ] = 1_000_000
    settings: dict[str, Any] = field(default_factory=dict)
    eval_every: Annotated[
        Whole, setting("env steps between two validations on original goals", ge=1)
    ] = 50_000
    n_eval_episodes: Annotated[
        Whole, setting("episodes of a validation; nothing learns from them", ge=1)
    ] = 76
    solved_at: Annotated[
        Number, setting("validated success rate that ends a run early; 0, none", ge=0, le=1)
    ] = 0.0
    solved_validations: Annotated[
        Whole, setting("validations in a row that must reach it", ge=1)
    ] = 3
    n_final_episodes: Annotated[
        Whole, setting("fresh episodes of the last policy's final test", ge=1)
    ] = 380
    checkpoint_minutes: Annotated[
        Number, setting("wall time between two checkpoints", unit="minutes", gt=0)
    ] = 5.0
    keep_checkpoints: Annotated[
        Whole, setting("how many of the last are kept while it trains", ge=1, le=1000)
    ] = 2
    keep_last_checkpoint: Annotated[
        Flag,
        setting(
            "whether a finished run keeps one, to be given more steps later; one that ended as "
            "solved takes none"
        ),
    ] = False
    torch_threads: Annotated[
        Whole,
        setting(
            "of PyTorch in the robot's gradient steps, all else takes one; changes no result with "
            "the default presets' networks and batches; `--threads` sets it and `n_threads`",
            ge=1,
            le=THREADS,
        ),
    ] = 1
    module: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.settings, Mapping):
            raise ValueError(f"settings must be a mapping, not {shown(self.settings)}")
        settings = checked(StageSettings, self.settings, "settings")
        check_plain(settings, CONFIG)
        object.__setattr__(self, "seed", checked_whole("seed", self.seed, 0))
        object.__setattr__(self, "settings", settings)

    @property
    def full_id(self) -> str:
        """The task's id as the command line takes it, with the module before it."""
        return self.env_id if self.module is None else f"{self.module}:{self.env_id}"


def check_plain(settings: Mapping[str, Any], file: str) -> None:
    """Raise a ValueError for a setting that is a Python object, which a file of JSON cannot hold.

    Args:
        settings: may hold others.
        file: what cannot hold it, as a sentence calls it.
    """
    for name, value in settings.items():
        if isinstance(value, Mapping):
            check_plain(value, file)
            continue
        try:
            json.dumps(value)
        except TypeError as error:
            raise ValueError(
                f"{name} is {shown(value)}, a Python object, which {file} cannot hold"
            ) from error


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    named: dict[str, Any] = {}
    for name, value in tree.items():
        nested = flat(value, f"{prefix}{name}.") if isinstance(value, dict) else None
        named |= {f"{prefix}{name}": value} if nested is None else nested
    return named
