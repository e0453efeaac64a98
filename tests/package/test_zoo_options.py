"""Every option of rl_zoo3 works for her_ddpg or is refused in a sentence."""

from __future__ import annotations

import csv
import pickle
import re
import shutil
import sys
import zipfile
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import gymnasium_robotics  # noqa: F401  (registers the ids)
import numpy as np
import pytest
import yaml
from tiny import HORIZON, TASK, cache_predictor
from tree import PACKAGES

from sb3_follow_object import zoo
from sb3_follow_object.envs import registration
from sb3_follow_object.runs.predictor_cache import CACHE_VARIABLE

pytest.importorskip("rl_zoo3")

NAME = "FollowObject-PushSideGap-v0"
RUN = f"logs/her_ddpg/{NAME}_1"
STEPS = 4 * HORIZON
REPLAY = {"moved_distance": 0.05, "min_goal_distance": 0.05}
SETTINGS = {
    "n_timesteps": STEPS,
    "policy": "MultiInputPolicy",
    "n_envs": 2,
    "batch_size": 16,
    "gradient_steps": 2,
    "buffer_size": 4000,
    "policy_kwargs": {"net_arch": [16], "features_clip": 4.0},
    "replay_buffer_kwargs": {**REPLAY, "moved_ratio": 0.5},
}
STUDY = ["--storage", "s.log", "--study-name", "one"]
TRAIN = ["train", "--env", TASK, "--conf-file", "tiny.yml", "--seed", "1"]
DDPG = [
    "--algo",
    "ddpg",
    "--conf-file",
    str(PACKAGES["sb3_follow_object/zoo_configs"] / "ddpg.yml"),
]


