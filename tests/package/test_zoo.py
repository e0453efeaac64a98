"""rl_zoo3 trains and plays from YAML alone, with stock DDPG and with HerDDPG."""

from __future__ import annotations

import csv
import io
import os
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny import HORIZON, TASK, cache_networks, cache_predictor
from tree import PACKAGES, run

from sb3_follow_object import zoo
from sb3_follow_object.envs import TASKS
from sb3_follow_object.runs.predictor_cache import CACHE_VARIABLE
from sb3_follow_object.settings.presets import run_config

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


CURRICULUM_TESTS = "sb3_follow_object.CurriculumCallback"


def one_test(file: str, n_envs: int) -> int:
    """Steps after which a file's curriculum has had one test, and a cycle could print it."""
    entries = yaml.safe_load((CONFIGS / file).read_text())
    entry = entries.get(TASK, entries["default"])  # as rl_zoo3 looks it up
    options = {name: given for each in entry["callback"] for name, given in each.items()}[
        CURRICULUM_TESTS
    ]
    return (options["every"] * n_envs + options["n_episodes"]) * HORIZON + 1


def call(stock: bool, command: str, arguments: list[str], cache: object, fresh: bool) -> str:
    """Run one of rl_zoo3's commands in the current folder; return what it said.

    Args:
        stock: as rl_zoo3 itself, which knows nothing of HerDDPG.
        command: train or enjoy.
        arguments: of the command.
        cache: folder of the predictors.
        fresh: in a process of its own, rather than in this one that has imported all already.
    """
    if fresh:
        module = [f"rl_zoo3.{command}"] if stock else ["sb3_follow_object.zoo", command]
        env = {**os.environ, CACHE_VARIABLE: str(cache)}
        return run([sys.executable, "-m", *module, *arguments], env=env)
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said):
        patch.setenv(CACHE_VARIABLE, str(cache))
        patch.setattr(sys, "argv", [command, *arguments])
        if stock:
            runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")
        else:
            assert zoo.main([command, *arguments]) == 0
    return said.getvalue()


def train(
    cache: Path, *arguments: str, stock: bool, n_envs: int, steps: int, fresh: bool = False
) -> str:
    """Train with a file's settings, but for the size of the networks."""
    options = ["--env", TASK, "-n", str(steps), "--seed", "1", "--log-interval", "1"]
    options += ["--eval-freq", "200", "--eval-episodes", "1", "--num-threads", "1"]
    options += ["-params", *TINY, f"n_envs:{n_envs}"]
    return call(stock, "train", [*arguments, *options], cache, fresh)


def play(*arguments: str, stock: bool, fresh: bool = False) -> str:
    """Play two episodes where no predictor can be had: none is needed."""
    options = ["--env", TASK, "-f", "logs", "-n", str(2 * HORIZON), "--no-render"]
    return call(stock, "enjoy", [*arguments, *options], os.devnull, fresh)


def check_run(folder: Path, n_envs: int) -> None:
    """Evaluations and monitor files say what succeeded."""
    with np.load(folder / "evaluations.npz") as evaluations:
        assert evaluations["successes"].shape[1] == 1
    assert len(list(folder.glob("*.monitor.csv"))) == n_envs


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which commands run in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("n_envs", [1, 2])
def test_stock_ddpg_trains_and_plays(n_envs: int, cache: Path, folder: Path) -> None:
    stock = ["--algo", "ddpg", *STOCK]
    file = ["--conf-file", str(CONFIGS / "ddpg.yml")]
    fresh = n_envs == 1
    steps = one_test("ddpg.yml", n_envs)
    out = train(cache, *stock, *file, stock=True, n_envs=n_envs, steps=steps, fresh=fresh)
    for name in ("k_max", "test_success", "test_steps", "success_rate", "n_updates"):
        assert name in out
    logs = folder / "logs" / "ddpg" / "FollowObject-PushSideGap-v0_1"
    check_run(logs, n_envs)
    with open(logs / "0.monitor.csv") as file_:
        next(file_)  # the creation time
        assert "is_success" in next(csv.reader(file_))
    if fresh:
        assert "Success rate:" in play(*stock, stock=True, fresh=True)


