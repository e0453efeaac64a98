"""Reports: one file that needs nothing else, with what was measured in it."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from sb3_follow_object.command.cli import main
from sb3_follow_object.comparison.report import write_comparison_report, write_run_report
from sb3_follow_object.runs.run_folder import claim
from sb3_follow_object.settings.presets import run_config

ROWS = [(1000, 0.0, 2), (2000, 0.25, 3), (3000, 0.75, 5)]
HEAD = (
    "env_steps,train_steps,test_steps,object_steps,wall_s,success_rate,mean_return,episodes,k_max"
)


def make_run(folder: Path, method: str = "fo", seed: int = 0, gain: float = 0.0) -> Path:
    claim(folder, run_config("FollowObject/PushSideGap-v0", method=method, seed=seed))
    lines = [HEAD]
    for steps, success, k_max in ROWS:
        lines.append(f"{steps},{steps},0,0,{steps / 100},{success + gain},-9.5,4,{k_max}")
    (folder / "evaluations.csv").write_text("\n".join(lines) + "\n")
    result = {"env_steps": 3000, "wall_s": 30.0, "success_rate": 0.75 + gain, "episodes": 8}
    (folder / "result.json").write_text(json.dumps(result))
    return folder


def charts(page: Path) -> dict[str, dict]:
    found = re.search(r'id="charts">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found
    return {chart["title"]: chart for chart in json.loads(found[1])}


class Links(HTMLParser):
    """Collects what a page asks for from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [str(value) for name, value in attrs if name in ("src", "href")]


def test_run_report_has_the_curves_that_were_measured(tmp_path: Path) -> None:
    write_run_report(make_run(tmp_path / "run"), tmp_path / "report.html", {})
    drawn = charts(tmp_path / "report.html")
    (line,) = drawn["success on original goals"]["series"]
    assert line["points"] == [[1000, 0.0], [2000, 0.25], [3000, 0.75]]
    assert drawn["k_max"]["series"][0]["points"] == [[1000, 2], [2000, 3], [3000, 5]]
    text = (tmp_path / "report.html").read_text()
    assert "0.750 of 8 episodes" in text
    assert "settings.curriculum.min_distance" in text and "stable-baselines3" in text


def test_logged_curves_of_all_resumptions_are_shown(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "progress_0.csv").write_text("eval/env_steps,train/q_mean\n1000,-3.5\n2000,\n")
    (run / "progress_2000.csv").write_text("eval/env_steps,train/q_mean\n3000,-2.5\n")
    write_run_report(run, tmp_path / "report.html", {})
    points = charts(tmp_path / "report.html")["train/q_mean"]["series"][0]["points"]
    assert points == [[1000, -3.5], [3000, -2.5]]


def test_pictures_are_inside_and_nothing_is_asked_for_from_elsewhere(tmp_path: Path) -> None:
    picture, film = tmp_path / "imagined.png", tmp_path / "video.mp4"
    picture.write_bytes(b"picture")
    film.write_bytes(b"film")
    shown = {"Goals <imagined>": picture, "Film": film}
    write_run_report(make_run(tmp_path / "run"), tmp_path / "report.html", shown)
    links = Links()
    links.feed((tmp_path / "report.html").read_text())
    assert links.found == ["data:image/png;base64,cGljdHVyZQ==", "data:video/mp4;base64,ZmlsbQ=="]
    assert "Goals &lt;imagined&gt;" in (tmp_path / "report.html").read_text()


def test_comparison_has_quartiles_over_seeds_and_what_settings_differ(tmp_path: Path) -> None:
    for seed, gain in enumerate((0.0, 0.2)):
        make_run(tmp_path / f"fo-{seed}", seed=seed, gain=gain)
    make_run(tmp_path / "her-0", method="her")
    write_comparison_report(tmp_path, tmp_path / "report.html", {})
    series = {s["name"]: s for s in charts(tmp_path / "report.html")["PushSideGap"]["series"]}
    assert set(series) == {"fo (2 seeds)", "her"}
    assert series["fo (2 seeds)"]["points"][-1] == [3000, 0.85]
    assert series["fo (2 seeds)"]["band"][-1] == [3000, 0.8, 0.9]
    assert "band" not in series["her"]
    text = (tmp_path / "report.html").read_text()
    assert "Settings in which they differ" in text and "Versions that all runs share" in text


