"""Which of a comparison's settings go into which runs, and which are refused."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest

from sb3_follow_object.command.cli import _COMMANDS, _config
from sb3_follow_object.command.cli_options import make_parser
from sb3_follow_object.comparison.cells import Settings
from sb3_follow_object.comparison.grid import plan


def test_a_run_has_only_what_its_method_reads(tmp_path: Path) -> None:
    overrides = {"curriculum.p": 0.5, "object_n_envs": 3, "n_paths": 64, "learning_starts": 500}
    cells = plan(
        tmp_path, ["PnPShelf"], ["fo", "sldr", "her"], [0], Settings(1000, overrides=overrides)
    )
    read = {
        cell.method: [name for name in overrides if f"{name}=" in cell.command] for cell in cells
    }
    assert read == {
        "fo": list(overrides),
        "sldr": ["object_n_envs", "n_paths", "learning_starts"],
        "her": ["learning_starts"],
    }
    for cell in cells:
        arguments = make_parser(_COMMANDS).parse_args(shlex.split(cell.command)[1:])
        assert _config(arguments) == cell.config
    with pytest.raises(ValueError, match=r"curriculum.p does nothing: none of her, rnd reads it"):
        plan(tmp_path, ["PnPShelf"], ["her", "rnd"], [0], Settings(1000, overrides=overrides))


@pytest.mark.parametrize(
    ("name", "value", "readers", "others"),
    [
        ("reach.share", 0.3, ["fo", "rher"], ["her", "sldr"]),
        ("replay_buffer_kwargs.cher.picks", 2, ["cher"], ["her", "fo"]),
        ("auxiliary.weight", 2.0, ["rnd", "sldr", "fo-sldr"], ["her", "fo"]),
        ("auxiliary.max_bonus", 3.0, ["rnd"], ["sldr", "her"]),
        ("inverse_fit.updates", 10, ["sldr", "fo-sldr", "fo"], ["her", "rnd"]),
    ],
)
def test_settings_of_a_group_that_some_methods_lack_are_left_out_of_their_runs(
    name: str, value: float, readers: list[str], others: list[str], tmp_path: Path
) -> None:
    settings = Settings(1000, overrides={name: value, "n_envs": 2})
    cells = plan(tmp_path, ["PnPShelf"], [*readers, *others], [0], settings)
    assert [cell.method for cell in cells if f" {name}=" in cell.command] == readers
    unchanged = plan(tmp_path, ["PnPShelf"], others, [0], Settings(1000, overrides={"n_envs": 2}))
    assert [cell.config for cell in cells[len(readers) :]] == [cell.config for cell in unchanged]
    for cell in cells:
        arguments = make_parser(_COMMANDS).parse_args(shlex.split(cell.command)[1:])
        assert _config(arguments) == cell.config


@pytest.mark.parametrize(
    ("methods", "overrides", "name"),
    [
        (["her"], {"reach.share": 0.3}, "reach.share"),
        (["her", "fo"], {"auxiliary.weight": 2.0}, "auxiliary.weight"),
        (["sldr"], {"auxiliary.max_bonus": 3.0}, "auxiliary.max_bonus"),
        (["fo", "her"], {"solved_validations": 2}, "solved_validations"),
        (["fo", "her"], {"inverse_fit.updates": 10}, "inverse_fit.updates"),
        (
            ["fo", "her"],
            {"curriculum.levels": "time", "curriculum.n_levels": 10},
            "curriculum.n_levels",
        ),
    ],
)
def test_what_no_method_reads_is_refused(
    methods: list[str], overrides: dict[str, Any], name: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError) as error:
        plan(tmp_path, ["PnPShelf"], methods, [0], Settings(1000, overrides=overrides))
    sentence = f"--set {name} does nothing: none of {', '.join(methods)} reads it"
    assert str(error.value) == sentence


def test_what_another_setting_lets_a_run_read_is_kept(tmp_path: Path) -> None:
    overrides = {"solved_at": 0.9, "solved_validations": 2, "curriculum.n_levels": 10}
    (cell,) = plan(tmp_path, ["PnPShelf"], ["fo"], [0], Settings(1000, overrides=overrides))
    assert (cell.config.solved_at, cell.config.solved_validations) == (0.9, 2)
    assert cell.config.settings["curriculum"]["n_levels"] == 10


def test_name_that_no_group_has_is_refused_with_the_nearest(tmp_path: Path) -> None:
    for methods, name, meant in (
        (["fo", "her"], "reach.shar", "share"),
        (["rnd", "her"], "auxiliary.weigt", "weight"),
        (["cher", "her"], "replay_buffer_kwargs.cher.pick", "picks"),
    ):
        with pytest.raises(ValueError, match=f"did you mean '{meant}'"):
            plan(tmp_path, ["PnPShelf"], methods, [0], Settings(1000, overrides={name: 2}))
