"""Every setting: its default, its sentence, NumPy's numbers for it, and what only fits together."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_buffers import make_buffer, make_env
from small_models import make_model
from stable_baselines3 import DDPG
from tiny_runs import TINY, bare_run
from toy import HORIZON

from sb3_follow_object.callbacks.curriculum_callback import CurriculumCallback
from sb3_follow_object.callbacks.rollout import run_episodes
from sb3_follow_object.common.seeds import stream_seed
from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.ddpg.policies import HerPolicy
from sb3_follow_object.ddpg.rnd import RndReward
from sb3_follow_object.envs import make_vec
from sb3_follow_object.envs.tasks import SUCCESS_DISTANCE
from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.imagination.curriculum import Curriculum
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.object_stage.networks import ObjectNetworks
from sb3_follow_object.object_stage.sldr import SldrReward
from sb3_follow_object.replay.cher import GoalSelection
from sb3_follow_object.replay.her_replay_buffer import FollowObjectReplayBuffer
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.settings import presets
from sb3_follow_object.settings.docs_tables import lines_with_preset, with_tables
from sb3_follow_object.settings.fields import Group, Setting, settings_of
from sb3_follow_object.settings.learning import (
    AlgorithmSettings,
    AuxiliarySettings,
    CherSettings,
    InverseSettings,
    PolicySettings,
    PredictorSettings,
    ReplaySettings,
    RndSettings,
    SldrSettings,
)
from sb3_follow_object.settings.presets import load_config, run_config
from sb3_follow_object.settings.run_config import RunConfig
from sb3_follow_object.settings.stages import (
    CurriculumSettings,
    CurriculumTestSettings,
    StageSettings,
)
from sb3_follow_object.settings.table import GROUPS, lines
from sb3_follow_object.settings.zoo_yaml import WRAPPER

ROOT = Path(__file__).parents[2]
TASK = "FollowObject/PushSideGap-v0"
TAKEN_BY: dict[type[Group], Callable[..., Any]] = {
    CherSettings: GoalSelection.__init__,
    ReplaySettings: FollowObjectReplayBuffer.__init__,
    RndSettings: RndReward.__init__,
    SldrSettings: SldrReward.__init__,
    AlgorithmSettings: HerDDPG.__init__,
    PolicySettings: HerPolicy.__init__,
    PredictorSettings: GoalPredictor.fit,
    InverseSettings: ObjectNetworks.learned,
    CurriculumSettings: Curriculum.__init__,
    CurriculumTestSettings: CurriculumCallback.__init__,
    RunConfig: RunConfig.__init__,
}
ALL = [*GROUPS, CurriculumTestSettings]
NUMBERS = ("a whole number", "a number", "true or false")
NUMERIC = [(g, s) for g in ALL for s in settings_of(g).values() if s.kind in NUMBERS]


def as_numpy(each: Setting) -> Any:
    """A value of NumPy's that a setting can have."""
    if each.kind == "true or false":
        return np.bool_(True)
    low = each.limits.get("ge", each.limits.get("gt", 0.0))
    if each.kind == "a whole number":
        return np.int64(max(int(low), 3))
    return np.float64(low + min(1.0, each.limits.get("le", each.limits.get("lt", 9.0)) - low) / 2)


def given(group: type[Group], name: str, value: Any) -> Group:
    own = {"env_id": TASK} if group is RunConfig else {}
    return group(**own, **{name: value})  # type: ignore[call-arg]


@pytest.mark.parametrize("group", TAKEN_BY)
def test_signatures_take_their_defaults_from_the_groups(group: type[Group]) -> None:
    parameters = inspect.signature(TAKEN_BY[group]).parameters
    for each in settings_of(group).values():
        default = parameters[each.field].default if each.field in parameters else each.default
        if default is not inspect.Parameter.empty:  # SB3's policy has none
            assert default == each.default, each.name
    missing = {f.name for f in fields(group)} - set(parameters)  # type: ignore[arg-type]
    if group is AlgorithmSettings or group is RunConfig or group is CurriculumSettings:
        assert not missing


