"""A grid's jobs, done at once as a test tells."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from result_folders import finish

from sb3_follow_object.comparison.cells import Cell, Settings
from sb3_follow_object.comparison.compare import Comparison
from sb3_follow_object.comparison.cross import CROSS_TESTS
from sb3_follow_object.comparison.executors import Message
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.comparison.grid_display import GridDisplay
from sb3_follow_object.comparison.worker import STAGE, TRAIN, Job
from sb3_follow_object.runs.object_stage_files import OBJECT_STAGE
from sb3_follow_object.runs.run_folder import POLICY

SETTINGS = Settings(steps=1000)


class FakeExecutor:
    """Does jobs at once, as it is told, and remembers them."""

    def __init__(self, do: Callable[[Job], list[Message]], slots: int = 2):
        self.slots = slots
        self.do = do
        self.jobs: list[Job] = []
        self.most = 0
        self.stops = 0
        self._told: list[tuple[str, Message]] = []

    def start(self, job: Job) -> None:
        told = self.do(job)
        self.jobs.append(job)
        self._told += [(job.name, message) for message in told]
        self.most = max(self.most, sum("finished" in message for _, message in self._told))

    def messages(self, timeout: float) -> list[tuple[str, Message]]:
        told, self._told = self._told, []
        return told

    def stop(self) -> None:
        self.stops += 1
        for job in self.jobs:
            self._told.append((job.name, {"stopped": True}))

    def names(self, kind: str) -> list[str]:
        return [job.name for job in self.jobs if job.kind == kind]


def do_it(job: Job) -> list[Message]:
    """Leave what a job would."""
    folder = Path(job.folder)
    assert (folder / "config.json").exists()
    if job.kind == STAGE:
        (folder / "predictor").mkdir(exist_ok=True)
        (folder / "predictor" / "predictor.json").write_text("{}")
        (folder / OBJECT_STAGE).write_text('{"object_steps": 7}')
    elif job.kind == TRAIN:
        (folder / POLICY).write_text("")
        finish(folder)
    else:
        tested = {job.other.split("/")[1][:-3]: {"success_rate": 0.5, "episodes": 380}}
        (folder / CROSS_TESTS).write_text(json.dumps(tested))
    figures = {"env_steps": 500, "success_rate": 0.5, "k_max": None}
    told: list[Message] = [{"say": "hello"}]
    return [*told, *([{"figures": figures}] if job.kind == TRAIN else []), {"finished": True}]


def comparison(
    folder: Path, executor: Any, cells: list[Cell], **options: Any
) -> tuple[Comparison, GridDisplay]:
    display = GridDisplay(quiet=True)
    return Comparison(folder, cells, SETTINGS, executor, 1, display, **options), display


def small_plan(folder: Path, methods: tuple[str, ...] = ("fo", "her")) -> list[Cell]:
    return plan(folder, ["PnPShelf", "PushSideGap"], methods, [0], SETTINGS)
