"""Settings: what the shipped files say, what rl_zoo3 reads in them, and what is refused."""

from __future__ import annotations

import inspect
import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_follow_object.ddpg.her_ddpg import HerDDPG
from sb3_follow_object.envs import IDS
from sb3_follow_object.runs.run_folder import difference
from sb3_follow_object.settings.methods import METHODS, STOCK, WITHOUT_PAPER
from sb3_follow_object.settings.presets import (
    PRESETS,
    load_config,
    parse_override,
    preset_file,
    read_config,
    run_config,
)
from sb3_follow_object.settings.run_config import RunConfig
from sb3_follow_object.settings.sizes import check_stages
from sb3_follow_object.settings.zoo_yaml import (
    CALLBACK,
    OF_RUNS,
    REACH_CALLBACK,
    REACH_WRAPPER,
    WRAPPER,
)

TASK = "FollowObject/PushSideGap-v0"
ROBOTS = [env_id for env_id, (_, alone) in IDS.items() if not alone]
PAIRS = [(m, p) for m in METHODS for p in PRESETS if p != "paper" or m not in WITHOUT_PAPER]
FILES = [preset_file(*pair) for pair in PAIRS]


@pytest.mark.parametrize("algorithm", STOCK)
def test_stock_algorithms_have_files_too(algorithm: str) -> None:
    assert preset_file(algorithm).is_file()
    with pytest.raises(ValueError, match=r"there is no method .*rl_zoo3 trains stock algorithms"):
        run_config(TASK, method=algorithm)