@pytest.mark.parametrize("group", ALL)
def test_every_setting_says_in_a_sentence_what_it_is(group: type[Group]) -> None:
    for each in settings_of(group).values():
        assert each.sentence and not each.sentence.endswith(".")
        assert each.data is False or each.kind


@pytest.mark.parametrize(("group", "each"), NUMERIC, ids=lambda item: getattr(item, "name", None))
def test_numpys_numbers_become_pythons(group: type[Group], each: Setting) -> None:
    value = as_numpy(each)
    kept = getattr(given(group, each.field, value), each.field)
    assert type(kept) in (bool, int, float) and kept == value
    json.dumps(kept)
    with pytest.raises(ValueError, match=f"{each.field} must be {each.kind}"):
        given(group, each.field, np.bool_(True) if each.kind != "true or false" else np.int64(1))
    if each.kind == "a whole number":
        with pytest.raises(ValueError, match=r"must be a whole number, not 5\.0"):
            given(group, each.field, 5.0)
    if each.kind == "a number":
        for bad in (np.nan, np.float32(np.inf), -np.inf):
            with pytest.raises(ValueError, match=f"{each.field} is .*; it must lie in"):
                given(group, each.field, bad)


def numpy_settings(group: type[Group], without: tuple[str, ...] = ()) -> dict[str, Any]:
    """NumPy's numbers for all of a group's settings that have some."""
    return {
        name: numpy_settings(each.group.of({"name": "rnd"}), each.without) | {}
        if each.group is not None and settings_of(each.group)
        else as_numpy(each)
        for name, each in settings_of(group).items()
        if name not in without and (each.kind in NUMBERS or each.group is not None)
    }


def test_a_run_full_of_numpys_numbers_can_be_saved(tmp_path: Path) -> None:
    settings = numpy_settings(StageSettings)
    for algorithm in (settings["algorithm"], settings["object_algorithm"]):
        del algorithm["auxiliary"], algorithm["policy_kwargs"]["optimizer_kwargs"]
    run = {s.field: as_numpy(s) for s in settings_of(RunConfig).values()}
    config = RunConfig(TASK, "fo", np.int64(4), settings=settings, **run)
    (tmp_path / "config.json").write_text(json.dumps(asdict(config)))
    assert load_config(tmp_path) == config
    assert config.settings == json.loads(json.dumps(config.settings))
    small = {"batch_size": np.int64(16), "policy_kwargs": {"net_arch": [np.int64(8)]}}
    small["replay_buffer_kwargs"] = {"moved_ratio": np.float32(0.5), "seed": np.int64(1)}
    stages = bare_run(
        TASK,
        imagine=np.bool_(False),  # type: ignore[arg-type]
        n_envs=np.int64(2),  # type: ignore[arg-type]
        seed=np.arange(3)[2],
        algorithm={**small, "noise_std": np.float64(0.1), "train_freq": (np.int64(1), "episode")},
        curriculum={"p": np.float64(0.5), "k_max": np.int64(3)},
    )
    stages.learn(np.int64(200))  # type: ignore[arg-type]
    stages.save(tmp_path / "save")
    loaded = FollowObject.load(tmp_path / "save")
    assert json.dumps(loaded.settings) == json.dumps(stages.settings)
    stages.close()
    loaded.close()


def test_numpys_numbers_are_taken_where_there_are_no_settings() -> None:
    assert stream_seed(np.int64(3), "robot") == stream_seed(3, "robot")
    curriculum = Curriculum(np.int64(10), threshold=np.float32(0.5))  # type: ignore[arg-type]
    assert curriculum.report(np.float64(0.9)) and type(curriculum.k_max) is int
    json.dumps(curriculum.state_dict())
    env = make_vec(TASK, np.int64(2), np.int64(1))  # type: ignore[arg-type]
    episodes = run_episodes(lambda obs: np.zeros((2, 4)), env, np.int64(2))  # type: ignore
    assert len(episodes.success) == 2
    for call in (
        lambda: stream_seed(2.0, "robot"),  # type: ignore[arg-type]
        lambda: stream_seed(True, "robot"),
        lambda: make_vec(TASK, 2.0),  # type: ignore[arg-type]
        lambda: run_episodes(lambda obs: obs, env, 2.0),  # type: ignore
    ):
        with pytest.raises(ValueError, match="must be a whole number, not"):
            call()
    for rate in (True, "half"):
        with pytest.raises(ValueError, match="success_rate must be a number, not"):
            curriculum.report(rate)  # type: ignore[arg-type]
    env.close()