@pytest.mark.parametrize(("method", "n_envs"), [("fo", 2), ("her", 1), ("sldr", 1), ("rher", 2)])
def test_her_ddpg_trains_and_plays(method: str, n_envs: int, cache: Path, folder: Path) -> None:
    steps = one_test("fo.yml", n_envs) if method == "fo" else 4 * HORIZON
    file = [] if method == "fo" else ["--conf-file", str(CONFIGS / f"{method}.yml")]
    fresh = method == "fo"
    out = train(cache, *file, stock=False, n_envs=n_envs, steps=steps, fresh=fresh)
    assert ("k_max" in out) == ("test_success" in out) == (method == "fo")
    assert "moved_share" in out  # only HerDDPG logs it
    assert ("sldr/" in out) == (method == "sldr")
    assert ("reach/" in out) == (method in ("fo", "rher"))
    check_run(folder / "logs" / "her_ddpg" / "FollowObject-PushSideGap-v0_1", n_envs)
    if method != "her":
        assert "Success rate:" in play(stock=False, fresh=fresh)


@pytest.mark.parametrize(
    ("algorithm", "file"), [("td3", "ddpg.yml"), ("sac", "sac.yml"), ("tqc", "tqc.yml")]
)
def test_files_serve_stock_algorithms(algorithm: str, file: str, cache: Path, folder: Path) -> None:
    stock = ["--algo", algorithm, *STOCK]
    conf = ["--conf-file", str(CONFIGS / file)]
    out = train(cache, *stock, *conf, stock=True, n_envs=2, steps=one_test(file, 2))
    for name in ("share", "own_success", "k_max", "test_success"):
        assert name in out
    check_run(folder / "logs" / algorithm / "FollowObject-PushSideGap-v0_1", 2)
    assert "Success rate:" in play(*stock, stock=True)


@pytest.mark.parametrize("file", ["ddpg.yml", "sac.yml", "tqc.yml"])
def test_stock_files_say_what_the_preset_says(file: str) -> None:
    stock = yaml.safe_load((CONFIGS / file).read_text())
    own = yaml.safe_load((CONFIGS / "fo.yml").read_text())
    for name in TASKS:
        env_id = f"FollowObject/{name}-v0"
        entry, preset = stock.get(env_id, stock["default"]), own.get(env_id, own["default"])
        for key in ("env_wrapper", "callback", "n_envs", "batch_size", "gradient_steps", "tau"):
            assert entry[key] == preset[key], (name, key)
        given = dict(entry["replay_buffer_kwargs"])
        assert given.pop("n_sampled_goal") == 4 and given == preset["replay_buffer_kwargs"]


@pytest.mark.parametrize("env_id", ["FetchPush-v4", "FetchSlide-v4", "FetchPickAndPlace-v4"])
def test_rl_zoo3_and_train_read_the_same_of_gymnasium_robotics_tasks(env_id: str) -> None:
    entries = yaml.safe_load((CONFIGS / "fo.yml").read_text())
    entry = entries.get(env_id, entries["default"])
    config = run_config(env_id)
    algorithm = config.settings["algorithm"]
    assert entry["n_timesteps"] == config.total_timesteps
    for name in ("replay_buffer_kwargs", "gradient_steps", "batch_size", "policy_kwargs"):
        assert entry[name] == algorithm[name], name


def test_of_sac_and_tqc_sac_alone_has_one_critic() -> None:
    sac, tqc = (yaml.safe_load((CONFIGS / file).read_text()) for file in ("sac.yml", "tqc.yml"))
    assert set(sac) == set(tqc)
    for name, entry in sac.items():
        kwargs = entry["policy_kwargs"].replace(" n_critics=1,", "")
        assert {**entry, "policy_kwargs": kwargs} == tqc[name]


@pytest.mark.parametrize("file", ["ddpg.yml", "sac.yml", "tqc.yml"])
def test_stock_files_have_every_task_with_its_horizon(file: str) -> None:
    entries = yaml.safe_load((CONFIGS / file).read_text())
    for name, task in TASKS.items():
        entry = entries.get(f"FollowObject/{name}-v0", entries["default"])
        assert entry["train_freq"] == task.horizon
        assert entry["gamma"] == pytest.approx(1.0 - 1.0 / task.horizon)
        if file == "ddpg.yml":
            assert entry["policy_kwargs"]["target_clip"] == [-task.horizon, 0]


@pytest.mark.parametrize("arguments", [[], ["fly"], ["--algo", "her_ddpg"]])
def test_unknown_command_is_one_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert zoo.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "give train, enjoy, record_video, load_from_hub or push_to_hub first" in line