@pytest.mark.parametrize("algorithm", STOCK)
def test_a_file_for_stock_algorithms_says_what_trains_it(algorithm: str) -> None:
    file = preset_file(algorithm)
    with pytest.raises(ValueError) as refusal:
        run_config(TASK, file=file)
    sentence = "as a file for one of rl_zoo3's stock algorithms: train it by `python -m rl_zoo3"
    assert str(refusal.value).startswith(f"{file} has 'normalize', {sentence}.train`")


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (("herr",), "there is no method 'herr'; did you mean 'her'"),
        (("her", "papers"), "there is no preset 'papers'; did you mean 'paper'"),
        (("ddpg", "paper"), "there is no method 'ddpg'"),
        (("rher", "paper"), "'rher' has no preset 'paper'"),
    ],
)
def test_a_file_that_does_not_come_with_the_package(names: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        preset_file(*names)


def write(path: Path, entry: dict[str, Any], env_id: str = TASK) -> Path:
    path.write_text(yaml.safe_dump({env_id: entry}))
    return path


def imagining(**curriculum: Any) -> dict[str, Any]:
    return {"env_wrapper": [{WRAPPER: {"predictor": "auto", "curriculum": curriculum}}]}


@pytest.mark.parametrize(("method", "preset"), PAIRS)
@pytest.mark.parametrize("env_id", ROBOTS)
def test_every_task_has_settings_in_every_preset(env_id: str, method: str, preset: str) -> None:
    config = run_config(env_id, method=method, preset=preset, seed=3)
    assert (config.env_id, config.method, config.seed) == (env_id, method, 3)
    assert config.settings["imagine"] == ("fo" in method.split("-"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_rl_zoo3_can_build_the_algorithm_from_every_entry(file: Path) -> None:
    """Besides its own keys it hands an entry to the algorithm as keyword arguments."""
    known = {*inspect.signature(HerDDPG.__init__).parameters}
    entries = yaml.safe_load(file.read_text())
    entries.pop(OF_RUNS, None)  # which it does not look at
    for env_id, entry in entries.items():
        assert env_id == "default" or env_id in IDS or env_id.startswith("Fetch")
        own = {"n_timesteps", "n_envs", "env_wrapper", "callback", "env_kwargs"}
        assert {"n_timesteps", "policy"} <= set(entry)
        assert set(entry) - own <= known


def test_paper_preset_is_the_authors_setting() -> None:
    config = run_config(TASK, preset="paper")
    algorithm = config.settings["algorithm"]
    assert config.settings["n_envs"] == config.settings["n_test_episodes"] == 38
    assert algorithm["batch_size"] == 38 * 128
    assert (algorithm["gradient_steps"], algorithm["target_update_interval"]) == (40, 40)
    assert algorithm["tau"] == 0.05
    assert algorithm["replay_buffer_kwargs"]["moved_ratio"] == 0.0
    assert not algorithm["policy_kwargs"]["critic_layer_norm"]
    curriculum = config.settings["curriculum"]
    assert (curriculum["levels"], curriculum["k_max"], curriculum["p"]) == ("time", 2, 0.2)
    assert not config.settings["store_tests"]
    assert config.settings["object_timesteps"] == 25 * 95_000
    assert config.settings["object_n_envs"] == 38
    assert config.settings["object_on_table"] is False
    double = run_config("FollowObject/PushDoubleObstacles-v0", preset="paper")
    assert double.settings["object_timesteps"] == 50 * 152_000


def test_her_differs_from_fo_by_its_imagined_goals_alone() -> None:
    for preset in PRESETS:
        fo = run_config(TASK, method="fo", preset=preset).settings
        her = run_config(TASK, method="her", preset=preset).settings
        # With reaching first, which imagined goals come with, fewer random steps are needed.
        random_steps = {each["algorithm"].pop("learning_starts", 0) for each in (fo, her)}
        assert random_steps == ({4_000, 40_000} if "reach" in fo else {0})
        assert fo["algorithm"] == her["algorithm"]
        assert fo["n_envs"] == her["n_envs"]


OBJECT_STAGE = (
    *("object_timesteps", "object_n_envs", "object_on_table", "object_algorithm"),
    *("object_test_every", "object_test_episodes", "object_success", "object_error", "n_paths"),
)
# What each method's file says besides her.yml's settings (fo.yml's, where goals are imagined).
OWN = {
    "shaped": {"hindsight_bound", "target_clip", "reward_type", "replay_buffer_kwargs.goal_margin"},
    "rnd": {"auxiliary"},
    "sldr": {"auxiliary", *OBJECT_STAGE},
    "fo-sldr": {"auxiliary"},
    "cher": {"replay_buffer_kwargs.cher"},
    "rher": {"reach", "learning_starts"},
}


def leaves(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by their dotted names; the algorithm's own by their names alone."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        inside = "" if name == "algorithm" else f"{prefix}{name}."
        found |= leaves(value, inside) if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


@pytest.mark.parametrize(("method", "preset"), [pair for pair in PAIRS if pair[0] in OWN])
@pytest.mark.parametrize("env_id", ROBOTS)
def test_methods_differ_by_what_makes_them_alone(env_id: str, method: str, preset: str) -> None:
    base = "fo" if "fo" in method.split("-") else "her"
    ours = run_config(env_id, method=method, preset=preset)
    theirs = run_config(env_id, method=base, preset=preset)
    if (method, preset) == ("cher", "paper"):  # its source's batch
        assert ours.settings["algorithm"].pop("batch_size") == 64
        assert theirs.settings["algorithm"].pop("batch_size") == 4864
    if (method, preset) == ("sldr", "paper"):  # the object's steps are counted
        own_steps = ours.settings["object_timesteps"]
        assert ours.total_timesteps == theirs.total_timesteps + own_steps
    else:
        assert ours.total_timesteps == theirs.total_timesteps
    if "sldr" in method:
        fo = run_config(env_id, method="fo", preset=preset).settings
        assert all(ours.settings.get(name) == fo.get(name) for name in OBJECT_STAGE)
    reaches = method == "rher" or (base == "fo" and preset == "default")
    assert ("reach" in ours.settings) == reaches
    mine, others = leaves(ours.settings), leaves(theirs.settings)
    differing = {n for n in {**mine, **others} if mine.get(n) != others.get(n)}
    own = OWN[method]
    assert all(any(f"{name}.".startswith(f"{o}.") for o in own) for name in differing)
    assert differing, "the file is the base method's"


def test_distances_fit_between_the_bounds_of_shaped_targets() -> None:
    for env_id in ROBOTS:
        for preset in PRESETS:
            config = run_config(env_id, method="shaped", preset=preset)
            low, high = config.settings["algorithm"]["target_clip"]
            assert (low, high) == (-2.0 * IDS[env_id][0].horizon, 0.0)


@pytest.mark.parametrize(
    ("overrides", "method"),
    [
        ({}, "her"),
        ({"reward_type": "dense"}, "shaped"),
        ({"auxiliary.name": "rnd", "auxiliary.weight": 0.5}, "rnd"),
        ({"replay_buffer_kwargs.cher": {}}, "cher"),
        ({"auxiliary.name": "sldr"}, "sldr"),
        ({"replay_buffer_kwargs.cher.picks": 9, "auxiliary.name": "rnd"}, "rnd-cher"),
        ({"reach": {}}, "rher"),
        ({"reach.share": 0.3}, "rher"),
        ({"reach.share": 0.3, "auxiliary.name": "rnd"}, "rnd"),
    ],
)
def test_method_is_what_the_settings_make_it(
    tmp_path: Path, overrides: dict[str, Any], method: str
) -> None:
    file = write(tmp_path / "my.yml", {"n_envs": 2})
    assert run_config(TASK, file=file, overrides=overrides).method == method
    if overrides:
        with pytest.raises(ValueError, match=f"with method '{method}' after --set, not 'her'"):
            run_config(TASK, method="her", overrides=overrides)


def test_wrapper_and_callback_become_settings(tmp_path: Path) -> None:
    entry = imagining(p=0.5, levels="path")
    entry |= {"callback": [{CALLBACK: {"every": 3, "n_episodes": 8, "store": False}}]}
    entry |= {"n_timesteps": "1e5", "batch_size": 64, "train_freq": [2, "episode"]}
    entry |= {"env_kwargs": {"reward_type": "dense"}, "n_envs": 4}
    config = run_config(TASK, file=write(tmp_path / "my.yml", entry))
    assert config.method == "fo-shaped"
    assert config.total_timesteps == 100_000
    assert config.settings == {
        "imagine": True,
        "curriculum": {"p": 0.5, "levels": "path"},
        "test_every": 3,
        "n_test_episodes": 8,
        "store_tests": False,
        "reward_type": "dense",
        "n_envs": 4,
        "algorithm": {"batch_size": 64, "train_freq": (2, "episode")},
    }


def reaching(first: Any, teaching: Any) -> dict[str, Any]:
    return {"env_wrapper": [{REACH_WRAPPER: first}], "callback": [{REACH_CALLBACK: teaching}]}


def test_reaching_first_becomes_one_setting_of_its_wrapper_and_its_callback(tmp_path: Path) -> None:
    entry = reaching({"standoff": 0.05, "effector": [3, 4, 5]}, {"share": "3e-1", "fade": False})
    file = write(tmp_path / "my.yml", entry)
    expected = {"standoff": 0.05, "effector": (3, 4, 5), "share": 0.3, "fade": False}
    assert run_config(TASK, file=file).settings == {"imagine": False, "reach": expected}
    both = imagining(p=0.5)
    both["env_wrapper"].append(REACH_WRAPPER)
    both["callback"] = [REACH_CALLBACK, {CALLBACK: {"every": 3}}]
    config = run_config(TASK, file=write(tmp_path / "both.yml", both))
    assert config.method == "fo", "what begins its episodes makes it no other method"
    assert config.settings["reach"] == {} and config.settings["test_every"] == 3


@pytest.mark.parametrize("method", ["fo", "shaped", "rnd", "sldr", "cher", "fo-sldr"])
def test_reaching_first_is_switched_on_and_off_for_any_method(method: str) -> None:
    plain = run_config(TASK, method=method, overrides={"reach": None})
    assert plain.settings.get("reach") is None
    for value, expected in (({}, {}), ({"share": 0.3}, {"share": 0.3})):
        config = run_config(TASK, method=method, overrides={"reach": value})
        assert (config.method, config.settings["reach"]) == (method, expected)
    one = run_config(TASK, method=method, overrides={"reach.share": 0.3})
    assert one.settings["reach"] == {"share": 0.3}


def test_relay_her_without_reaching_is_her() -> None:
    with pytest.raises(ValueError, match="with method 'her' after --set, not 'rher'"):
        run_config(TASK, method="rher", overrides={"reach": None})


def test_method_without_a_paper_preset_says_so() -> None:
    with pytest.raises(ValueError, match=r"^'rher' has no preset 'paper', for the paper has no"):
        run_config(TASK, method="rher", preset="paper")


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"env_wrapper": [REACH_WRAPPER]}, "does nothing without the callback sb3_"),
        ({"callback": [REACH_CALLBACK]}, "does nothing without the env_wrapper "),
        (reaching({"share": 0.3}, {}), "has no setting 'share'; give it to ReachCallback"),
        (reaching({}, {"noise": 0.3}), "has no setting 'noise'; give it to ReachFirst"),
        (reaching({"hight": 0.3}, {}), "ReachFirstWrapper has no setting 'hight'; did you mean"),
        (reaching({}, {"share": 3}), "ReachCallback: share is 3; it must lie in [0, 1]"),
        (reaching([1], {}), "the arguments of sb3_follow_object.ReachFirstWrapper are not a mapp"),
    ],
)
def test_reaching_first_that_cannot_be_meant_is_refused(
    tmp_path: Path, entry: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError) as refusal:
        run_config(TASK, file=write(tmp_path / "my.yml", entry))
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_file_without_imagined_goals_is_her(tmp_path: Path) -> None:
    file = write(tmp_path / "my.yml", {"n_envs": 2})
    assert run_config(TASK, file=file).method == "her"
    with pytest.raises(ValueError, match=r"trains .* with method 'her', not 'fo'"):
        run_config(TASK, file=file, method="fo")


