"""The site is built without a warning, and nothing that it should name is missing."""

import csv
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from pages import PAGES, anchors, links
from sphinx.util.inventory import InventoryFile
from tree import ROOT, run

import sb3_follow_object
import sb3_follow_object.envs
from sb3_follow_object.command.cli import _COMMANDS
from sb3_follow_object.envs.task_table import BUILT_IN, TASKS
from sb3_follow_object.settings.methods import METHODS

NAMES = [
    f"{module.__name__}.{name}"
    for module in (sb3_follow_object, sb3_follow_object.envs)
    for name in module.__all__
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it."""
    out = tmp_path_factory.mktemp("site")
    sphinx = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    run([*sphinx, "-d", str(out / "doctrees"), "docs", str(out / "html")], cwd=ROOT)
    return out / "html"


def test_every_page_is_built_without_a_warning(site: Path) -> None:
    for page in (ROOT / "docs").glob("**/*.md"):
        assert (site / page.relative_to(ROOT / "docs").with_suffix(".html")).is_file()


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    with open(site / "objects.inv", "rb") as file:
        inventory = InventoryFile.load(file, "", lambda base, page: page)
    known = {name for kind, names in inventory.items() if kind[:3] == "py:" for name in names}
    assert set(NAMES) <= known


def test_the_reference_is_made_of_docstrings(site: Path) -> None:
    text = (site / "api" / "training.html").read_text()
    assert "Teach a robot a far goal by letting the object find the way first." in text
    assert "F_phi made before for this task; skips the first two stages" in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize(
    ("page", "names"),
    [("commands.md", list(_COMMANDS)), ("methods/index.md", METHODS)],
    ids=["commands", "methods"],
)
def test_tables_name_every_command_and_method(page: str, names: list[str]) -> None:
    text = (ROOT / "docs" / page).read_text()
    rows = set(re.findall(r"^\| `(\w[\w-]*)", text, re.MULTILINE))
    assert rows == set(names)


def test_every_task_has_its_row_with_the_steps_of_its_preset() -> None:
    text = (ROOT / "docs" / "quickstart.md").read_text()
    rows = dict(re.findall(r"^\| (P\w+) \|.*\| ([\d,]+) \|$", text, re.MULTILINE))
    assert rows == {
        name: f"{sb3_follow_object.run_config(f'FollowObject/{name}-v0').total_timesteps:,}"
        for name in TASKS
        if f"FollowObject/{name}-v0" in BUILT_IN
    }


def benchmark(name: str) -> ModuleType:
    """A script of benchmarks/, which are no part of the package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_of_results_are_of_the_runs_that_are_kept() -> None:
    collect = benchmark("collect")
    rows = collect.read_rows()
    assert len(collect.PAGES) == 4
    for page, table in collect.PAGES.items():
        assert collect.with_table(page.read_text(), table(rows)) == page.read_text()
    with open(collect.RESULTS / "summary.csv", newline="") as file:
        named = [(row["task"], row["method"], int(row["seed"])) for row in csv.DictReader(file)]
    assert named == [(row["task"], row["method"], row["seed"]) for row in rows]


def test_tables_say_what_was_stopped_or_not_run() -> None:
    collect = benchmark("collect")

    def row(seed: int, *success: float, final: float | None = None) -> dict[str, Any]:
        seen = [
            {"env_steps": 1000.0 * n, "wall_s": 60.0 * n, "success_rate": rate, "episodes": 76.0}
            for n, rate in enumerate(success, start=1)
        ]
        named = {"task": "PnPShelf", "method": "fo", "seed": seed, "env_steps": 5000, "wall_s": 90}
        return {**named, "validations": seen, **({} if final is None else {"success_rate": final})}

    runs = [row(0, 0.1, 0.95, final=0.9), row(1, 0.2, 0.3, 0.92, final=0.97), row(2, 0.0, 0.4)]
    line = next(line for line in collect.small_table(runs).splitlines() if "PnPShelf" in line)
    cells = line.strip("| ").split(" | ")
    assert cells[1:4] == ["3,000", "3", "0, 1, 2"], "a run that is not there counts as the last"
    assert cells[4] == "0.94 (0.90 to 0.97); 0.40 of 76, 1 stopped"
    assert collect.in_the_end(runs[2:]) == "0.40 of 76, stopped"
    assert collect.in_the_end([row(0, 0.5), row(1, 0.7)]) == "0.50 to 0.70 of 76, 2 stopped"
    assert cells[5:] == ["not run", "not run"]
    assert "| not yet |" in collect.full_table(runs[2:])


def test_readme_is_a_page() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
