"""Run the tests of Stable-Baselines3 and Gymnasium-Robotics over this package's classes and ids.

    python benchmarks/foreign_tests.py --out benchmarks/foreign_tests.json

Their tests are fetched by pip, in the installed versions, as source distributions; a checkout of
either is taken instead with --source. Nothing in them is edited: this file is also a plugin of
pytest, which puts FollowObjectReplayBuffer where they import HerReplayBuffer, and this package's
ids into the list of environments that are tested.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import types
from collections import Counter
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
SUITES = {
    "stable-baselines3": [
        "tests/test_her.py",
        "tests/test_callbacks.py::test_eval_success_logging",
        "tests/test_n_step_replay.py::test_n_steps_with_dict_obs",
        "tests/test_vec_normalize.py::test_her_normalization",
    ],
    "gymnasium-robotics": ["tests/test_envs.py"],
}
# Tests that say nothing about this package, by how their name begins. The shares of success of
# test_performance_her were measured with its own settings and 1,500 steps.
_CHANCE = (
    "wants 0.90 of one seed, which is chance: with seeds 0 to 4 HerReplayBuffer has 0.98, 0.62, "
    "0.24, 0.72, 0.96 and FollowObjectReplayBuffer 0.26, 0.92, 0.94, 1.00, 0.80"
)
OTHER_SUBJECTS = {
    "test_performance_her": _CHANCE,
    "test_import_error": "is about a class that SB3 itself has no more",
    "test_robot_env_reset": "is about Fetch and HandReach ids only",
    "test_n_steps_with_dict_obs[None]": "has no hindsight buffer in it",
    "test_n_steps_with_dict_obs[DictReplayBuffer]": "has no hindsight buffer in it",
}
SUITE, RESULT = "FOREIGN_SUITE", "FOREIGN_RESULT"  # what the plugin is told by


def assert_equals(a: Any, b: Any, prefix: str = "") -> None:
    """Stand in for tests.utils of Gymnasium-Robotics, which its source distribution lacks."""
    assert type(a) is type(b), f"{prefix}{type(a)} is not {type(b)}"
    if isinstance(a, dict):
        assert list(a) == list(b), f"{prefix}{list(a)} are not {list(b)}"
        a, b = tuple(a.values()), tuple(b.values())
    if isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_equals(one, other, prefix)
    elif hasattr(a, "shape"):
        assert a.dtype == b.dtype and a.shape == b.shape and (a == b).all(), f"{prefix}{a}, {b}"
    else:
        assert a == b, f"{prefix}{a}, {b}"


def pytest_configure(config: pytest.Config) -> None:
    """Put this package's classes and ids where the tests look."""
    import gymnasium as gym
    import stable_baselines3 as sb3

    from sb3_follow_object import FollowObjectReplayBuffer

    config.stash[_OUTCOMES] = {}
    if os.environ[SUITE] == "stable-baselines3":
        sb3.HerReplayBuffer = sb3.her.HerReplayBuffer = FollowObjectReplayBuffer  # type: ignore
        return
    specs = [spec for spec in gym.registry.values() if spec.id.startswith("FollowObject/")]
    try:
        from tests import utils
    except ImportError:
        utils = types.ModuleType("tests.utils")
        utils.assert_equals = assert_equals  # type: ignore[attr-defined]
        sys.modules["tests.utils"] = utils
    utils.all_testing_env_specs = specs  # type: ignore[attr-defined]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what has another subject."""
    outcomes = config.stash[_OUTCOMES]
    for item in items:
        for name, reason in OTHER_SUBJECTS.items():
            if item.name.startswith(name):
                outcomes[item.nodeid] = ("deselected", reason)
    items[:] = [item for item in items if item.nodeid not in outcomes]


class Outcomes:
    """Writes what became of each test."""

    def __init__(self, config: pytest.Config) -> None:
        self.outcomes = config.stash[_OUTCOMES]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.skipped:
            self.outcomes[report.nodeid] = ("skipped", str(report.longrepr[2]))  # type: ignore
        elif report.failed:
            self.outcomes[report.nodeid] = ("failed", _message(report))
        elif report.when == "call":
            self.outcomes[report.nodeid] = ("passed", "")

    def pytest_sessionfinish(self) -> None:
        Path(os.environ[RESULT]).write_text(json.dumps(self.outcomes))