def test_setting_that_is_null_in_one_run_and_missing_in_another_is_told(tmp_path: Path) -> None:
    make_run(tmp_path / "a")
    path = make_run(tmp_path / "b", seed=1) / "config.json"
    config = json.loads(path.read_text())
    config["settings"]["reach"] = None
    path.write_text(json.dumps(config))
    write_comparison_report(tmp_path, tmp_path / "report.html", {})
    _, _, differ = (tmp_path / "report.html").read_text().partition("Settings in which they differ")
    assert "<th>settings.reach</th>" in differ


def test_a_run_that_goes_on_has_a_line_of_its_own(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        make_run(tmp_path / f"fo-{seed}", seed=seed)
    running = tmp_path / "fo-2"
    (running / "result.json").unlink()
    (running / "evaluations.csv").write_text(f"{HEAD}\n1000,1000,0,0,10,0.0,-9.5,4,2\n")
    write_comparison_report(tmp_path, tmp_path / "report.html", {})
    series = {s["name"]: s for s in charts(tmp_path / "report.html")["PushSideGap"]["series"]}
    assert series["fo (2 seeds)"]["points"][-1] == [3000, 0.75]
    assert series["fo, seed 2 (unfinished)"]["points"] == [[1000, 0.0]]


def test_run_without_validations_is_left_out_and_a_damaged_one_refused(tmp_path: Path) -> None:
    make_run(tmp_path / "fo-0")
    curve = make_run(tmp_path / "fo-1", seed=1) / "evaluations.csv"
    for nothing in (HEAD, ""):
        curve.write_text(nothing)
        write_comparison_report(tmp_path, tmp_path / "report.html", {})
        (line,) = charts(tmp_path / "report.html")["PushSideGap"]["series"]
        assert line["name"] == "fo"
    curve.unlink()
    write_comparison_report(tmp_path, tmp_path / "report.html", {})
    for damaged in (f"{HEAD}\n1000,1000,0,0,10,many,-9.5,4,2\n", f"{HEAD}\n1000\n"):
        curve.write_text(damaged)
        with pytest.raises(ValueError, match=r"fo-1.evaluations.csv is not a file of evaluations"):
            write_comparison_report(tmp_path, tmp_path / "report.html", {})


def test_a_damaged_log_is_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "progress_0.csv").write_bytes(b"eval/env_steps,x\n1000,\xff\xfe\n")
    with pytest.raises(ValueError, match=r"progress_0\.csv is not a file of logged values"):
        write_run_report(run, tmp_path / "report.html", {})


def test_names_cannot_end_the_script_that_holds_the_data(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "progress_0.csv").write_text("eval/env_steps,</script><b>\n1000,1.0\n")
    write_run_report(run, tmp_path / "report.html", {})
    assert (tmp_path / "report.html").read_text().count("</script>") == 2
    assert "</script><b>" in charts(tmp_path / "report.html")


def test_command_writes_beside_the_run(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run = make_run(tmp_path / "run")
    assert main(["report", str(run)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(run / "report.html")
    assert (run / "report.html").exists()


@pytest.mark.parametrize("text", ["{", "3", "null"])
def test_damaged_versions_are_named(text: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "versions.json").write_text(text)
    with pytest.raises(ValueError, match=r"versions.json does not say what the run was made with"):
        write_run_report(run, tmp_path / "report.html", {})


def test_command_refuses_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "holds no runs" in capsys.readouterr().err
    assert main(["report", str(tmp_path), "--out", "report.pdf"]) == 2
    assert "report.pdf does not end in .html" in capsys.readouterr().err
