"""A comparison's plan: which runs, what is refused, and how object stages are shared."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest
import toy
from gymnasium.envs.registration import EnvSpec

from sb3_follow_object.command.cli import _COMMANDS, _config
from sb3_follow_object.command.cli_options import make_parser
from sb3_follow_object.comparison.cells import (
    Settings,
    prepare,
    shared_stage,
    stage_settings,
)
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.comparison.ledger import Ledger, given_up, read_grid
from sb3_follow_object.runs.object_stage_files import OBJECT_STAGE
from sb3_follow_object.runs.run_folder import CONFIG, RESULT, noted_command, task_label
from sb3_follow_object.settings.methods import METHODS
from sb3_follow_object.settings.presets import load_config

SETTINGS = Settings(steps=1000, overrides={"n_envs": 2})


def test_plan_is_the_whole_grid_a_seed_after_the_other(tmp_path: Path) -> None:
    cells = plan(tmp_path, ["PnPShelf", "PushSideGap"], ["her", "fo"], [3, 1, 3], SETTINGS)
    assert [cell.name for cell in cells] == [
        f"{task}-{method}-{seed}"
        for seed in (3, 1)
        for task in ("PnPShelf", "PushSideGap")
        for method in ("her", "fo")
    ]
    assert {cell.config.total_timesteps for cell in cells} == {1000}
    assert {cell.config.settings["n_envs"] for cell in cells} == {2}
    assert not list(tmp_path.iterdir()), "planning wrote something"


def test_ids_and_short_names_are_one_task_and_others_keep_their_id(tmp_path: Path) -> None:
    tasks = ["FollowObject/PnPShelf-v0", "PnPShelf", "FetchReach-v4"]
    cells = plan(tmp_path, tasks, ["her"], [0], SETTINGS)
    assert [cell.name for cell in cells] == ["PnPShelf-her-0", "FetchReach-v4-her-0"]


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("FollowObject/PnPShelf-v0", "PnPShelf"),
        ("sb3_follow_object:FollowObject/PnPShelf-v0", "PnPShelf"),
        *(
            (env_id, env_id)
            for env_id in (
                "PnPShelf-v0",
                "mine:PnPShelf-v0",
                "FollowObject/PnPShelf",
                "PnPShelf-v1",
            )
        ),
        *(
            (kept, kept)
            for kept in ("FetchPush-v4", "MetaWorld/push-wall", "arm_and_wall:ArmAndWall")
        ),
    ],
)
def test_only_this_packages_ids_are_shortened(env_id: str, name: str) -> None:
    assert task_label(env_id) == name


def register(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = EnvSpec(env_id, entry_point=toy.PointEnv, max_episode_steps=toy.HORIZON)
    monkeypatch.setitem(gym.registry, env_id, spec)


def test_tasks_of_others_that_are_called_as_this_packages_are_tasks_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register("PnPShelf-v0", monkeypatch)
    tasks = ["PnPShelf", "PnPShelf-v0", "sb3_follow_object:FollowObject/PnPShelf-v0"]
    cells = plan(tmp_path, tasks, ["her"], [0], SETTINGS)
    assert {cell.name: cell.config.env_id for cell in cells} == {
        "PnPShelf-her-0": "FollowObject/PnPShelf-v0",
        "PnPShelf-v0-her-0": "PnPShelf-v0",
    }


@pytest.mark.parametrize(
    ("tasks", "methods", "folder"),
    [
        (("a/Reach-v0", "a_Reach-v0"), ["her"], "a_Reach-v0-her"),
        (("Reach-fo", "Reach"), ["sldr", "fo-sldr"], "Reach-fo-sldr"),
    ],
)
def test_tasks_whose_runs_would_have_one_folder_are_refused(
    tasks: tuple[str, str],
    methods: list[str],
    folder: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for env_id in tasks:
        register(env_id, monkeypatch)
    with pytest.raises(ValueError) as error:
        plan(tmp_path, tasks, methods, [0, 1], SETTINGS)
    assert str(error.value) == (
        f"{tasks[0]!r} and {tasks[1]!r} would both be kept in {folder}-<seed>; "
        "compare them in folders of their own"
    )


def test_command_trains_the_same_run(tmp_path: Path) -> None:
    settings = Settings(1000, "default", {"curriculum.p": 0.5}, paper_evaluation=True)
    (cell,) = plan(tmp_path, ["PushDoubleObstacles"], ["fo"], [4], settings)
    assert cell.config.eval_every == 1900 * 80
    assert cell.config.n_eval_episodes == 380
    words = "--method fo --seed 4 --threads 1 --steps 1000 --set solved_at=0.0 eval_every=152000"
    assert f"{words} n_eval_episodes=380 curriculum.p=0.5" in cell.command


@pytest.mark.parametrize("name", ["eval_every", "n_eval_episodes"])
def test_papers_rhythm_and_another_contradict_each_other(name: str, tmp_path: Path) -> None:
    settings = Settings(1000, overrides={name: 76}, paper_evaluation=True)
    with pytest.raises(ValueError) as error:
        plan(tmp_path, ["PnPShelf"], ["her"], [0], settings)
    sentence = f"--paper-evaluation decides {name}; leave it or --set {name} out"
    assert str(error.value) == sentence


def test_folder_with_a_run_twice_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    cells = plan(tmp_path, ["PnPShelf"], ["her"], [0, 1], SETTINGS)
    prepare(cells[0], None)
    (cells[0].folder / RESULT).write_text("{}")
    shutil.copytree(cells[0].folder, tmp_path / "copy")
    with pytest.raises(ValueError, match="are both seed 0 of her on PnPShelf"):
        plan(tmp_path, ["PnPShelf"], ["her"], [1], SETTINGS)


def test_null_is_another_setting_than_none_at_all(tmp_path: Path) -> None:
    Ledger(tmp_path, SETTINGS, plan(tmp_path, ["PnPShelf"], ["fo"], [0], SETTINGS))
    other = Settings(1000, overrides={"n_envs": 2, "n_test_episodes": None})
    with pytest.raises(ValueError, match=r"set\.n_test_episodes"):
        plan(tmp_path, ["PushSideGap"], ["fo"], [0], other)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("steps", [None, 1000])
def test_command_says_all_settings_of_its_run(
    preset: str, steps: int | None, tmp_path: Path
) -> None:
    settings = Settings(steps, preset, {"learning_starts": 500})
    methods = [method for method in METHODS if preset == "default" or method != "rher"]
    for cell in plan(tmp_path, ["PnPShelf"], methods, [2], settings):
        arguments = make_parser(_COMMANDS).parse_args(shlex.split(cell.command)[1:])
        assert _config(arguments) == cell.config


def test_every_method_can_be_planned(tmp_path: Path) -> None:
    cells = plan(tmp_path, ["PnPSimpleV2"], METHODS, [0], SETTINGS)
    assert [cell.method for cell in cells] == list(METHODS)


@pytest.mark.parametrize(
    ("tasks", "methods", "sentence"),
    [
        (["PnPShelv"], ["fo"], "there is no task 'PnPShelv'; did you mean 'PnPShelf'"),
        (["FollowObject/PnPShelv-v0"], ["fo"], "did you mean 'FollowObject/PnPShelf-v0'"),
        (["PnPShelf"], ["hers"], "there is no method 'hers'; did you mean 'her'"),
        (["CartPole-v1"], ["her"], "'CartPole-v1' has no goals"),
        (["FetchReach-v4"], ["fo"], "'FetchReach-v4'"),
    ],
)
def test_names_that_mean_nothing_are_refused(
    tmp_path: Path, tasks: list[str], methods: list[str], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        plan(tmp_path, tasks, methods, [0], SETTINGS)


def test_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    cells = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    Ledger(tmp_path, SETTINGS, cells)
    with pytest.raises(ValueError, match="was compared with steps 1000, not 2000"):
        plan(tmp_path, ["PnPShelf"], ["fo"], [0], Settings(2000, overrides={"n_envs": 2}))
    with pytest.raises(ValueError, match=r"with set.n_envs 2, not 4"):
        plan(tmp_path, ["PnPShelf"], ["her"], [1], Settings(1000, overrides={"n_envs": 4}))


def test_run_of_other_settings_is_refused_without_a_grid_file(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    prepare(cell, None)
    other = Settings(1000, overrides={"n_envs": 4})
    with pytest.raises(ValueError, match=r"PnPShelf-her-0 has settings.n_envs 2, not 4"):
        plan(tmp_path, ["PnPShelf"], ["her"], [0], other)
    plan(tmp_path, ["PnPShelf"], ["her"], [1], other)  # another run may have them
    (tmp_path / "PnPShelf-her-1").mkdir()
    (tmp_path / "PnPShelf-her-1" / "notes").write_text("mine")
    with pytest.raises(ValueError, match="is not empty but holds no run"):
        plan(tmp_path, ["PnPShelf"], ["her"], [1], other)


def test_run_is_resumed_with_the_threads_it_began_with(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS, threads=3)
    prepare(cell, None)
    (again,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS, threads=1)
    assert again.config == cell.config
    assert again.config.torch_threads == 3


def test_run_keeps_the_command_that_its_settings_come_from(tmp_path: Path) -> None:
    """Also where `train --resume` ends it."""
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    prepare(cell, None)
    assert "--method her" in cell.command
    assert noted_command(cell.folder, "train --resume") == cell.command


def test_damaged_grid_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "grid.json").write_text('{"format": 1, "cells": {"a": 3}}')
    with pytest.raises(ValueError, match="is not the file of a comparison's grid"):
        read_grid(tmp_path)


@pytest.mark.parametrize("cells", ["[" * 100_000, '{"a": {"failures": Infinity}}'])
def test_grid_file_that_cannot_be_taken_in_is_named(cells: str, tmp_path: Path) -> None:
    place = '"task": "PnPShelf", "method": "her", "seed": 0, "error": null, '
    cells = cells.replace('"failures"', f'{place}"failures"')
    (tmp_path / "grid.json").write_text(f'{{"format": 1, "cells": {cells}}}')
    with pytest.raises(ValueError, match=r"grid.json is not the file of a comparison's grid \("):
        read_grid(tmp_path)


def test_numbers_that_a_grid_file_has_as_text_are_numbers(tmp_path: Path) -> None:
    failed = {"failures": "2", "error": "diverged"}
    cell = {"task": "PnPShelf", "method": "her", "seed": "0", **failed, "cross": failed}
    content = {"format": 1, "cells": {"PnPShelf-her-0": cell}}
    (tmp_path / "grid.json").write_text(json.dumps(content))
    grid = read_grid(tmp_path)
    assert grid is not None
    (entry,) = grid["cells"].values()
    assert given_up(entry) and given_up(entry, cross=True)
    assert entry["seed"] == 0 and entry["cross"] == {"failures": 2, "error": "diverged"}


def test_grid_file_keeps_earlier_cells_and_failures(tmp_path: Path) -> None:
    first = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    ledger = Ledger(tmp_path, SETTINGS, first)
    ledger.note_failure("PnPShelf-her-0", "once")
    assert not ledger.failed("PnPShelf-her-0")
    ledger.note_failure("PnPShelf-her-0", "twice")
    second = plan(tmp_path, ["PnPShelf"], ["her"], [1], SETTINGS)
    later = Ledger(tmp_path, SETTINGS, second)
    assert later.failed("PnPShelf-her-0")
    assert not later.failed("PnPShelf-her-1")
    assert not Ledger(tmp_path, SETTINGS, first, retry_failed=True).failed("PnPShelf-her-0")
    assert set(json.loads((tmp_path / "grid.json").read_text())["cells"]) == {
        "PnPShelf-her-0",
        "PnPShelf-her-1",
    }


def test_object_stage_is_one_for_a_task_and_seed_and_copied_with_its_cost(tmp_path: Path) -> None:
    fo, her, other = plan(tmp_path, ["PnPShelf"], ["fo", "her"], [0, 1], SETTINGS)[:3]
    assert shared_stage(her) is None
    stage = shared_stage(fo)
    assert stage == tmp_path / "object" / "PnPShelf-0"
    assert shared_stage(other) == tmp_path / "object" / "PnPShelf-1"
    (stage / "predictor").mkdir()
    (stage / "predictor" / "predictor.json").write_text("{}")
    (stage / "checkpoint-7.safetensors").write_text("of the object's own training")
    (stage / OBJECT_STAGE).write_text('{"object_steps": 7}')
    prepare(fo, stage)
    names = {path.relative_to(fo.folder).as_posix() for path in fo.folder.rglob("*")}
    assert names >= {CONFIG, OBJECT_STAGE, "predictor/predictor.json"}
    assert "checkpoint-7.safetensors" not in names
    assert load_config(fo.folder) == fo.config
    assert shared_stage(fo) is None, "a run that has begun keeps what it has"


def test_stage_of_other_settings_is_not_shared(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PnPShelf"], ["fo"], [0], SETTINGS)
    assert shared_stage(cell) is not None
    other = Settings(1000, overrides={"n_envs": 2, "object_timesteps": 77})
    (differs,) = plan(tmp_path, ["PnPShelf"], ["fo"], [0], other)
    assert stage_settings(differs.config) != stage_settings(cell.config)
    assert shared_stage(differs) is None


def test_stage_of_another_task_is_not_shared(tmp_path: Path) -> None:
    """Its folder's name may be that of an earlier command's task, as `a/b` and `a_b` have one."""
    (cell,) = plan(tmp_path, ["PnPShelf"], ["fo"], [0], SETTINGS)
    assert shared_stage(cell) is not None
    other = replace(cell, config=replace(cell.config, env_id="FollowObject/PnPObstacle-v0"))
    assert stage_settings(other.config) == stage_settings(cell.config)
    assert shared_stage(other) is None


def test_finished_run_stays_finished(tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, ["PnPShelf"], ["her"], [0], SETTINGS)
    prepare(cell, None)
    assert not cell.finished
    (cell.folder / RESULT).write_text("{}")
    assert cell.finished
