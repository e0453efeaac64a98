"""The paper's figures: written for whole and for broken grids, and true to them."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from result_folders import finish, write_grid, write_run

from sb3_follow_object.command.cli import main
from sb3_follow_object.comparison import statistics
from sb3_follow_object.comparison.cross import CROSS_TESTS, cross_test, read_cross_tests
from sb3_follow_object.comparison.figures import (
    FINAL_SUCCESS,
    OTHER_TASKS,
    PNP_SIMPLE,
    draw_methods,
    draw_results,
)
from sb3_follow_object.envs import TASKS

PNG = b"\x89PNG"


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures in the order in which they were saved, small, with rough intervals."""
    figures: list[Figure] = []
    save = Figure.savefig

    def keep(self: Figure, *args: Any, **options: Any) -> None:
        figures.append(self)
        save(self, *args, **{**options, "dpi": 30})

    monkeypatch.setattr(Figure, "savefig", keep)
    monkeypatch.setattr(statistics, "_SAMPLES", 50)
    return figures


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for axis in figure.axes for text in axis.texts]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    for seed in range(2):
        write_run(tmp_path, "PnPShelf", "fo", seed, 0.9)
        run = write_run(tmp_path, "PnPSimpleV1", "her", seed, 1.0)
        cross = {"PnPSimpleV2": {"success_rate": 0.8 + 0.1 * seed, "episodes": 8}}
        (run / CROSS_TESTS).write_text(json.dumps(cross))
    write_run(tmp_path, "PnPSimpleV2", "her", 0)
    write_grid(tmp_path, {"PnPShelf-her-0": {"failures": 2, "error": "diverged"}})
    return tmp_path


def test_figures_are_written(results: Path, drawn: list[Figure]) -> None:
    paths = draw_results(results, results / "out")
    assert len(paths) == 5
    assert all(path.read_bytes().startswith(PNG) for path in paths)
    names = [axis.get_title() for axis in drawn[1].axes]
    assert names == [task for task in TASKS if not task.startswith("PnPSimple")]
    assert [path.name for path in paths[:2]] == [PNP_SIMPLE, OTHER_TASKS]