def zoo_exits(status: int, *arguments: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", sys.argv)
        assert zoo.main(arguments) == status


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run that saved all that it could."""
    folder = tmp_path_factory.mktemp("zoo")
    (folder / "tiny.yml").write_text(yaml.safe_dump({"default": SETTINGS}))
    options = ["--save-freq", "100", "--save-replay-buffer", "--eval-freq", "100", "-tb", "tb"]
    options += ["--eval-episodes", "1", "--n-eval-envs", "2", "--log-interval", "1", "-P"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        zoo_exits(0, *TRAIN, *options, "-tags", "one", "two", "--device", "cpu")
    return folder


@pytest.fixture
def folder(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of that folder, to run commands in."""
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("env_id", "name"),
    [("own_tasks:FollowObject/PushPast-v0", "FollowObject-PushPast-v0"), ("FetchPush-v4",) * 2],
)
def test_ids_of_others_are_known_to_the_door(
    env_id: str, name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robotics = {"FetchPush-v4": gym.spec("FetchPush-v4")}
    monkeypatch.delitem(gym.registry, "FetchPush-v4")
    monkeypatch.setattr(registration, "import_robotics", lambda: gym.registry.update(robotics))
    (folder / "few.yml").write_text(yaml.safe_dump({"default": {**SETTINGS, "n_timesteps": 100}}))
    zoo_exits(0, "train", "--env", env_id, "--conf-file", "few.yml", "--eval-freq", "-1")
    assert (folder / "logs" / "her_ddpg" / f"{name}_1" / f"{name}.zip").exists()


def test_train_saves_what_it_is_asked_to(trained: Path) -> None:
    names = {path.name for path in (trained / RUN).iterdir()}
    assert {"rl_model_100_steps.zip", "rl_model_200_steps.zip", "best_model.zip"} <= names
    assert {"replay_buffer.pkl", "evaluations.npz", "0.monitor.csv", "1.monitor.csv"} <= names
    assert list((trained / "tb" / NAME).glob("*/events*"))


@pytest.mark.parametrize("storage", ["sqlite:///study.db", "study.log"])
def test_a_search_draws_settings_that_a_run_can_take(
    storage: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zoo, "_NET_ARCHS", {"small": [8], "medium": [8, 8], "big": [8, 8, 8]})
    study = ["--storage", storage, "--study-name", "one"]
    options = ["--n-trials", "3", "--n-startup-trials", "1", "--eval-episodes", "1"]
    zoo_exits(0, *TRAIN, "-optimize", *study, *options, "--optimization-log-path", "trials")
    (report,) = (folder / "logs" / "her_ddpg").glob("report_*.csv")
    with open(report) as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["COMPLETE"] * 3
    assert all(np.isfinite(float(row["value"])) for row in rows)
    assert (folder / "trials" / "trial_2" / "best_model.zip").exists()

    zoo_exits(0, *TRAIN, *study, "--trial-id", "1", "-f", "tried")
    model = zoo.ZooHerDDPG.load(folder / "tried" / "her_ddpg" / f"{NAME}_1" / f"{NAME}.zip")
    drawn = {key.removeprefix("params_"): value for key, value in rows[1].items()}
    for name in ("batch_size", "gradient_steps", "tau", "noise_std", "random_action_prob"):
        assert float(drawn[name]) == getattr(model, name)
    assert float(drawn["average_decay"]) == model.average_decay
    assert drawn["hindsight_bound"] == str(model.hindsight_bound)
    # The rest of the file stays.
    assert model.policy_kwargs["features_clip"] == 4.0
    assert model.policy_kwargs["net_arch"] == zoo._NET_ARCHS[drawn["net_arch"]]
    assert str(model.policy.critic_layer_norm) == drawn["critic_layer_norm"]
    saved = yaml.unsafe_load((folder / f"tried/her_ddpg/{NAME}_1/{NAME}/config.yml").read_text())
    assert saved["replay_buffer_kwargs"] == SETTINGS["replay_buffer_kwargs"]
    assert saved["n_sampled_goal"] == int(drawn["n_sampled_goal"])

    zoo_exits(0, *TRAIN, *study, "--trial-id", "2", "-i", f"{RUN}/{NAME}.zip", "-f", "went_on")
    model = zoo.ZooHerDDPG.load(folder / "went_on" / "her_ddpg" / f"{NAME}_1" / f"{NAME}.zip")
    assert model.tau == float(rows[2]["params_tau"])
    assert model.policy_kwargs["net_arch"] == [16]


def test_settings_of_a_trial_join_those_of_the_file() -> None:
    model = zoo.ZooHerDDPG(
        "MultiInputPolicy",
        gym.make(TASK),
        buffer_size=100,
        n_sampled_goal=7,
        net_arch=[8],
        replay_buffer_kwargs=REPLAY,
        policy_kwargs={"features_clip": 4.0},
    )
    assert model.replay_buffer.her_ratio == pytest.approx(7 / 8)
    assert model.replay_buffer.min_goal_distance == 0.05
    assert model.actor.features_extractor.clip == 4.0


def test_trials_of_stock_ddpg_run_with_a_curriculum(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(folder / "cache"))
    cache_predictor(folder / "cache")
    options = ["-n", "400", "-optimize", "--n-trials", "1", "--n-evaluations", "4"]
    options += ["--eval-episodes", "1", "--no-optim-plots", "--gym-packages", "sb3_follow_object"]
    settings = ["n_envs:2", "learning_starts:100", "buffer_size:4000"]
    zoo_exits(0, "train", "--env", TASK, *DDPG, *options, "-params", *settings)
    (report,) = (folder / "logs" / "ddpg").glob("report_*.csv")
    with open(report) as file:
        (row,) = csv.DictReader(file)
    assert float(row["value"]) == -HORIZON


@pytest.mark.parametrize("truncate", [[], ["--truncate-last-trajectory", ""]])
def test_a_trained_agent_goes_on_with_its_replay_buffer(
    truncate: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    zoo_exits(0, *TRAIN, "-i", f"{RUN}/{NAME}.zip", "--save-replay-buffer", *truncate)
    assert "Loading replay buffer" in capsys.readouterr().out
    first, second = (
        pickle.loads(Path(run, "replay_buffer.pkl").read_bytes())
        for run in (RUN, RUN.replace("_1", "_2"))
    )
    assert second.pos == 2 * first.pos
    np.testing.assert_array_equal(first.actions[: first.pos], second.actions[: first.pos])


@pytest.mark.parametrize(
    "options",
    [
        ["--load-best", "--stochastic", "--num-threads", "1", "-P"],
        ["--load-checkpoint", "100", "--deterministic", "--norm-reward", "--custom-objects"],
        ["--load-last-checkpoint", "--env-kwargs", "reward_type:'dense'", "--exp-id", "1"],
        ["--reward-log", "rewards", "--n-envs", "2", "--device", "cpu", "--seed", "3"],
    ],
    ids=["best", "checkpoint", "last checkpoint", "two copies"],
)
def test_each_saved_model_plays(
    options: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    zoo_exits(0, "enjoy", "--env", TASK, "-f", "logs", "-n", str(HORIZON), "--no-render", *options)
    said = capsys.readouterr().out
    if "--reward-log" in options:
        assert len(list(Path("rewards").glob("*.monitor.csv"))) == 2
    else:
        mean = float(re.search(r"Mean reward: (\S+)", said).group(1))  # type: ignore[union-attr]
        assert (-HORIZON < mean < 0.0) if "reward_type:'dense'" in options else mean == -HORIZON


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("which", [[], ["--load-best"], ["--load-checkpoint", "100"]])
def test_videos_are_recorded(which: list[str], folder: Path) -> None:
    zoo_exits(0, "record_video", "--env", TASK, "-f", "logs", "-n", "3", "-o", "films", *which)
    (film,) = Path("films").glob("*.mp4")
    assert film.stat().st_size > 1000


def serve(run: Path, hub: Path) -> None:
    """Lay a run out as a repository of the hub."""
    hub.mkdir()
    shutil.copy(run / f"{NAME}.zip", hub / f"her_ddpg-{NAME}.zip")
    for name in ("args.yml", "config.yml"):
        shutil.copy(run / NAME / name, hub)
    (hub / "env_kwargs.yml").write_text("{}")
    with zipfile.ZipFile(hub / "train_eval_metrics.zip", "w") as metrics:
        metrics.write(run / "0.monitor.csv", "0.monitor.csv")


def test_a_model_without_normalisation_comes_from_the_hub(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    errors = import_module("huggingface_hub.errors")
    httpx = import_module(errors.HTTPError.__module__.split(".")[0])
    hub = folder / "hub"
    serve(folder / RUN, hub)

    def download(repo_id: str, filename: str, **_: object) -> str:
        if not (hub / filename).exists():
            request = httpx.Request("GET", "https://localhost")
            raise errors.RemoteEntryNotFoundError(
                filename, response=httpx.Response(404, request=request)
            )
        return str(hub / filename)

    monkeypatch.setenv("TRUST_REMOTE_CODE", "1")
    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    sb3 = import_module("huggingface_sb3")
    monkeypatch.setattr(sb3, "load_from_hub", sb3.load_from_hub)  # to be as it was afterwards
    command = ["load_from_hub", "--env", TASK, "-orga", "someone", "-f", "loaded"]
    zoo_exits(0, *command)
    zoo_exits(0, "enjoy", "--env", TASK, "-f", "loaded", "-n", str(HORIZON), "--no-render")
    assert "1 Episodes" in capsys.readouterr().out
    zoo_exits(2, *command, "--exp-id", "1")
    assert "already exists, use --force" in capsys.readouterr().err
    zoo_exits(0, *command, "--exp-id", "1", "--force")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["-optimize", "-i", f"{RUN}/{NAME}.zip"], "leave -i (--trained-agent) out"),
        (["--truncate-last-trajectory", "False"], "give '' for false"),
        (["--log-interval", "0"], "--log-interval is 0"),
        (["--trial-id", "1"], "needs the --storage and the --study-name"),
        (["--storage", "s.log", "--study-name", "x", "--trial-id", "0"], "0 for none"),
        (
            ["--storage", "s.log", "--study-name", "x", "--trial-id", "1"],
            "no settings of a trial 1",
        ),
        (["-i", "nothing.zip"], "must be a valid path to a .zip file"),
        (["--conf-file", "nothing.yml"], "nothing.yml"),
        (["--gym-packages", "nothing_here"], "nothing_here"),
        (["-params", "policy:MlpPolicy"], "the value is Python"),
        (["-params", "n_envs:0"], "n_envs is 0; give a whole number of 1 or more"),
        (["-params", "nois_std:0.1"], "did you mean 'noise_std'"),
        (["-params", "normalize:True"], "VecNormalize"),
        (["-params", "frame_stack:2"], "frame_stack"),
        (["--env-kwargs", "nonsense:1"], "nonsense"),
        (["--seed", "5000000000"], "between 0 and 2**32 - 1"),
        (
            ["--env-kwargs", "reward_type:'dense'", "-params", "hindsight_bound:True"],
            "hindsight_bound is for rewards of -1 and 0",
        ),
    ],
)
def test_what_cannot_be_meant_is_one_line(
    arguments: list[str],
    sentence: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    zoo_exits(2, *TRAIN, *arguments)
    assert sentence in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("a: [1, 2", "is not YAML"),
        ("[1, 2]", "is not a mapping from environment ids to settings"),
        ("default: 3", "the settings of 'default' are not a mapping"),
    ],
)
def test_a_file_that_cannot_be_meant_is_one_line(
    content: str, sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.yml").write_text(content)  # the fixture's folder is the current one
    zoo_exits(2, *TRAIN, "--conf-file", "own.yml")
    assert sentence in capsys.readouterr().err.splitlines()[-1]


def test_a_fault_of_the_training_keeps_its_traceback(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_memory(self: Any, *args: Any, **kwargs: Any) -> None:
        raise RuntimeError("CUDA out of memory")

    monkeypatch.setattr(zoo.ZooHerDDPG, "train", out_of_memory)
    with pytest.raises(RuntimeError, match="out of memory"):
        zoo_exits(2, *TRAIN)


def test_trials_that_are_never_evaluated_are_pruned_with_the_reason(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(folder / "cache"))
    cache_predictor(folder / "cache")
    monkeypatch.setattr(zoo, "_NET_ARCHS", {"small": [8]})
    options = ["-n", "400", "-optimize", "--n-trials", "1", "--n-evaluations", "1", "-params"]
    curriculum = "callback:[{'sb3_follow_object.CurriculumCallback':{'n_episodes':2,'every':1}}]"
    zoo_exits(2, "train", "--env", TASK, *options, "n_envs:2", "learning_starts:0", curriculum)
    said = capsys.readouterr()
    assert "give --n-evaluations 4 or more" in said.out
    assert "No trials are completed yet" in said.err


def test_record_training_is_told_what_to_take_instead(capsys: pytest.CaptureFixture[str]) -> None:
    zoo_exits(2, "record_training")
    assert "record_video with --load-checkpoint" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_help_is_usage(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    zoo_exits(0, word)
    said = capsys.readouterr()
    assert said.out.startswith("usage: python -m sb3_follow_object.zoo COMMAND")
    assert all(command in said.out for command in zoo.COMMANDS) and not said.err


def test_names_that_are_no_settings_are_not_among_the_known() -> None:
    with pytest.raises(
        ValueError, match="HerDDPG has no setting 'foo'; known are policy, "
    ) as error:
        zoo.ZooHerDDPG("MultiInputPolicy", gym.make(TASK), foo=1)
    known = str(error.value).split("known are ")[1].split(", ")
    assert "noise_std" in known and not {"self", "env", "_init_setup_model"} & {*known}
