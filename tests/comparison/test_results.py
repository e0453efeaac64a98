"""Results: statistics over seeds, tables, and what is missing."""

from __future__ import annotations

import csv
from pathlib import Path

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


def test_table_compares_each_method_with_the_first(tmp_path: Path) -> None:
    for seed, (fo, her) in enumerate([(0.9, 0.5), (0.8, 0.9)]):
        write_run(tmp_path, "PnPShelf", "fo", seed, fo)
        write_run(tmp_path, "PnPShelf", "her", seed, her)
    write_run(tmp_path, "PnPShelf", "rnd", 0, 0.95)
    text = markdown_table(group_runs(read_results(tmp_path)))
    assert "| fo | 2 | 0.85 [0.80, 0.90] |  |" in text
    assert "| her | 2 | 0.70 [0.50, 0.90] | 0.38 [0.00, 1.00] |" in text
    assert "| rnd | 1 | 0.95 | 1.00 |" in text, "an interval of one seed says nothing"


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