def test_overrides_win_and_leave_the_shared_anchors_alone() -> None:
    changed = run_config(TASK, overrides={"curriculum.p": 0.7, "batch_size": 8})
    plain = run_config(TASK)
    assert changed.settings["curriculum"] == plain.settings["curriculum"] | {"p": 0.7}
    assert "p" not in plain.settings["curriculum"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("learning_rate=1e-3", ("learning_rate", 0.001)),
        ("n_timesteps=1e6", ("n_timesteps", 1_000_000)),
        ("policy_kwargs.net_arch=[8, 8]", ("policy_kwargs.net_arch", [8, 8])),
        ("store_tests=false", ("store_tests", False)),
        ("gamma=null", ("gamma", None)),
        ("curriculum.levels=path", ("curriculum.levels", "path")),
    ],
)
def test_override_is_read_as_yaml(text: str, expected: tuple[str, Any]) -> None:
    assert parse_override(text) == expected


@pytest.mark.parametrize(
    ("env_id", "overrides", "sentence"),
    [
        ("FollowObject/PnPShelv-v0", {}, "did you mean 'FollowObject/PnPShelf-v0'"),
        ("CartPole-v1", {}, "'CartPole-v1' has no goals: its observations lack achieved_goal"),
        ("no_module:Task-v0", {}, "names a module that cannot be imported"),
        ("FetchReach-v4", {}, "'FetchReach-v4': the achieved goal is a point of the robot itself"),
        (TASK, {"batchsize": 1}, "--set has no setting 'batchsize'; did you mean 'batch_size'"),
        (TASK, {"curriculum.kmax": 1}, "--set: curriculum has no setting 'kmax'"),
        (TASK, {"policy_kwargs.layernorm": 1}, "policy_kwargs has no setting 'layernorm'"),
        (TASK, {"object_algorithm.tao": 1}, "object_algorithm has no setting 'tao'"),
        (TASK, {"batch_size": "many"}, "batch_size must be a whole number, not 'many'"),
        (TASK, {"batch_size": 0}, "batch_size is 0; it must be at least 1"),
        (TASK, {"curriculum": 3}, "curriculum must be a mapping, not 3"),
        (TASK, {"store_tests": 1}, "store_tests must be true or false, not 1"),
        (TASK, {"auxiliary.nome": "rnd"}, "auxiliary has no setting 'nome'"),
        (TASK, {"auxiliary": "rnd"}, "auxiliary must be a mapping, not 'rnd'"),
        (TASK, {"replay_buffer_kwargs.cher.pick": 1}, "cher has no setting 'pick'"),
        (TASK, {"eval_every": 0}, "eval_every is 0; it must be at least 1"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    env_id: str, overrides: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError) as refusal:
        run_config(env_id, overrides=overrides)
    assert sentence in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[1, 2]", "is not a mapping from environment ids"),
        ("{a: [", "is not YAML"),
        (f"{TASK}: 3", "are not a mapping"),
        (f"{TASK}: {{batchsize: 3}}", "my.yml has no setting 'batchsize'; did you mean"),
        (f"{TASK}: {{env_wrapper: other.Wrapper}}", "not 'other.Wrapper'"),
        (f"{TASK}: {{callback: [3]}}", "callback must list class names"),
        (
            f"{TASK}: {{env_wrapper: [{{{WRAPPER}: {{curiculum: 1}}}}]}}",
            "did you mean 'curriculum'",
        ),
        (f"{TASK}: {{env_wrapper: [{{{WRAPPER}: {{predictor: x}}}}]}}", "makes its own predictor"),
        (f"{TASK}: {{env_kwargs: {{colour: 1}}}}", "env_kwargs has no setting 'colour'"),
        (f"!!python/object/apply:os.system ['x']\n{TASK}: 3", "is not YAML"),
    ],
)
def test_file_that_cannot_be_meant_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "my.yml"
    file.write_text(text)
    with pytest.raises(ValueError) as refusal:
        run_config(TASK, file=file)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        run_config(TASK, file=tmp_path / "none.yml")


