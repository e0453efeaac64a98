"""Results: statistics over seeds, tables, and what is missing."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from result_folders import write_grid, write_run

from sb3_follow_object.common import extras
from sb3_follow_object.comparison.results import (
    common_runs,
    csv_table,
    group_runs,
    markdown_table,
    read_results,
    success_rates,
    table_rows,
    write_tables,
)
from sb3_follow_object.runs.run_folder import trained_steps


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Three seeds of one method, and of another one finished, one failed, one not begun."""
    for seed, success in enumerate((0.2, 0.4, 0.9)):
        write_run(tmp_path, "PnPShelf", "fo", seed, success)
    write_run(tmp_path, "PnPShelf", "her", 0, 0.1)
    write_run(tmp_path, "PnPShelf", "her", 1)
    write_run(tmp_path, "PushSideGap", "fo", 0)
    write_grid(
        tmp_path,
        {
            "PnPShelf-her-1": {"failures": 2, "error": "RuntimeError: diverged"},
            "PnPShelf-her-2": {},
            "PushSideGap-her-0": {},
        },
    )
    return tmp_path


def test_runs_have_their_status(results: Path) -> None:
    found = {run.folder.name: run.status for run in read_results(results)}
    assert found == {
        "PnPShelf-fo-0": "finished",
        "PnPShelf-fo-1": "finished",
        "PnPShelf-fo-2": "finished",
        "PnPShelf-her-0": "finished",
        "PnPShelf-her-1": "failed",
        "PnPShelf-her-2": "not run",
        "PushSideGap-fo-0": "unfinished",
        "PushSideGap-her-0": "not run",
    }


def test_runs_of_other_settings_are_no_seeds_of_one_method(tmp_path: Path) -> None:
    for seed, settings in enumerate(({}, {"n_threads": 2}, {"n_envs": 4}, {"n_envs": 4})):
        write_run(tmp_path, "PnPShelf", "fo", seed, 0.5, **settings)
    groups = group_runs(read_results(tmp_path))
    assert [(g.method, len(g.runs)) for g in groups] == [("fo", 2), ("fo (n_envs=4)", 2)]


def write_other(folder: Path, task: str, seed: int, **changes: Any) -> None:
    """Write a finished run whose configuration has other fields than the default's."""
    path = write_run(folder, task, "fo", seed, 0.5) / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("total_timesteps", 1500, "n_timesteps=1500"),
        ("solved_at", 0.9, "solved_at=0.9"),
        ("n_final_episodes", 4, "n_final_episodes=4"),
        ("eval_every", 700, "eval_every=700"),
    ],
)
def test_runs_of_other_lengths_and_tests_are_no_seeds_of_one_method(
    field: str, value: float, words: str, tmp_path: Path
) -> None:
    write_run(tmp_path, "PnPShelf", "fo", 0, 0.5)
    write_other(tmp_path, "PnPShelf", 1, **{field: value})
    methods = [run.method for run in read_results(tmp_path)]
    assert f"fo ({words})" in methods and len(set(methods)) == 2


def test_what_changes_no_result_tells_no_runs_apart(tmp_path: Path) -> None:
    write_run(tmp_path, "PnPShelf", "fo", 0, 0.5)
    for seed, name in enumerate(["torch_threads", "checkpoint_minutes", "keep_checkpoints"], 1):
        write_other(tmp_path, "PnPShelf", seed, **{name: 3})
    assert {run.method for run in read_results(tmp_path)} == {"fo"}


def test_tasks_may_have_steps_of_their_own(tmp_path: Path) -> None:
    write_other(tmp_path, "PnPShelf", 0, total_timesteps=1000)
    write_other(tmp_path, "PushSideGap", 0, total_timesteps=2000)
    assert {run.method for run in read_results(tmp_path)} == {"fo"}


