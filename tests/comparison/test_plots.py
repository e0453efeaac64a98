"""Learning curves: what is read from run folders and what is drawn."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from result_folders import finish

from sb3_follow_object.callbacks.eval_callback import OriginalGoalEvalCallback
from sb3_follow_object.comparison import plots
from sb3_follow_object.comparison.plots import (
    by_settings,
    draw_curves,
    read_curve,
    spread,
    was_validated,
)
from sb3_follow_object.runs.run_folder import CONFIG, EVALUATIONS
from sb3_follow_object.settings.run_config import RunConfig

TASK = "FollowObject/PnPShelf-v0"
PNG = b"\x89PNG"


def run_folder(
    path: Path, success: list[float], method: str = "fo", step: int = 100, **settings: Any
) -> Path:
    path.mkdir()
    config = RunConfig(TASK, method, settings=settings)
    (path / CONFIG).write_text(json.dumps(asdict(config)))
    rows = [",".join(OriginalGoalEvalCallback.COLUMNS)]
    for i, rate in enumerate(success, start=1):
        k_max = i if method == "fo" else ""
        rows.append(f"{i * step},{i * step},0,0,{60.0 * i},{rate},-1.0,8,{k_max}")
    (path / EVALUATIONS).write_text("\n".join(rows) + "\n")
    return path


def test_curve_holds_the_validations(tmp_path: Path) -> None:
    curve = read_curve(run_folder(tmp_path / "fo", [0.1, 0.4]))
    assert (curve.task, curve.method) == (TASK, "fo")
    assert curve.columns["env_steps"].tolist() == [100, 200]
    assert curve.columns["success_rate"].tolist() == [0.1, 0.4]
    assert curve.columns["k_max"].tolist() == [1, 2]
    assert "k_max" not in read_curve(run_folder(tmp_path / "her", [0.1], "her")).columns


def test_quartiles_are_taken_where_all_runs_have_been(tmp_path: Path) -> None:
    curves = [
        read_curve(run_folder(tmp_path / "a", [0.0, 0.2, 0.4])),
        read_curve(run_folder(tmp_path / "b", [0.0, 1.0], step=200)),
        read_curve(run_folder(tmp_path / "c", [0.4, 0.4, 0.4, 0.4])),
    ]
    points, quartiles = spread(curves, "env_steps", "success_rate")
    assert points.tolist() == [200, 300]
    values = [[0.2, 0.4], [0.0, 0.5], [0.4, 0.4]]
    np.testing.assert_allclose(quartiles, np.quantile(values, [0.25, 0.5, 0.75], axis=0))


def test_one_run_is_its_own_median(tmp_path: Path) -> None:
    curve = read_curve(run_folder(tmp_path / "a", [0.0, 0.2, 0.4]))
    points, quartiles = spread([curve], "wall_s", "success_rate")
    assert points.tolist() == [60, 120, 180]
    np.testing.assert_allclose(quartiles, [[0.0, 0.2, 0.4]] * 3)


@pytest.mark.parametrize("methods", [["fo"], ["her"], ["fo", "fo", "her", "her"]])
def test_figure_is_written(tmp_path: Path, methods: list[str]) -> None:
    folders = [
        run_folder(tmp_path / str(i), [0.1 * i, 0.3], method) for i, method in enumerate(methods)
    ]
    draw_curves(folders, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(PNG)


def test_runs_with_other_settings_are_lines_of_their_own(tmp_path: Path) -> None:
    curves = [
        read_curve(run_folder(tmp_path / name, [0.1, 0.3], n_envs=16, **settings))
        for name, settings in {
            "preset": {"reach": {}},
            "seed 1, on two threads": {"reach": {}, "n_threads": 2},
            "without": {"reach": None},
            "another tau": {"reach": {}, "algorithm": {"tau": 0.05}},
        }.items()
    ]
    found = {words: len(group) for words, group in by_settings(curves).items()}
    assert found == {"": 2, "reach=null": 1, "algorithm.tau=0.05": 1}
    assert list(by_settings(curves[:2])) == [""]


def test_run_is_drawn_once_and_a_copy_of_it_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(plots, "_draw_group", lambda *given: drawn.append(len(given[2])))
    run = run_folder(tmp_path / "run", [0.1, 0.3])
    (tmp_path / "latest").symlink_to("run")
    draw_curves([run, run, tmp_path / "latest"], tmp_path / "curves.png")
    assert drawn == [1]
    finish(run)
    copy = shutil.copytree(run, tmp_path / "copy")
    with pytest.raises(ValueError, match="would count twice"):
        draw_curves([run, copy], tmp_path / "curves.png")


def test_folder_without_validations_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has not been validated yet"):
        read_curve(run_folder(tmp_path / "new", []))
    with pytest.raises(ValueError, match="holds no run"):
        read_curve(tmp_path / "none")
    damaged = run_folder(tmp_path / "damaged", [0.1])
    for text in ("1,2,many\n", "1,2,0.1,,\n2,", "1,2,0.1,,\n2,3,0.2,,,4\n"):
        (damaged / EVALUATIONS).write_text(f"env_steps,wall_s,success_rate,k_max,episodes\n{text}")
        with pytest.raises(ValueError, match="is not a file of evaluations"):
            read_curve(damaged)


@pytest.mark.parametrize(
    "damage", [b'"' + 200_000 * b"1", b"\xff\xfe1"], ids=["quote that never ends", "no text"]
)
def test_file_that_is_no_csv_is_named(damage: bytes, tmp_path: Path) -> None:
    path = run_folder(tmp_path / "run", [0.1]) / EVALUATIONS
    path.write_bytes(path.read_bytes() + damage)
    for read in (read_curve, was_validated):
        with pytest.raises(ValueError, match=r"evaluations.csv is not a file of evaluations \("):
            read(tmp_path / "run")
