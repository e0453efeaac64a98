"""Settings that must stand before torch and mujoco are imported, and fixtures that tests share."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tree import PACKAGES, ROOT, run

# Small networks and small scenes: more threads only make the test processes wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session", autouse=True)
def few_copies() -> None:
    """What runs in the tests' own processes is tested on few episodes."""
    import tiny_runs  # not before the line above

    tiny_runs.evaluate_in_few_copies()


@pytest.fixture(autouse=True)
def no_tasks_of_other_tests() -> Iterator[None]:
    """A task that a test registers is not there for the next: some go through all tasks."""
    yield
    import registered_tasks  # not before the line above

    registered_tasks.forget_tasks()


DRAW_ONE_PICTURE = """
import mujoco
renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
renderer.close()
"""


@pytest.fixture(scope="session")
def can_draw() -> None:
    """Skips where mujoco finds no OpenGL; asks a process of its own, which a driver may end."""
    reasons = []
    for library in [os.environ["MUJOCO_GL"]] if "MUJOCO_GL" in os.environ else ["egl", "osmesa"]:
        tried = subprocess.run(
            [sys.executable, "-c", DRAW_ONE_PICTURE],
            env={**os.environ, "MUJOCO_GL": library},
            capture_output=True,
            text=True,
            check=False,
        )
        if tried.returncode == 0:
            os.environ["MUJOCO_GL"] = library
            return
        last_line = (tried.stderr.strip().splitlines() or [f"exit {tried.returncode}"])[-1]
        reasons.append(f"{library}: {last_line}")
    pytest.skip(f"no OpenGL ({'; '.join(reasons)})")


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the source distribution as an installer would, without a download."""
    source = tmp_path_factory.mktemp("source")
    for folder in (*PACKAGES.values(), ROOT / "tests"):
        shutil.copytree(
            folder, source / folder.name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
        )
    for file in ROOT.iterdir():
        if file.is_file():
            shutil.copy(file, source)
    built = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(built), str(source)]
    run(command)
    (path,) = built.glob("*.whl")
    return path


@pytest.fixture(scope="session")
def bare_python(wheel: Path) -> Callable[..., Path]:
    """Makes an environment with the wheel in it; what it depends on is seen through a path file.

    Packages named beside the folder are downloaded, with what they need that the path lacks, and
    come before the ones seen through it.
    """

    def make(folder: Path, *packages: str) -> Path:
        venv.create(folder, with_pip=False, symlinks=True)
        python = folder / "bin" / "python"
        pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q"]
        run([*pip, "--no-deps", "--no-index", str(wheel)])
        (own,) = folder.glob("lib/python*/site-packages")
        # A folder that a .pth names does not have its own .pth files read, so the editable install
        # of this tree stays out of sight.
        (own / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
        if packages:
            run([*pip, "--upgrade", *packages])
        return python

    return make
