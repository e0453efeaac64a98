"""A folder for the hub: read by the hub's own library, loaded without pickle."""

from __future__ import annotations

import dataclasses
import errno
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from huggingface_hub import ModelCard

from sb3_follow_object import HerDDPG, load_actor, make_vec, save_actor
from sb3_follow_object.command.cli import main
from sb3_follow_object.runs import hub_folder
from sb3_follow_object.runs.hub_folder import load_hub_folder, write_hub_folder
from sb3_follow_object.runs.run_folder import claim
from sb3_follow_object.settings.presets import run_config
from sb3_follow_object.settings.run_config import RunConfig

TASK = "FollowObject/PushSideGap-v0"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder that holds what an interrupted run leaves: a policy, no result."""
    folder = tmp_path_factory.mktemp("runs") / "side-gap"
    claim(folder, run_config(TASK, overrides={"n_final_episodes": 4}))
    tiny = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 1000}
    model = HerDDPG("MultiInputPolicy", make_vec(TASK, 1, 1), **tiny)
    save_actor(folder / "policy.safetensors", model.policy.actor_average, TASK)
    return folder


@pytest.fixture(scope="module")
def hub(made: Path) -> Path:
    folder = made.parent / "hub"
    write_hub_folder(made, folder)
    return folder


def test_loaded_policy_acts_as_the_runs(made: Path, hub: Path) -> None:
    actor, config = load_hub_folder(hub)
    env = make_vec(TASK, 3, 1, seed=0)
    obs = env.reset()
    own, _ = load_actor(made / "policy.safetensors", env.observation_space, env.action_space)
    np.testing.assert_array_equal(actor.predict(obs)[0], own.predict(obs)[0])
    assert config == run_config(TASK, overrides={"n_final_episodes": 4})


def test_nothing_in_the_folder_is_a_pickle(hub: Path) -> None:
    assert {path.suffix for path in hub.iterdir()} == {".safetensors", ".json", ".md"}


def test_card_tells_the_hub_what_it_shows(hub: Path) -> None:
    card = ModelCard.load(hub / "README.md")
    results = json.loads((hub / "results.json").read_text())
    assert card.data.library_name == "stable-baselines3"
    assert {TASK, "reinforcement-learning", "stable-baselines3"} <= set(card.data.tags)
    found = {result.metric_type: result for result in card.data.eval_results}
    assert found["success_rate"].metric_value == results["success_rate"]
    assert found["mean_reward"].dataset_name == TASK
    assert found["mean_reward"].metric_value.startswith(f"{results['mean_reward']:.2f} +/- ")
    assert results["n_eval_episodes"] == 4
    assert "an unfinished training's env steps" in card.text


def test_card_tells_what_trained_a_run_that_is_not_finished(copied: Path, tmp_path: Path) -> None:
    """A command where one is noted; else one with what the command line needs no --set for."""
    few = {"n_timesteps": 900, "n_final_episodes": 4}
    config = run_config(TASK, method="her", seed=7, overrides=few)
    (copied / "config.json").write_text(json.dumps(dataclasses.asdict(config)))
    noted = "sb3-follow-object train --method her --set gamma=0.9"
    cards = []
    for command in (None, noted):
        if command:
            (copied / "command.txt").write_text(f"{command}\n")
        write_hub_folder(copied, tmp_path / str(command))
        cards.append((tmp_path / str(command) / "README.md").read_text())
    assert f"train --env {TASK} --method her --seed 7 --steps 900\n" in cards[0]
    assert f"\n{noted}\n" in cards[1]


@pytest.mark.parametrize(("settings", "told"), [({}, True), ({"imagine": False}, False)])
def test_card_says_whether_goals_were_imagined(settings: dict[str, Any], told: bool) -> None:
    results = {"mean_reward": -1.0, "std_reward": 0.0, "success_rate": 0.5, "n_eval_episodes": 4}
    card = hub_folder._card(None, "", RunConfig(TASK, "fo", settings=settings), results)
    assert ("it is shown goals on the way" in card) == told


def test_nothing_is_overwritten(made: Path, hub: Path) -> None:
    with pytest.raises(ValueError, match="is not empty; give another folder"):
        write_hub_folder(made, hub)


def test_downloaded_configuration_imports_no_module(hub: Path, tmp_path: Path) -> None:
    for file in hub.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    config = dataclasses.replace(load_hub_folder(hub)[1], module="antigravity", env_id="Other-v0")
    (tmp_path / "config.json").write_text(json.dumps(dataclasses.asdict(config)))
    with pytest.raises(ValueError, match="registered by importing antigravity: import it first"):
        load_hub_folder(tmp_path)


@pytest.mark.parametrize("name", [TASK, "Other-v0"])
def test_a_module_before_the_downloaded_id_is_not_imported(
    name: str, hub: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hub").mkdir()
    for file in hub.iterdir():
        (tmp_path / "hub" / file.name).write_bytes(file.read_bytes())
    config = json.loads((hub / "config.json").read_text())
    config |= {"env_id": f"a_strangers:{name}", "module": None}
    (tmp_path / "hub" / "config.json").write_text(json.dumps(config))
    (tmp_path / "a_strangers.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    if name == TASK:
        loaded = load_hub_folder(tmp_path / "hub")[1]
        assert (loaded.env_id, loaded.module) == (TASK, "a_strangers"), "gym.make takes the id"
    else:
        with pytest.raises(ValueError, match="'Other-v0' is registered by importing a_strangers:"):
            load_hub_folder(tmp_path / "hub")
    assert "a_strangers" not in sys.modules


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "run"))


def test_card_does_not_tell_where_files_lie_on_this_machine(copied: Path, tmp_path: Path) -> None:
    command = "sb3-follow-object train --run /home/me/runs/gap --config=/home/me/own.yml --set "
    command += "'a=[1, 2]' && sb3-follow-object train --resume --run /home/me/runs/gap --steps 9"
    result = {"env_steps": 1500, "wall_s": 1.0, "success_rate": 0.0, "command": command}
    (copied / "result.json").write_text(json.dumps(result))
    write_hub_folder(copied, tmp_path / "hub")
    card = (tmp_path / "hub" / "README.md").read_text()
    told = "sb3-follow-object train --run gap --config=own.yml --set 'a=[1, 2]' && "
    assert told + "sb3-follow-object train --resume --run gap --steps 9\n" in card
    assert "after\n1,500 env steps" in card
    assert not [path for path in (tmp_path / "hub").iterdir() if b"/home/" in path.read_bytes()]


def test_the_policy_that_was_tested_is_the_one_in_the_folder(
    copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (copied / "policy.safetensors").read_bytes()
    evaluate, tested = hub_folder.evaluate, []

    def while_it_trains(policy: Path, *arguments: Any) -> Any:
        (copied / "policy.safetensors").write_bytes(b"of the next validation")
        tested.append(policy.read_bytes())
        return evaluate(policy, *arguments)

    monkeypatch.setattr(hub_folder, "evaluate", while_it_trains)
    write_hub_folder(copied, tmp_path / "hub")
    assert tested == [before] == [(tmp_path / "hub" / "policy.safetensors").read_bytes()]


@pytest.mark.parametrize("exists", [False, True])
def test_a_full_disk_leaves_no_part_that_bars_the_next_try(
    exists: bool, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = hub_folder.atomic_write

    def full(path: Path, content: bytes) -> None:
        if path.name == "results.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, content)

    hub = tmp_path / "new" / "hub"
    if exists:
        hub.mkdir(parents=True)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(hub_folder, "atomic_write", full)
        write_hub_folder(made, hub)
    assert list(tmp_path.rglob("*")) == ([tmp_path / "new", hub] if exists else [])
    write_hub_folder(made, hub)
    assert sorted(path.name for path in hub.parent.rglob("*")) == sorted(
        ["hub", "README.md", "config.json", "policy.safetensors", "results.json", "versions.json"]
    )


@pytest.mark.parametrize("content", ["[]", '{"env_steps": "many"}', "{"])
def test_damaged_files_of_the_run_are_named(content: str, copied: Path, tmp_path: Path) -> None:
    (copied / "result.json").write_text(content)
    with pytest.raises(ValueError, match=r"run/result.json is not the result of a run"):
        write_hub_folder(copied, tmp_path / "hub")
    (copied / "result.json").unlink()
    (copied / "policy.safetensors").write_bytes(b"")
    with pytest.raises(ValueError, match=r"run/policy.safetensors is not a whole checkpoint"):
        write_hub_folder(copied, tmp_path / "hub")
    (copied / "policy.safetensors").unlink()
    with pytest.raises(ValueError, match=r"there is no file .*run/policy.safetensors"):
        write_hub_folder(copied, tmp_path / "hub")
    assert not (tmp_path / "hub").exists()


def test_other_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no policy of this package"):
        load_hub_folder(tmp_path)


def test_command_writes_both(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    onnx, hub = tmp_path / "policy.onnx", tmp_path / "hub"
    assert main(["export", str(made), "--onnx", str(onnx), "--hub", str(hub)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert (printed[0], printed[-1]) == (str(onnx), str(hub))
    assert onnx.stat().st_size > 0 and (hub / "README.md").exists()


@pytest.mark.parametrize(
    "words, sentence",
    [
        ([], "say what to write: --onnx FILE.onnx, --hub FOLDER or both"),
        (["--onnx", "policy.pt"], "policy.pt does not end in .onnx"),
    ],
)
def test_command_refuses_in_a_sentence(
    made: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture
) -> None:
    assert main(["export", str(made), *words]) == 2
    assert sentence in capsys.readouterr().err