def test_imagined_goals_need_an_object_of_its_own(tmp_path: Path) -> None:
    file = write(tmp_path / "my.yml", imagining(), "FetchReach-v4")
    with pytest.raises(ValueError, match="there is no object to follow"):
        run_config("FetchReach-v4", file=file)
    file = write(tmp_path / "my.yml", {"auxiliary": {"name": "sldr"}}, "FetchPush-v4")
    with pytest.raises(ValueError, match="is not a task of this package"):
        run_config("FetchPush-v4", file=file)


def test_run_folder_keeps_the_configuration(tmp_path: Path) -> None:
    config = run_config(TASK, overrides={"train_freq": [1, "episode"], "n_eval_episodes": 5})
    (tmp_path / "config.json").write_text(json.dumps(asdict(config)))
    assert load_config(tmp_path) == config


def test_a_configuration_is_read_where_its_task_is_not_installed(tmp_path: Path) -> None:
    config = RunConfig("no_module:Task-v0", "her")
    (tmp_path / "config.json").write_text(json.dumps(asdict(config)))
    assert read_config(tmp_path) == config
    with pytest.raises(ValueError, match="names a module that cannot be imported"):
        load_config(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", '{"env_id": "x"}', '{"env_id": "x", "settings": 1}'])
def test_damaged_configuration_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match="is not the configuration of a run"):
        load_config(tmp_path)


