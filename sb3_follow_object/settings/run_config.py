"""What decides a run in a folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

# The whole numbers of a run and the least that each may be.
_WHOLE_NUMBERS = {"seed": 0, "total_timesteps": 1, "eval_every": 1, "n_eval_episodes": 1}
_WHOLE_NUMBERS |= {"n_final_episodes": 1, "keep_checkpoints": 1, "torch_threads": 1}


@dataclass(frozen=True)
class RunConfig:
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
        n_final_episodes: fresh episodes of the last policy's final test, >= 1.
        checkpoint_minutes: wall time between two checkpoints, > 0; does not change the result.
        keep_checkpoints: how many of the last checkpoints are kept, >= 1.
        keep_last_checkpoint: whether a finished run keeps one, to be given more steps later.
        torch_threads: of PyTorch in the robot's gradient steps, >= 1; all else takes one.
        module: that registers the task when it is imported; None for the package's own tasks and
            those that gymnasium knows by itself.
    """

    env_id: str
    method: str = "fo"
    seed: int = 0
    total_timesteps: int = 1_000_000
    settings: dict[str, Any] = field(default_factory=dict)
    eval_every: int = 50_000
    n_eval_episodes: int = 76
    n_final_episodes: int = 380
    checkpoint_minutes: float = 5.0
    keep_checkpoints: int = 2
    keep_last_checkpoint: bool = False
    torch_threads: int = 1
    module: str | None = None

    def __post_init__(self) -> None:
        for name, low in _WHOLE_NUMBERS.items():
            value = getattr(self, name)
            if type(value) is not int or value < low:
                raise ValueError(f"{name} is {value!r}; it must be at least {low}")
        if type(self.keep_last_checkpoint) is not bool:
            raise ValueError(
                f"keep_last_checkpoint is {self.keep_last_checkpoint!r}; it must be true or false"
            )
        if not self.checkpoint_minutes > 0.0:
            raise ValueError(f"checkpoint_minutes is {self.checkpoint_minutes}; it must be > 0")

    @property
    def full_id(self) -> str:
        """The task's id as the command line takes it, with the module before it."""
        return self.env_id if self.module is None else f"{self.module}:{self.env_id}"