def test_choice_of_settings_has_one_name_on_all_tasks(tmp_path: Path) -> None:
    write_run(tmp_path, "PnPShelf", "her", 0, 0.5, algorithm={"gamma": 0.98})
    for seed, gamma in enumerate((0.98, 0.99)):
        write_run(tmp_path, "PushSideGap", "her", seed, 0.5, algorithm={"gamma": gamma})
    # They are the grid's, but for the one with another gamma, so what is to come is as they are.
    names = ("PnPShelf-her-0", "PnPShelf-her-1", "PushSideGap-her-0", "PnPObstacle-her-0")
    write_grid(tmp_path, {name: {} for name in names})
    found = {run.folder.name: run.method for run in read_results(tmp_path)}
    assert found.pop("PushSideGap-her-1") == "her (algorithm.gamma=0.99)"
    assert found == dict.fromkeys(names, "her (algorithm.gamma=0.98)")


def test_table_says_that_no_task_is_common_to_all_methods(tmp_path: Path) -> None:
    none = "No interquartile means: there is no task that all methods have finished a run of."
    write_run(tmp_path, "PnPShelf", "fo", 0, 0.5)
    assert none not in markdown_table(group_runs(read_results(tmp_path)))
    write_run(tmp_path, "PushSideGap", "her", 0, 0.5)
    assert f"\n{none}\n" in markdown_table(group_runs(read_results(tmp_path)))


def test_run_that_two_names_lead_to_is_counted_once(tmp_path: Path) -> None:
    run = write_run(tmp_path, "PnPShelf", "fo", 0, 0.5)
    (tmp_path / "latest").symlink_to(run.name)
    write_grid(tmp_path, {run.name: {}})
    assert [run.folder.name for run in read_results(tmp_path)] == ["PnPShelf-fo-0"]


def test_copy_of_a_finished_run_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path, "PnPShelf", "fo", 0, 0.5)
    copy = shutil.copytree(run, tmp_path / "copy")
    with pytest.raises(ValueError) as error:
        read_results(tmp_path)
    assert str(error.value) == (
        f"{run} and {copy} are both seed 0 of fo on PnPShelf with the same settings, and would "
        "count twice; leave one of them out"
    )
    (copy / "result.json").unlink()
    assert len(read_results(tmp_path)) == 2, "one of them is not finished"


def test_markdown_table_leaves_nothing_out(results: Path) -> None:
    text = markdown_table(group_runs(read_results(results)))
    assert "| PnPShelf | 0.40 [0.30, 0.65] (3) | 0.10 (1); 1 failed, 1 not run |" in text
    assert "| PushSideGap | unfinished | not run |" in text
    assert "- PnPShelf-her-1 failed: RuntimeError: diverged" in text


def test_csv_table_has_a_row_for_each_task_and_method(results: Path) -> None:
    write_tables(read_results(results), results)
    with open(results / "table.csv", newline="") as file:
        rows = {(row["task"], row["method"]): row for row in csv.DictReader(file)}
    assert len(rows) == 4
    fo = rows["PnPShelf", "fo"]
    assert (fo["median"], fo["q25"], fo["q75"]) == ("0.4000", "0.3000", "0.6500")
    assert (fo["seeds"], fo["finished"], fo["status"]) == ("3", "3", "finished")
    her = rows["PnPShelf", "her"]
    assert (her["seeds"], her["finished"], her["failed"]) == ("3", "1", "1")
    assert rows["PushSideGap", "her"]["median"] == ""


def test_groups_without_runs_are_asked_for(results: Path) -> None:
    groups = group_runs(read_results(results), ["PnPShelf", "PnPObstacle"], ["her", "rival"])
    assert [group.missing for group in groups] == [
        "1 failed, 1 not run",
        "not run",
        "not run",
        "not run",
    ]
    assert "rival" in csv_table(groups)


def test_methods_are_compared_on_tasks_that_all_have(tmp_path: Path) -> None:
    for seed in range(3):
        write_run(tmp_path, "PnPShelf", "fo", seed, 0.1 * seed)
        write_run(tmp_path, "PnPObstacle", "fo", seed, 0.4)
        write_run(tmp_path, "PushSideGap", "fo", seed, 0.5)
    for seed in range(2):
        write_run(tmp_path, "PnPShelf", "her", seed, 0.2 * seed)
    for seed in range(3):
        write_run(tmp_path, "PnPObstacle", "her", seed, 0.3)
    tasks, runs = common_runs(group_runs(read_results(tmp_path)))
    assert tasks == ["PnPObstacle", "PnPShelf"]
    np.testing.assert_allclose(success_rates(runs["fo"]), [[0.4, 0.0], [0.4, 0.1], [0.4, 0.2]])
    np.testing.assert_allclose(success_rates(runs["her"]), [[0.3, 0.0], [0.3, 0.2]])