def test_python_objects_are_told_before_a_run_begins(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"which config\.json cannot hold"):
        RunConfig(TASK, settings={"algorithm": {"learning_rate": lambda left: 1e-3 * left}})


def test_the_tables_in_the_docs_are_the_settings() -> None:
    text = (ROOT / "docs" / "runs.md").read_text()
    assert with_tables(text) == text, (
        "python -m sb3_follow_object.settings.docs_tables docs/runs.md"
    )


def test_the_command_names_every_setting_with_range_and_default() -> None:
    assert lines("curriculum.p") == [
        "curriculum.p: number [0, 1], default 0.2; probability of the original goal"
    ]
    assert lines("object_algorithm.tau")[0].startswith("object_algorithm.tau: number (0, 1]")
    names = {line.split(":")[0] for line in lines()}
    assert {"n_timesteps", "batch_size", "auxiliary.max_bonus", "curriculum.k_max"} <= names


def test_the_command_says_what_the_default_preset_has_instead() -> None:
    said = {line.split(":")[0]: line for line in lines_with_preset()}
    assert said.keys() == {line.split(":")[0] for line in lines()}
    assert "default 0.25, fo's preset 0.15; success rate" in said["curriculum.threshold"]
    steps = run_config("FollowObject/PnPShelf-v0").total_timesteps
    assert f"fo's preset {steps} on PnPShelf, by task;" in said["n_timesteps"]
    of_one_task = "default 0.0, fo's preset 0.05 on PnPInsertion, by task;"
    assert of_one_task in said["replay_buffer_kwargs.scene_distance"]
    assert "fo's" not in said["curriculum.p"]
    (of_object,) = lines_with_preset("object_algorithm.gradient_steps")
    assert "default 40, fo's preset 120; updates" in of_object
    assert not any("fo's" in line for line in lines_with_preset("object_algorithm.tau"))


