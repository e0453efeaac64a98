"""rl_zoo3 trains and plays from YAML alone, with stock DDPG and with HerDDPG."""

from __future__ import annotations

import csv
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny import HORIZON, TASK, cache_networks, cache_predictor
from tree import PACKAGES, run

from sb3_follow_object import zoo
from sb3_follow_object.envs import TASKS
from sb3_follow_object.runs.predictor_cache import CACHE_VARIABLE

pytest.importorskip("rl_zoo3")

CONFIGS = PACKAGES["sb3_follow_object/zoo_configs"]
STOCK = ["--gym-packages", "sb3_follow_object"]
TINY = ["batch_size:16", "gradient_steps:2", "policy_kwargs:dict(net_arch=[16])"]
TINY += ["learning_starts:0", "buffer_size:4000"]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    cache_predictor(folder)
    cache_networks(folder)
    return folder


def one_test(file: str, n_envs: int) -> int:
    """Steps after which a file's curriculum has had one test, and a cycle could print it."""
    entries = yaml.safe_load((CONFIGS / file).read_text())
    entry = entries.get(TASK, entries["default"])  # as rl_zoo3 looks it up
    (options,) = entry["callback"][0].values()
    return (options["every"] * n_envs + options["n_episodes"]) * HORIZON + 1


def train(folder: Path, cache: Path, module: str, *arguments: str, n_envs: int, steps: int) -> str:
    """Train with a file's settings, but for the size of the networks."""
    options = ["--env", TASK, "-n", str(steps), "--seed", "1", "--log-interval", "1"]
    options += ["--eval-freq", "100", "--eval-episodes", "1", "--num-threads", "1"]
    options += ["-params", *TINY, f"n_envs:{n_envs}"]
    command = [sys.executable, "-m", *module.split(), *arguments, *options]
    return run(command, cwd=folder, env={**os.environ, CACHE_VARIABLE: str(cache)})


def play(folder: Path, module: str, *arguments: str) -> str:
    """Play two episodes where no predictor can be had: none is needed."""
    options = ["--env", TASK, "-f", "logs", "-n", str(2 * HORIZON), "--no-render"]
    command = [sys.executable, "-m", *module.split(), *arguments, *options]
    return run(command, cwd=folder, env={**os.environ, CACHE_VARIABLE: os.devnull})


def check_run(folder: Path, n_envs: int) -> None:
    """Evaluations and monitor files say what succeeded."""
    with np.load(folder / "evaluations.npz") as evaluations:
        assert evaluations["successes"].shape[1] == 1
    assert len(list(folder.glob("*.monitor.csv"))) == n_envs


@pytest.mark.parametrize("n_envs", [1, 2])
def test_stock_ddpg_trains_and_plays(n_envs: int, cache: Path, tmp_path: Path) -> None:
    stock = ["--algo", "ddpg", *STOCK]
    file = ["--conf-file", str(CONFIGS / "ddpg.yml")]
    steps = one_test("ddpg.yml", n_envs)
    out = train(tmp_path, cache, "rl_zoo3.train", *stock, *file, n_envs=n_envs, steps=steps)
    for name in ("k_max", "test_success", "test_steps", "success_rate", "n_updates"):
        assert name in out
    folder = tmp_path / "logs" / "ddpg" / "FollowObject-PushSideGap-v0_1"
    check_run(folder, n_envs)
    with open(folder / "0.monitor.csv") as file_:
        next(file_)  # the creation time
        assert "is_success" in next(csv.reader(file_))
    if n_envs == 1:
        assert "Success rate:" in play(tmp_path, "rl_zoo3.enjoy", *stock)


@pytest.mark.parametrize(("method", "n_envs"), [("fo", 2), ("her", 1), ("sldr", 1), ("rher", 2)])
def test_her_ddpg_trains_and_plays(method: str, n_envs: int, cache: Path, tmp_path: Path) -> None:
    steps = one_test("fo.yml", n_envs) if method == "fo" else 4 * HORIZON
    file = [] if method == "fo" else ["--conf-file", str(CONFIGS / f"{method}.yml")]
    module = "sb3_follow_object.zoo"
    out = train(tmp_path, cache, f"{module} train", *file, n_envs=n_envs, steps=steps)
    assert ("k_max" in out) == ("test_success" in out) == (method == "fo")
    assert "moved_share" in out  # only HerDDPG logs it
    assert ("sldr/" in out) == (method == "sldr")
    assert ("reach/" in out) == (method == "rher")
    check_run(tmp_path / "logs" / "her_ddpg" / "FollowObject-PushSideGap-v0_1", n_envs)
    if method != "her":
        assert "Success rate:" in play(tmp_path, f"{module} enjoy")


@pytest.mark.parametrize("algorithm", ["ddpg", "tqc"])
def test_stock_algorithms_reach_first(algorithm: str, cache: Path, tmp_path: Path) -> None:
    entry = yaml.safe_load((CONFIGS / "ddpg.yml").read_text())["default"]
    entry["env_wrapper"].append({"sb3_follow_object.ReachFirstWrapper": {"height": 0.05}})
    teaching = {"share": 1.0, "n_updates": 2, "batch_size": 16}
    entry["callback"].insert(0, {"sb3_follow_object.ReachCallback": teaching})
    (tmp_path / "reach.yml").write_text(yaml.safe_dump({TASK: entry}))
    stock = ["--algo", algorithm, *STOCK, "--conf-file", "reach.yml"]
    steps = one_test("ddpg.yml", 2)
    out = train(tmp_path, cache, "rl_zoo3.train", *stock, n_envs=2, steps=steps)
    for name in ("share", "own_success", "k_max", "test_success"):
        assert name in out
    check_run(tmp_path / "logs" / algorithm / "FollowObject-PushSideGap-v0_1", 2)
    assert "Success rate:" in play(tmp_path, "rl_zoo3.enjoy", *stock[:4])


def test_ddpg_file_has_every_task_with_its_horizon() -> None:
    entries = yaml.safe_load((CONFIGS / "ddpg.yml").read_text())
    for name, task in TASKS.items():
        entry = entries.get(f"FollowObject/{name}-v0", entries["default"])
        assert entry["train_freq"] == task.horizon
        assert entry["gamma"] == pytest.approx(1.0 - 1.0 / task.horizon)


@pytest.mark.parametrize("arguments", [[], ["fly"], ["--algo", "her_ddpg"]])
def test_unknown_command_is_one_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert zoo.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "give train, enjoy, record_video, load_from_hub or push_to_hub first" in line