def test_a_method_that_ran_on_few_tasks_does_not_narrow_the_comparison(tmp_path: Path) -> None:
    tasks = ["PnPObstacle", "PnPShelf", "PushSideGap"]
    for method, n_tasks in (("fo", 3), ("her", 2), ("rher", 3), ("rnd", 1)):
        for task in tasks[:n_tasks]:
            write_run(tmp_path, task, method, 0, 0.5)
    found, runs = common_runs(group_runs(read_results(tmp_path)))
    assert sorted(found) == tasks[:2], "three methods on two tasks before two on three"
    assert list(runs) == ["fo", "her", "rher"]
    write_run(tmp_path, "PnPSimpleV1", "fo", 0, 0.5)
    write_run(tmp_path, "PnPSimpleV1", "rher", 0, 0.5)
    found, runs = common_runs(group_runs(read_results(tmp_path)))
    assert len(found) == 4 and list(runs) == ["fo", "rher"]


def test_table_compares_each_method_with_the_first(tmp_path: Path) -> None:
    for seed, (fo, her) in enumerate([(0.9, 0.5), (0.8, 0.9)]):
        write_run(tmp_path, "PnPShelf", "fo", seed, fo)
        write_run(tmp_path, "PnPShelf", "her", seed, her)
    write_run(tmp_path, "PnPShelf", "rnd", 0, 0.95)
    text = markdown_table(group_runs(read_results(tmp_path)))
    assert "| fo | 2 | 0.85 [0.80, 0.90] |  |" in text
    assert "| her | 2 | 0.70 [0.50, 0.90] | 0.38 [0.00, 1.00] |" in text
    assert "| rnd | 1 | 0.95 | 1.00 |" in text, "an interval of one seed says nothing"


def test_the_first_is_the_tables_first_column_whatever_is_finished(tmp_path: Path) -> None:
    write_run(tmp_path, "PnPSimpleV1", "her", 0, 0.5)  # the first task, which fo has not finished
    write_run(tmp_path, "PnPSimpleV1", "fo", 0)
    for method, success in (("her", 0.1), ("fo", 0.9)):
        write_run(tmp_path, "PnPShelf", method, 0, success)
    write_run(tmp_path, "PnPShelf", "rnd", 0)
    text = markdown_table(group_runs(read_results(tmp_path)))
    assert "| task | fo | her | rnd |" in text
    assert "| method | seeds | IQM | better than fo |" in text
    assert text.index("| fo | 1 | 0.90 |  |") < text.index("| her | 1 | 0.10 | 0.00 |")


def test_first_method_without_a_finished_run_is_not_compared_with(tmp_path: Path) -> None:
    for method, success in (("fo", None), ("her", 0.1), ("rnd", 0.2)):
        write_run(tmp_path, "PnPShelf", method, 0, success)
    assert "| better than her |" in markdown_table(group_runs(read_results(tmp_path)))


def test_tables_do_without_rliable(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(module, name=module.split(".")[0])

    monkeypatch.setattr(extras, "import_module", missing)
    groups = group_runs(read_results(results))
    assert "rliable is not installed" in markdown_table(groups)
    rows = {(row["task"], row["method"]): row for row in table_rows(groups)}
    assert rows["PnPShelf", "fo"]["median"] == pytest.approx(0.4)
    assert rows["PnPShelf", "fo"]["iqm"] is None


def test_folder_without_runs_and_damaged_results_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no runs"):
        read_results(tmp_path)
    with pytest.raises(ValueError, match="is not a folder of results"):
        read_results(tmp_path / "none")
    run = write_run(tmp_path, "PnPShelf", "fo", 0, 0.5)
    (run / "result.json").write_text('{"env_steps": 3}')
    for content in ('{"env_steps": 3}', "{}", "[1]", "{"):
        (run / "result.json").write_text(content)
        for read in (lambda: read_results(tmp_path), lambda: trained_steps(run)):
            with pytest.raises(ValueError, match="is not the result of a run"):
                read()