def _message(report: pytest.TestReport) -> str:
    """Return the first line of what a test failed with, which names no folder."""
    crash = getattr(report.longrepr, "reprcrash", None)
    return str(crash.message if crash else report.longrepr).splitlines()[0]


_OUTCOMES: pytest.StashKey[dict[str, tuple[str, str]]] = pytest.StashKey()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Register what listens to reports."""
    session.config.pluginmanager.register(Outcomes(session.config))


def fetch(project: str, folder: Path) -> Path:
    """Download a project's source distribution; return the folder with its tests."""
    wanted = f"{project}=={version(project)}"
    pip = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:"]
    subprocess.run([*pip, "-d", str(folder), wanted], check=True)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    (tests,) = folder.glob("*/tests")
    return tests.parent


def run(project: str, source: Path | None) -> dict[str, tuple[str, str]]:
    """Run a project's tests in a temporary copy; return what became of each and why."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = source or fetch(project, folder)
        copy, result = folder / "copy", folder / "result.json"
        # Only the tests: the project itself is the installed one.
        # Caches are left, as a checkout's may be of another Python.
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(source / "tests", copy / "tests", ignore=ignored)
        (copy / "tests" / "__init__.py").touch()
        (copy / "pytest.ini").write_text("[pytest]\n")
        path = os.pathsep.join([str(copy), str(ROOT / "benchmarks")])
        settings = {SUITE: project, RESULT: str(result), "PYTHONPATH": path}
        command = [sys.executable, "-m", "pytest", "-q", "-p", Path(__file__).stem]
        subprocess.run(
            [*command, *SUITES[project]], cwd=copy, env={**os.environ, **settings}, check=False
        )
        if not result.exists():
            raise SystemExit(f"the tests of {project} could not be run; what pytest says is above")
        return {test: tuple(what) for test, what in json.loads(result.read_text()).items()}


def commit() -> str:
    """Return this tree's commit, with a plus where it was changed since."""
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(git, check=False, capture_output=True, text=True).stdout.strip()


def summary(project: str, outcomes: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """Count outcomes, and list each test that did not pass with the reason."""
    return {
        "version": version(project),
        **Counter(what for what, _ in outcomes.values()),
        "not_passed": {
            test: f"{what}: {why}" for test, (what, why) in outcomes.items() if what != "passed"
        },
    }


def show(found: dict[str, Any], projects: Iterable[str]) -> None:
    """Print a table of outcomes, and below it why tests did not pass."""
    kinds = ("passed", "failed", "skipped", "deselected")
    print(f"{'':24}" + "".join(f"{kind:>12}" for kind in kinds))
    for project in projects:
        print(f"{project:24}" + "".join(f"{found[project].get(kind, 0):12}" for kind in kinds))
    for project in projects:
        for test, why in found[project]["not_passed"].items():
            print(f"{test}\n    {why}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=SUITES, action="append", help="one project's tests")
    parser.add_argument(
        "--source", action="append", default=[], metavar="PROJECT=DIR", help="a checkout"
    )
    parser.add_argument("--out", type=Path, help="JSON file for what was found")
    args = parser.parse_args()
    sources = {name: Path(folder) for name, _, folder in (s.partition("=") for s in args.source)}
    if unknown := set(sources) - set(SUITES):
        parser.error(f"--source knows {' and '.join(SUITES)}, not {', '.join(sorted(unknown))}")
    projects = args.only or list(SUITES)
    packages = ("gymnasium", "mujoco", "numpy", "torch", "pytest")
    found: dict[str, Any] = {
        "commit": commit(),
        "python": sys.version.split()[0],
        **{package: version(package) for package in packages},
    }
    for project in projects:
        found[project] = summary(project, run(project, sources.get(project)))
    show(found, projects)
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if any("failed" in found[project] for project in projects) else 0


if __name__ == "__main__":
    sys.exit(main())