def test_an_object_whose_episodes_are_shorter_is_measured_by_its_own() -> None:
    of_object = {"buffer_size": 1600, "batch_size": 16, "learning_starts": 100}
    given: dict[str, Any] = {"algorithm": None, "object_algorithm": of_object}
    check_stages("Somebodys-v0", {**given, "object_n_envs": 16}, 500)
    with pytest.raises(ValueError, match=r"^object_algorithm: buffer_size .* than the 50 of an"):
        check_stages("Somebodys-v0", {**given, "object_n_envs": 40}, 500)
    with pytest.raises(ValueError, match=r"curriculum: k_max is 200; it must be at most 50"):
        check_stages("Somebodys-v0", {**given, "curriculum": {"k_max": 200}}, 500)


def test_each_ablation_of_the_docs_changes_one_setting() -> None:
    text = (Path(__file__).parents[2] / "docs" / "compare.md").read_text()
    section = text.split("## Ablations\n")[1].split("\n## ")[0]
    settings = re.findall(r"`--set (\S+)` \|$", section, flags=re.MULTILINE)
    assert len(settings) == 7
    default = asdict(run_config(TASK))
    for setting in settings:
        changed = asdict(run_config(TASK, overrides=dict([parse_override(setting)])))
        found = difference(default, changed)
        assert found is not None, setting
        assert found[0].endswith(setting.split("=")[0]), setting


def test_settings_of_all_tasks_that_rl_zoo3_does_not_know_have_an_entry_of_their_own(
    tmp_path: Path,
) -> None:
    entries = {TASK: imagining(), OF_RUNS: {"n_paths": "2e2", "object_test_every": 2}}
    file = tmp_path / "my.yml"
    file.write_text(yaml.safe_dump(entries))
    settings = run_config(TASK, file=file).settings
    assert (settings["n_paths"], settings["object_test_every"]) == (200, 2)
    assert run_config(TASK, file=file, overrides={"n_paths": 9}).settings["n_paths"] == 9
    for given, sentence in (
        ({"n_path": 200}, "my.yml: sb3-follow-object has no setting 'n_path'; did you mean"),
        ({"batch_size": 8}, "my.yml: sb3-follow-object has no setting 'batch_size'"),
        (3, "my.yml: the settings of 'sb3-follow-object' are not a mapping"),
    ):
        file.write_text(yaml.safe_dump({**entries, OF_RUNS: given}))
        with pytest.raises(ValueError, match=sentence):
            run_config(TASK, file=file)


def test_a_module_before_an_id_changes_no_setting() -> None:
    whole = run_config("gymnasium_robotics:FetchPush-v4")
    assert whole.settings == run_config("FetchPush-v4").settings
