"""A folder for the hub: read by the hub's own library, loaded without pickle."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import ModelCard

from sb3_follow_object import HerDDPG, load_actor, make_vec, save_actor
from sb3_follow_object.command.cli import main
from sb3_follow_object.runs.hub_folder import load_hub_folder, write_hub_folder
from sb3_follow_object.runs.run_folder import claim
from sb3_follow_object.settings.presets import run_config

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
