"""The contract of layers refuses what CONTRIBUTING says that it refuses, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tree import PACKAGES, ROOT

INSIDE = "\n\ndef later() -> None:\n    "
FOR_TYPES = "\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    "

BROKEN = {
    "upwards": (
        "imagination/curriculum.py",
        "\nfrom ..ddpg.her_ddpg import HerDDPG\n",
        "sb3_follow_object.imagination is not allowed to import sb3_follow_object.ddpg",
    ),
    "upwards inside a function": (
        "replay/cher.py",
        f"{INSIDE}from ..ddpg.rnd import RndReward\n",
        "sb3_follow_object.replay is not allowed to import sb3_follow_object.ddpg",
    ),
    "upwards for types": (
        "common/seeds.py",
        f"{FOR_TYPES}from ..envs import Task\n",
        "sb3_follow_object.common is not allowed to import sb3_follow_object.envs",
    ),
    "a circle inside a function": (
        "replay/records.py",
        f"{INSIDE}from .record_buffer import RecordReplayBuffer\n",
        "no circles within a room BROKEN",
    ),
    "a circle for types": (
        "imagination/predictor_files.py",
        f"{FOR_TYPES}from .goal_predictor import GoalPredictor\n",
        "no circles within a room BROKEN",
    ),
    "a room without a floor": ("attic/__init__.py", "", "imports run downwards"),
}


def linted(tmp_path: Path, file: str, added: str) -> tuple[int, str]:
    """What the contracts say of the package when a line is added to a file."""
    for name, folder in PACKAGES.items():
        shutil.copytree(
            folder, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
        )
    changed = tmp_path / "sb3_follow_object" / file
    changed.parent.mkdir(exist_ok=True)
    with changed.open("a") as source:
        source.write(added)
    lint = [Path(sys.executable).parent / "lint-imports", "--no-cache", "--no-logo"]
    done = subprocess.run(
        [*lint, ROOT / "pyproject.toml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, " ".join(done.stdout.split())


def test_the_package_keeps_the_contracts(tmp_path: Path) -> None:
    assert linted(tmp_path, "common/seeds.py", "")[0] == 0


@pytest.mark.parametrize("case", BROKEN)
def test_what_they_forbid_is_refused(tmp_path: Path, case: str) -> None:
    file, added, sentence = BROKEN[case]
    status, said = linted(tmp_path, file, added)
    assert status == 1
    assert sentence in said
