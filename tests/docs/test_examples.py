"""What the pages show works: Python runs, with little training; command lines are understood."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from pages import PAGES, blocks, commands, prose
from tiny import cache_networks, cache_predictor
from tree import ROOT

from sb3_follow_object.command.cli import _COMMANDS
from sb3_follow_object.command.cli_options import make_parser
from sb3_follow_object.envs import IDS
from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.settings.presets import parse_override, run_config

PYTHON = {block.text: block for block in reversed(blocks()) if block.kind == "python"}
YAML = [block for block in blocks() if block.kind == "yaml"]
OURS = commands("sb3-follow-object")
SMALL = {"batch_size": 16, "gradient_steps": 2, "policy_kwargs": {"net_arch": [8]}}
STAGES = {
    "n_envs": 2,
    "object_timesteps": 800,
    "n_paths": 16,
    "object_algorithm": SMALL,
    "predictor_fit": {"epochs": 1, "hidden": [8]},
    "inverse_fit": {"updates": 2, "hidden": [8]},
}


@pytest.fixture
def little(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder but for a run's policy, kept predictors, and stages that take a moment."""
    init, fit = FollowObject.__init__, GoalPredictor.fit

    def short(self: FollowObject, env_id: str | None = None, **given: Any) -> None:
        algorithm = {**given.pop("algorithm", {}), **SMALL}
        init(self, env_id, **{**given, **STAGES, "algorithm": algorithm})

    def quick(*args: Any, **given: Any) -> GoalPredictor:
        return fit(*args, **{**given, "epochs": 1, "hidden": (8,)})

    monkeypatch.setattr(FollowObject, "__init__", short)
    monkeypatch.setattr(GoalPredictor, "fit", quick)
    cache = tmp_path / "cache"
    cache_predictor(cache)
    cache_networks(cache)
    monkeypatch.setenv("SB3_FOLLOW_OBJECT_CACHE", str(cache))
    (tmp_path / "runs" / "shelf").mkdir(parents=True)
    policy = "policy.safetensors"
    kept = ROOT / "benchmarks" / "results" / "PnPShelf-fo-0"
    shutil.copy(kept / policy, tmp_path / "runs" / "shelf" / policy)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("code", PYTHON, ids=lambda code: PYTHON[code].name)
def test_python_runs_as_it_stands(code: str, little: None) -> None:
    shorter = re.sub(r"\.learn\([\d_]+", ".learn(200", code)
    exec(compile(shorter, PYTHON[code].name, "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("place", OURS)
def test_command_lines_are_understood(place: str) -> None:
    try:
        args = make_parser(_COMMANDS).parse_args(OURS[place])
    except SystemExit as stop:  # --version and the like have said all
        assert stop.code == 0
        return
    for word in getattr(args, "set", []):
        task = args.env if getattr(args, "env", None) in IDS else "FollowObject/PnPShelf-v0"
        method = getattr(args, "method", None) or "fo"
        run_config(task, method=method, overrides=dict([parse_override(word)]))


@pytest.mark.parametrize("block", YAML, ids=lambda block: block.name)
def test_yaml_is_yaml(block: Any) -> None:
    assert isinstance(yaml.safe_load(block.text), dict)


def test_settings_in_the_text_exist() -> None:
    for page in PAGES:
        for word in re.findall(r"--set ([\w.]+=[^\s`]+)", prose(page)):
            if word not in ("NAME=VALUE", "KEY.SUB=VALUE", "keep_checkpoints=N"):
                run_config("FollowObject/PnPShelf-v0", overrides=dict([parse_override(word)]))


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        named = re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(), re.MULTILINE)
        assert set(named) <= targets, page
