"""Which runs are seeds of one method: one odd run renames itself alone."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from result_folders import finish

from sb3_follow_object.comparison.results import group_runs, markdown_table, read_results
from sb3_follow_object.comparison.variants import words_apart
from sb3_follow_object.runs.run_folder import CONFIG
from sb3_follow_object.settings.presets import run_config
from sb3_follow_object.settings.run_config import RunConfig


def of_preset(
    task: str, method: str, seed: int = 0, preset: str = "default", **changes: Any
) -> RunConfig:
    """The configuration of a run of a preset with changes by their dotted names."""
    env_id = f"FollowObject/{task}-v0"
    return run_config(env_id, method=method, seed=seed, preset=preset, overrides=changes)


def words(*configs: RunConfig) -> list[str]:
    """What the runs' names say, in the runs' order."""
    return list(words_apart({Path(str(i)): each for i, each in enumerate(configs)}).values())


def test_one_run_of_another_length_renames_no_others(tmp_path: Path) -> None:
    runs = {
        f"{task}-{method}-{seed}": of_preset(task, method, seed)
        for task in ("PnPShelf", "PnPSimpleV2")
        for method in ("fo", "her")
        for seed in (0, 1)
    }
    runs["PnPShelf-her-long"] = of_preset("PnPShelf", "her", 0, n_timesteps=600_000)
    for name, config in runs.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / CONFIG).write_text(json.dumps(asdict(config)))
        finish(tmp_path / name)
    found = {run.folder.name: run.method for run in read_results(tmp_path)}
    assert found.pop("PnPShelf-her-long") == "her (n_timesteps=600000)"
    assert found == {name: name.split("-")[1] for name in found}
    text = markdown_table(group_runs(read_results(tmp_path)))
    assert "| task | fo | her | her (n_timesteps=600000) |" in text
    assert "No interquartile means" not in text


def test_each_task_has_its_own_preset() -> None:
    """Of steps, and of how episodes are chosen: what is odd on one task is usual on another."""
    odd = {"n_timesteps": 900_000, "replay_buffer_kwargs.moved_priority": "uniform"}
    said = words(
        of_preset("PnPShelf", "fo"),
        of_preset("PnPShelf", "fo", **odd),
        of_preset("PushSideGap", "fo"),
        of_preset("PnPSimpleV2", "fo"),
    )
    assert {*said[1].split(", ")} == {
        "n_timesteps=900000",
        'algorithm.replay_buffer_kwargs.moved_priority="uniform"',
    }
    assert [said[0], *said[2:]] == [""] * 3


def test_odd_choice_has_one_name_on_all_tasks() -> None:
    said = words(
        of_preset("PnPShelf", "fo"),
        of_preset("PnPShelf", "fo", **{"curriculum.p": 0.5}),
        of_preset("PnPSimpleV2", "fo", **{"curriculum.p": 0.5}),
        of_preset("PnPSimpleV2", "her", gamma=0.9),
    )
    assert said == ["", "curriculum.p=0.5", "curriculum.p=0.5", ""]


def test_of_the_papers_preset_its_own_values_go_without_saying() -> None:
    said = words(
        of_preset("PnPShelf", "her", 0, "paper"),
        of_preset("PnPShelf", "her", 1, "paper"),
        of_preset("PnPShelf", "her", 2, "paper", n_timesteps=600_000),
        of_preset("PushDoubleObstacles", "her", 0, "paper"),
    )
    assert said == ["", "", "n_timesteps=600000", ""]


def test_presets_value_is_said_where_another_run_has_none() -> None:
    """Of that one nothing can be said, and both would have one name."""
    preset = of_preset("PnPShelf", "her")
    without = {name: value for name, value in preset.settings.items() if name != "n_envs"}
    bare = RunConfig(**{**asdict(preset), "settings": without})
    assert words(preset, bare) == ["n_envs=16", ""]


def test_tasks_of_others_have_no_preset_that_can_be_told() -> None:
    steps = [
        RunConfig("nowhere:Task-v0", "her", total_timesteps=total) for total in (1000, 2000, 3000)
    ]
    shelf = [of_preset("PnPShelf", "her"), of_preset("PnPShelf", "her", n_timesteps=3000)]
    assert words(*steps[:2]) == ["n_timesteps=1000", "n_timesteps=2000"]
    assert words(steps[0], *shelf) == ["", "", "n_timesteps=3000"]
    assert words(steps[2], *shelf) == ["n_timesteps=3000", "", "n_timesteps=3000"]