@pytest.mark.parametrize(
    "folder",
    sorted((ROOT / "benchmarks" / "results").rglob("config.json")),
    ids=lambda path: path.parent.name,
)
def test_configurations_of_earlier_runs_load_as_they_are(folder: Path) -> None:
    saved = json.loads(folder.read_text())
    loaded = json.loads(json.dumps(asdict(load_config(folder.parent))))
    assert {name: loaded[name] for name in saved} == saved


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"buffer_size": 60, "batch_size": 16}, "buffer_size leaves 30 steps for each of 2"),
        (
            {"buffer_size": 99, "batch_size": 16},
            "than the 50 of an episode; it must be at least 100",
        ),
        ({"batch_size": 2001}, "batch_size is 2001; it must be at most buffer_size, 2000"),
        (
            {"train_freq": 10, "learning_starts": 20},
            "learning_starts is 20; with train_freq 10 and 2 environments it must be at least 100",
        ),
    ],
)
def test_sizes_that_do_not_fit_together_are_told_before_anything_runs(
    settings: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    algorithm = {**TINY["algorithm"], **settings}
    config = RunConfig(TASK, total_timesteps=3600, settings={**TINY, "algorithm": algorithm})
    with pytest.raises(ValueError, match=sentence):
        train(config, tmp_path / "run", report=pytest.fail)  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (
            {"object_algorithm": {"buffer_size": 700}},
            "object_algorithm: buffer_size leaves 43 steps",
        ),
        ({"object_algorithm": {"batch_size": 900, "buffer_size": 800}}, "at most buffer_size, 800"),
        ({"object_timesteps": 500, "object_algorithm": {"learning_starts": 500}}, "nothing is le"),
        ({"curriculum": {"k_max": 26, "levels": "path"}}, "k_max is 26; it must be at most 25"),
        ({"curriculum": {"k_max": 51}}, "k_max is 51; it must be at most 50"),
        ({"object_algorithm": {"policy_kwargs": {"net_arch": []}}}, "without a hidden layer"),
    ],
)
def test_sizes_of_the_other_stages_have_to_fit_too(
    settings: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    config = RunConfig(TASK, settings=settings)
    with pytest.raises(ValueError, match=sentence):
        train(config, tmp_path / "run", report=pytest.fail)  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


def test_the_smallest_sizes_that_can_be_meant_are_taken() -> None:
    env = make_vec(TASK, 2, 1)
    tiny: dict[str, Any] = {"batch_size": 4, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    small = HerDDPG("MultiInputPolicy", env, buffer_size=99, **tiny)  # it can act, not learn
    with pytest.raises(ValueError, match=r"buffer_size leaves 49 .*; it must be at least 100"):
        small.learn(100)
    stock = DDPG(
        "MultiInputPolicy", env, buffer_size=60, replay_buffer_class=FollowObjectReplayBuffer
    )
    with pytest.raises(ValueError, match=r"buffer_size leaves 30 .*; it must be at least 100"):
        stock.learn(100)
    HerDDPG("MultiInputPolicy", env, buffer_size=100, gradient_steps=-1, **tiny).learn(100)
    env.close()
    # An environment that does not say how long its episodes are is believed.
    make_buffer(make_env(), size=HORIZON)
    make_model(buffer_size=8, learning_starts=10**9)
    starts = {"train_freq": 10, "learning_starts": 800}
    assert run_config(TASK, overrides=starts).settings["algorithm"]["learning_starts"] == 800


def test_a_run_too_short_for_its_robot_to_learn_says_so_once(tmp_path: Path) -> None:
    said: list[str] = []
    algorithm = {**TINY["algorithm"], "learning_starts": 200}
    settings = {**TINY, "imagine": False, "algorithm": algorithm}
    config = RunConfig(TASK, "her", total_timesteps=200, n_final_episodes=1, settings=settings)
    train(config, tmp_path / "run", report=said.append)
    sentence = "learning_starts is 200 and n_timesteps 200: the robot will act at random"
    assert sum(each.startswith(sentence) for each in said) == 1


def test_a_reward_has_its_own_settings_alone() -> None:
    assert AuxiliarySettings.of({"name": "rnd"}) is RndSettings
    with pytest.raises(ValueError, match=r"auxiliary \(sldr\) has no setting 'max_bonus'"):
        run_config(TASK, method="sldr", overrides={"auxiliary.max_bonus": 1.0})


@pytest.mark.parametrize(
    ("given", "outcome"),
    [
        (0.04, 0.02),
        (0, 0.0),
        (None, "my.yml: replay_buffer_kwargs: moved_distance must be a number, not None"),
        ("abc", "my.yml: replay_buffer_kwargs: moved_distance must be a number, not 'abc'"),
        (True, "my.yml: replay_buffer_kwargs: moved_distance must be a number, not True"),
        (-1, "my.yml: replay_buffer_kwargs: moved_distance is -1; it must lie in"),
    ],
)
def test_distances_are_fitted_to_a_task_of_others_where_they_are_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: Any, outcome: Any
) -> None:
    monkeypatch.setattr(presets, "derived", lambda env_id, report: None)
    monkeypatch.setattr(presets, "surface_choices", lambda env_id: (False,))
    monkeypatch.setattr(presets, "success_distance_of", lambda env_id: SUCCESS_DISTANCE / 2)
    entry = {"env_wrapper": WRAPPER, "replay_buffer_kwargs": {"moved_distance": given}}
    file = tmp_path / "my.yml"
    file.write_text(json.dumps({"default": entry}))
    try:
        config = presets.run_config("FetchPush-v4", file=file)
    except ValueError as error:
        assert str(outcome) in str(error)
    else:
        kept = config.settings["algorithm"]["replay_buffer_kwargs"]["moved_distance"]
        assert kept == outcome