def test_command_draws_them_where_it_is_told(
    results: Path, tmp_path: Path, drawn: list[Figure], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "figures"
    assert main(["plot", "--results", str(results), "--out", str(out)]) == 0
    assert set(capsys.readouterr().out.splitlines()) == {*map(str, out.iterdir())}
    assert main(["plot"]) == 2
    assert main(["plot", str(results), "--results", str(results)]) == 2
    assert "either run folders or --results" in capsys.readouterr().err


def test_cross_test_is_drawn_with_what_is_missing(results: Path, drawn: list[Figure]) -> None:
    draw_results(results, results / "out", methods=("fo", "her"))
    panel = drawn[0].axes[0]
    assert [text.get_text() for text in panel.texts] == ["1.00", "0.85", "unfinished", "unfinished"]
    hatched = [bool(bar.get_hatch()) for bar in panel.patches]
    assert hatched == [False, False, True, True]


def test_cross_test_that_failed_is_drawn_as_failed(results: Path, drawn: list[Figure]) -> None:
    failed = {"cross": {"failures": 2, "error": "MemoryError"}}
    write_grid(results, {"PnPSimpleV1-her-2": failed})
    write_run(results, "PnPSimpleV1", "her", 2, 1.0)
    draw_results(results, results / "one", methods=("her",))
    labels = [label.get_text() for label in drawn[0].axes[0].get_xticklabels()]
    assert labels[:2] == ["HER-a on\nPnPSimpleV1", "HER-a on\nPnPSimpleV2\n1 failed"]
    drawn.clear()
    write_grid(results, {f"PnPSimpleV1-her-{seed}": failed for seed in range(3)})
    for seed in range(2):
        (results / f"PnPSimpleV1-her-{seed}" / CROSS_TESTS).unlink()
    draw_results(results, results / "all", methods=("her",))
    assert [text.get_text() for text in drawn[0].axes[0].texts][:2] == ["1.00", "failed"]


def test_method_that_ran_as_variants_alone_is_not_drawn_as_not_run(
    results: Path, drawn: list[Figure], tmp_path: Path
) -> None:
    write_run(results, "PnPShelf", "rher", 0, 0.5, n_envs=2)
    write_run(results, "PnPShelf", "rher", 1, 0.5, n_envs=4)
    draw_results(results, results / "out", methods=("fo", "rher"))
    labels = [label.get_text() for label in drawn[3].axes[0].get_xticklabels()]
    assert labels == ["fo", "her", "rher\nn_envs=2", "rher\nn_envs=4"]
    draw_methods(results, tmp_path / "few.png", ("fo", "rher"))
    (panel,) = [axis for axis in drawn[-1].axes if axis.get_title()]
    assert len(panel.lines) == 3


def test_unfinished_runs_are_dotted_and_missing_methods_named(
    results: Path, drawn: list[Figure]
) -> None:
    draw_results(results, results / "out", methods=("fo", "her", "rival"))
    v2 = drawn[0].axes[2]
    assert [line.get_linestyle() for line in v2.lines] == [":"]
    assert [text.get_text() for text in v2.texts] == ["not run: fo, rival; unfinished: her"]
    shelf = next(axis for axis in drawn[1].axes if axis.get_title() == "PnPShelf")
    assert [text.get_text() for text in shelf.texts] == ["failed: her; not run: rival"]
    empty = next(axis for axis in drawn[1].axes if axis.get_title() == "PnPObstacle")
    assert not empty.lines
    assert [bool(patch.get_hatch()) for patch in empty.patches] == [True]


def test_matrix_of_final_success_has_a_text_in_every_cell(
    results: Path, drawn: list[Figure]
) -> None:
    draw_results(results, results / "out", methods=("fo", "her", "rival"))
    cells = texts(drawn[3])
    assert len(cells) == 3 * len(TASKS)
    assert cells.count("0.90 (2)") == 1
    assert cells.count("failed") == 1
    assert cells.count("unfinished") == 1
    assert (results / "out" / FINAL_SUCCESS).exists()


def test_names_of_variants_are_readable(results: Path, drawn: list[Figure]) -> None:
    """Runs that differ in settings have long names."""
    settings = {"object_error": 0.02, "curriculum": {"threshold": 0.25, "stride": 1}}
    write_run(results, "PnPShelf", "fo", 2, 0.5, **settings)
    draw_results(results, results / "out", methods=("fo", "her", "rival"))
    curves, matrix = drawn[1], drawn[3]
    labels = [label for label in matrix.axes[0].get_xticklabels() if label.get_text()]
    named = "fo\nobject_error=0.02\nthreshold=0.25\nstride=1"
    assert named in [label.get_text() for label in labels]
    boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
    assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
    for axis in curves.axes:
        assert axis.get_window_extent().width > 0.25 * curves.bbox.width
        notes = [text.get_window_extent() for text in axis.texts]
        assert all(box.x0 >= 0 and box.x1 <= curves.bbox.width for box in notes)


def test_methods_are_compared_across_tasks(tmp_path: Path, drawn: list[Figure]) -> None:
    for seed, success in enumerate((0.2, 0.6)):
        write_run(tmp_path, "PnPShelf", "fo", seed, success)
    write_run(tmp_path, "PnPShelf", "her", 0, 0.0, curve=())
    write_run(tmp_path, "PnPObstacle", "fo", 0, 1.0)
    draw_results(tmp_path, tmp_path / "out", methods=("fo", "her"))
    profile, efficiency = drawn[4].axes
    assert drawn[4].get_suptitle() == "PnPShelf\nseeds: fo 2, her 1"
    fo, her = (line.get_ydata() for line in profile.lines)
    assert (fo[0], fo[20], fo[-1], her[0]) == (1.0, 0.5, 0.0, 0.0)
    fo, her = (line.get_ydata() for line in efficiency.lines)
    # Validated 0.1, 0.2 and 0.4 up to 900 env steps, tested at 1,000, of the 300,000 of the preset.
    assert (fo[0], fo[1], fo[-1]) == pytest.approx((0.0, 0.4, 0.4))
    assert not her.any()


def test_curves_of_unequal_lengths_share_one_axis(tmp_path: Path, drawn: list[Figure]) -> None:
    for method, total, success in (("fo", 1000, 0.6), ("her", 2000, 0.8)):
        path = write_run(tmp_path, "PnPShelf", method, 0, success) / "config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "total_timesteps": total}))
    (tmp_path / "PnPShelf-her-0" / "result.json").unlink()
    finish(tmp_path / "PnPShelf-her-0", 0.8, env_steps=2000)
    draw_results(tmp_path, tmp_path / "out", methods=("fo", "her"))
    fo, her = (line.get_ydata() for line in drawn[4].axes[1].lines)
    # Validated 0.1, 0.2 and 0.4 at 300, 600 and 900 env steps, of the 2,000 that are the task's.
    assert (fo[15], fo[25], fo[-1]) == pytest.approx((0.2, 0.6, 0.6))
    assert (her[15], her[-1]) == pytest.approx((0.2, 0.8))


def test_methods_are_drawn_alone_where_two_of_them_ran(
    results: Path, drawn: list[Figure], tmp_path: Path
) -> None:
    write_run(results, "PnPSimpleV1", "rher", 0, 0.3)
    draw_methods(results, tmp_path / "few.png", ("fo", "rher", "her"))
    (panel,) = [axis for axis in drawn[0].axes if axis.get_title()]
    assert panel.get_title() == "PnPSimpleV1"
    assert len(panel.lines) == 2
    assert [text.get_text() for text in panel.texts] == ["not run: fo"]
    with pytest.raises(ValueError, match="runs of two of fo, rival"):
        draw_methods(results, tmp_path / "none.png", ("fo", "rival"))


def test_nothing_to_compare_is_said(results: Path, drawn: list[Figure]) -> None:
    draw_results(results, results / "out", methods=("fo", "her"))
    assert drawn[4].get_suptitle() == "no task that two methods finished"
    assert not drawn[4].axes[0].lines


def test_cross_test_keeps_the_figure_and_refuses_what_cannot_be(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Half:
        success_rate = 0.5

    asked: list[Any] = []

    def evaluate(*arguments: Any) -> type[Half]:
        asked.append(arguments)
        return Half

    monkeypatch.setattr("sb3_follow_object.comparison.cross.evaluate", evaluate)
    run = results / "PnPSimpleV2-her-0"
    assert cross_test(run, "FollowObject/PnPSimpleV1-v0", 12) == 0.5
    assert asked[0][1:] == ("FollowObject/PnPSimpleV1-v0", 12, 0)
    assert cross_test(run, "FollowObject/PnPSimpleV1-v0", 4) == 0.5, "kept is the longer test"
    assert read_cross_tests(run) == {"PnPSimpleV1": {"success_rate": 0.5, "episodes": 12}}
    with pytest.raises(ValueError, match="did you mean 'FollowObject/PnPSimpleV1-v0'"):
        cross_test(run, "FollowObject/PnPSimplV1-v0")
    for damaged in ("[1]", "[" * 100_000):
        (run / CROSS_TESTS).write_text(damaged)
        with pytest.raises(ValueError, match="is not a file of cross tests"):
            read_cross_tests(run)
