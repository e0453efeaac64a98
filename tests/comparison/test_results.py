"""Results: statistics over seeds, tables, and what is missing."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from result_folders import write_grid, write_run

from sb3_follow_object.common import extras
from sb3_follow_object.comparison.results import (
    across_tasks,
    csv_table,
    group_runs,
    interquartile_means,
    markdown_table,
    read_results,
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


def test_methods_are_compared_on_tasks_and_seeds_that_all_have(tmp_path: Path) -> None:
    for seed in range(3):
        write_run(tmp_path, "PnPShelf", "fo", seed, 0.1 * seed)
        write_run(tmp_path, "PushSideGap", "fo", seed, 0.5)
    for seed in range(2):
        write_run(tmp_path, "PnPShelf", "her", seed, 0.2 * seed)
    tasks, n_seeds, scores = across_tasks(group_runs(read_results(tmp_path)))
    assert (tasks, n_seeds) == (["PnPShelf"], 2)
    np.testing.assert_allclose(scores["fo"], [[0.0], [0.1]])
    np.testing.assert_allclose(scores["her"], [[0.0], [0.2]])


def test_interquartile_mean_leaves_the_outer_quarters_out() -> None:
    pytest.importorskip("rliable", reason="rliable is not installed")
    state = np.random.get_state()[1]
    scores = np.array([[0.0], [0.4], [0.6], [1.0]])
    mean, low, high = interquartile_means({"fo": scores})["fo"]
    assert mean == pytest.approx(0.5)
    assert 0.0 <= low < mean < high <= 1.0
    assert interquartile_means({"fo": scores})["fo"] == (mean, low, high), "not repeatable"
    np.testing.assert_array_equal(np.random.get_state()[1], state)


def test_bootstrap_is_stratified() -> None:
    pytest.importorskip("rliable", reason="rliable is not installed")
    # Within a task the seeds agree, so only a bootstrap that mixed the tasks would vary.
    scores = np.array([[0.1, 0.2, 0.8, 0.9]] * 3)
    assert interquartile_means({"fo": scores})["fo"] == pytest.approx((0.5, 0.5, 0.5))


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
