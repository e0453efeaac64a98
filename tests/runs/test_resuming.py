"""A run that was stopped anywhere and resumed ends as the run that never was."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_runs as runs
import torch as th
from tiny_runs import bare_run

from sb3_follow_object.common.array_trees import Snapshot, load_tree, save_tree
from sb3_follow_object.follow_object.follow_object import FollowObject
from sb3_follow_object.object_stage.networks import FILE as OBJECT_FILE
from sb3_follow_object.object_stage.networks import ObjectNetworks
from sb3_follow_object.runs.checkpoints import Checkpoints, checkpoint_files, load_newest
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.runs.run_callbacks import StopSignals
from sb3_follow_object.runs.run_folder import CROSS_TESTS

# What a run says as it comes to each stage, the final test last.
STAGES = ("checkpoint at 400 env", "stage 2", "checkpoint at 2600 env", "final test")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The outcome of a run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    runs.run(folder)
    return runs.outcome(folder)


class Crash(Exception):
    """Stands for whatever ends a process."""


def crash_at(sentence: str) -> Callable[[str], None]:
    """A report that ends the training once it is told a sentence with these words."""

    def report(told: str) -> None:
        if sentence in told:
            raise Crash(told)

    return report


def signal_at(*sentences: str) -> Callable[[str], None]:
    """A report that sends SIGTERM the first time that it is told each of these."""
    left = list(sentences)

    def report(told: str) -> None:
        if left and left[0] in told:
            del left[0]
            os.kill(os.getpid(), signal.SIGTERM)

    return report


def test_sigterm_in_any_stage_checkpoints_and_resumes(
    whole: dict[str, Any], tmp_path: Path
) -> None:
    report = signal_at(*STAGES)
    newest = []
    for again in range(len(STAGES)):
        with pytest.raises(KeyboardInterrupt):
            train(runs.config(), tmp_path / "run", resume=again > 0, report=report)
        newest.append(checkpoint_files(tmp_path / "run")[-1].name)
    assert newest == sorted(set(newest)), "each stop was later than the one before it"
    train(runs.config(), tmp_path / "run", resume=True, report=report)
    assert runs.outcome(tmp_path / "run") == whole
    assert not checkpoint_files(tmp_path / "run")


@pytest.mark.parametrize("imagine", [False, True])
def test_sldr_stopped_in_stage_one_or_in_its_inverse_model_resumes(
    imagine: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = {**runs.TINY["algorithm"], "auxiliary": {"name": "sldr"}}
    config = runs.config(
        total_timesteps=2000, settings={"imagine": imagine, "algorithm": algorithm}
    )
    runs.run(tmp_path / "whole", config=config)
    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(config, folder, report=signal_at("checkpoint at 400 env"))
    infer = ObjectNetworks.infer

    def stopped(*arguments: Any) -> th.Tensor:
        os.kill(os.getpid(), signal.SIGTERM)
        return infer(*arguments)

    told: list[str] = []
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ObjectNetworks, "infer", stopped)
        train(config, folder, resume=True, report=told.append)
    assert not any("inverse model's error" in said for said in told), "it stopped in the fit"
    assert not (folder / OBJECT_FILE).exists()
    train(config, folder, resume=True, report=told.append)
    assert any("checkpoint at 1000 env" in said for said in told)
    assert runs.outcome(folder) == runs.outcome(tmp_path / "whole")
    assert (folder / "predictor").exists() == imagine


@pytest.mark.parametrize("name", ["object_stage.json", "predictor/predictor.json"])
def test_half_written_object_stage_is_learned_again_until_the_robot_begins(
    name: str, crashed: Path, whole: dict[str, Any]
) -> None:
    (crashed / name).unlink()
    with pytest.raises(ValueError, match=f"{name} of the finished object stage is missing"):
        runs.run(crashed, resume=True)
    (crashed / "object_stage.json").unlink(missing_ok=True)
    for checkpoint in checkpoint_files(crashed):
        checkpoint.unlink()
    runs.run(crashed, resume=True)
    assert runs.outcome(crashed) == whole


def test_crash_before_the_first_checkpoint_starts_again(
    whole: dict[str, Any], tmp_path: Path
) -> None:
    rare = runs.config(checkpoint_minutes=1e9)
    with pytest.raises(RuntimeError, match=r"can be resumed from its beginning"):
        train(rare, tmp_path / "run", report=crash_at("stage 1"))

    def crash(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 2400:
            raise Crash

    # Now with stages one and two done, and an evaluation written that no checkpoint knows of.
    for checkpoint in checkpoint_files(tmp_path / "run"):
        checkpoint.unlink()
    with pytest.raises(RuntimeError, match=r"Crash"):
        train(rare, tmp_path / "run", resume=True, report=runs.quiet, progress=crash)
    assert len((tmp_path / "run" / "evaluations.csv").read_text().splitlines()) > 1
    for checkpoint in checkpoint_files(tmp_path / "run"):
        checkpoint.unlink()
    train(rare, tmp_path / "run", resume=True, report=runs.quiet)
    assert runs.outcome(tmp_path / "run") == whole


@pytest.fixture(scope="module")
def crashed_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crashed") / "run"

    def crash(figures: dict[str, Any]) -> None:
        if figures["env_steps"] > 2600:
            raise Crash

    with pytest.raises(RuntimeError, match="Crash"):
        train(runs.config(), folder, report=runs.quiet, progress=crash)
    return folder


@pytest.fixture
def crashed(crashed_once: Path, tmp_path: Path) -> Path:
    """A run that ended in the third stage, with two checkpoints."""
    return Path(shutil.copytree(crashed_once, tmp_path / "run"))


def test_damaged_checkpoint_gives_way_to_the_one_before_it(
    crashed: Path, whole: dict[str, Any]
) -> None:
    before, newest = checkpoint_files(crashed)
    data = bytearray(newest.read_bytes())
    data[-100] ^= 4
    newest.write_bytes(data)
    told: list[str] = []
    train(runs.config(), crashed, resume=True, report=told.append)
    (sentence,) = (said for said in told if "taking the one before it" in said)
    assert newest.name in sentence and "does not match its checksum" in sentence
    assert f"resumed at {int(before.stem.split('-')[1])} env steps" in told
    assert runs.outcome(crashed) == whole


@pytest.mark.parametrize("size", [0, 7, 100, 1000])
def test_truncated_checkpoint_gives_way_to_the_one_before_it(crashed: Path, size: int) -> None:
    before, newest = checkpoint_files(crashed)
    newest.write_bytes(newest.read_bytes()[:size])
    told: list[str] = []
    state = load_newest(crashed, told.append)
    assert state["run"]["model"]["counters"] == load_tree(before)["run"]["model"]["counters"]
    assert len(told) == 1 and newest.name in told[0]


def test_run_with_no_whole_checkpoint_is_refused(crashed: Path) -> None:
    for path in checkpoint_files(crashed):
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"every checkpoint in .* is damaged"):
        runs.run(crashed, resume=True)


def test_deleted_predictor_is_missed(crashed: Path) -> None:
    before = {path: path.read_bytes() for path in checkpoint_files(crashed)}
    shutil.rmtree(crashed / "predictor")
    with pytest.raises(ValueError, match=r"predictor.json of the finished object stage is missing"):
        runs.run(crashed, resume=True)
    assert {path: path.read_bytes() for path in checkpoint_files(crashed)} == before


def test_predictor_of_another_object_is_refused(crashed: Path) -> None:
    facts = crashed / "predictor" / "predictor.json"
    assert '"object_on_table": true' in facts.read_text()  # a Push task's
    facts.write_text(facts.read_text().replace('on_table": true', 'on_table": false'))
    with pytest.raises(ValueError, match=r"made with object_on_table=False, not True"):
        runs.run(crashed, resume=True)


def test_finished_run_given_more_steps_is_the_longer_run(
    whole: dict[str, Any], tmp_path: Path
) -> None:
    shorter = runs.config(total_timesteps=3000, keep_last_checkpoint=True)
    assert runs.run(tmp_path, config=shorter, command="train")["env_steps"] < 3600
    assert len(checkpoint_files(tmp_path)) == 1
    longer = runs.config(keep_last_checkpoint=True)
    (tmp_path / CROSS_TESTS).write_text("{}")
    seen = []

    def look(figures: dict[str, Any]) -> None:
        seen.append((tmp_path / "result.json").exists() or (tmp_path / CROSS_TESTS).exists())

    result = runs.run(tmp_path, config=longer, command="go on", resume=True, progress=look)
    assert seen and not any(seen), "what is said of the shorter run's policy"
    assert result["command"] == "train && go on"
    assert runs.run(tmp_path, config=longer, resume=True) == result  # finished
    checkpoint_files(tmp_path)[0].unlink()
    assert runs.outcome(tmp_path) == whole


def test_fewer_steps_than_are_gone_are_refused_and_nothing_is_lost(crashed: Path) -> None:
    kept = {path: path.read_bytes() for path in crashed.iterdir() if path.is_file()}
    fewer = runs.config(total_timesteps=1500)
    with pytest.raises(ValueError, match=r"has had \d+ env steps already; its steps are counted"):
        train(fewer, crashed, resume=True, report=runs.quiet)
    assert {path: path.read_bytes() for path in crashed.iterdir() if path.is_file()} == kept


@pytest.mark.parametrize("n_validated", [1, 2])
@pytest.mark.parametrize("more", [0, 1])
def test_a_run_resumed_to_end_before_its_last_validation_keeps_nothing_of_it(
    n_validated: int, more: int, tmp_path: Path
) -> None:
    folder = tmp_path / "run"

    def crash(figures: dict[str, Any]) -> None:
        if len((folder / "evaluations.csv").read_text().splitlines()) > n_validated:
            raise Crash

    with pytest.raises(RuntimeError, match="Crash"):
        train(runs.config(), folder, report=runs.quiet, progress=crash)
    assert (folder / "best_policy.safetensors").exists()
    before, newest = checkpoint_files(folder)
    newest.unlink()  # a rollout lies between what is left and the validation
    shorter = runs.config(total_timesteps=int(before.stem.split("-")[1]) + more)
    runs.run(folder, config=shorter, resume=True)
    runs.run(tmp_path / "whole", config=shorter)
    assert runs.outcome(folder) == runs.outcome(tmp_path / "whole")
    assert (folder / "best_policy.safetensors").exists() == (n_validated > 1)


def test_checkpoint_without_the_best_policy_goes_on(crashed: Path, whole: dict[str, Any]) -> None:
    """As earlier versions wrote them."""
    for path in checkpoint_files(crashed):
        state = load_tree(path)
        del state["best_policy"]
        save_tree(path, state)
    runs.run(crashed, resume=True)
    assert runs.outcome(crashed) == whole


def test_finished_run_without_a_checkpoint_is_given_no_more_steps(tmp_path: Path) -> None:
    runs.run(tmp_path, config=runs.config(total_timesteps=3000))
    kept = runs.outcome(tmp_path)
    with pytest.raises(ValueError, match=r"ended after \d+ env steps and kept no checkpoint"):
        runs.run(tmp_path, resume=True)
    assert runs.outcome(tmp_path) == kept


def test_finished_run_is_given_no_fewer_steps_than_it_has_had(tmp_path: Path) -> None:
    runs.run(tmp_path, config=runs.config(total_timesteps=2400))
    fewer = runs.config(total_timesteps=1500)
    with pytest.raises(ValueError, match=r"has had \d+ env steps already; its steps are counted"):
        train(fewer, tmp_path, resume=True, report=runs.quiet)


def test_checkpoint_that_cannot_be_written_is_told_whatever_the_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    checkpoints = Checkpoints(tmp_path, 3, told.append)
    checkpoints.write(10, {"steps": 10})
    checkpoints.wait()

    def fail(*arguments: Any) -> None:
        raise MemoryError("no room")

    monkeypatch.setattr(Snapshot, "write", fail)
    checkpoints.write(20, {"steps": 20})
    checkpoints.wait()
    (kept,) = checkpoint_files(tmp_path)
    assert told[1] == (
        "the checkpoint at 20 env steps could not be written (no room); the last good one is "
        f"{kept.name}"
    )


def test_only_the_last_checkpoints_are_kept(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, 3, runs.quiet)
    for steps in (10, 20, 30, 40, 25, 27):  # after 40 the run is taken up again at 20
        checkpoints.write(steps, {"steps": steps})
    checkpoints.wait()
    kept = [load_tree(path)["steps"] for path in checkpoint_files(tmp_path)]
    assert kept == [20, 25, 27] or kept == [25, 27]
    checkpoints.remove()
    assert not checkpoint_files(tmp_path)


def test_checkpoint_holds_what_was_when_it_was_taken(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, 2, runs.quiet)
    store = np.zeros((1000, 50))
    for steps, used in ((1, 10), (2, 900), (3, 1000)):
        store[:used] = steps
        checkpoints.write(steps, {"slots": store[:used]})
        store[:] = -1.0  # the training goes on while the file is being written
    checkpoints.wait()
    for steps, used in ((2, 900), (3, 1000)):
        slots = load_tree(tmp_path / f"checkpoint-{steps:012}.safetensors")["slots"]
        assert slots.shape == (used, 50) and (slots == steps).all()


def test_every_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "tree.safetensors"
    tree = {"a": np.arange(3, dtype=np.int16), "b": [th.ones(2), (1, None)], 3: np.zeros((0, 2))}
    save_tree(path, tree)
    data = path.read_bytes()
    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with pytest.raises(ValueError, match="is not a whole checkpoint"):
            load_tree(path)
    path.write_bytes(data)
    assert load_tree(path)["b"][1] == (1, None)


def test_environments_that_cannot_tell_their_state_resume_exactly(tmp_path: Path) -> None:
    """Gymnasium-Robotics' own: each rollout has episodes of its own seed."""
    settings: dict[str, Any] = {"n_envs": 2, "imagine": False, "algorithm": runs.SMALL_NET}
    whole = bare_run("FetchReach-v4", **settings).learn(600)
    bare_run("FetchReach-v4", **settings).learn(300).save(tmp_path / "part")
    resumed = FollowObject.load(tmp_path / "part").learn(600)
    assert whole.model is not None and resumed.model is not None
    assert resumed.env_steps == whole.env_steps
    for name, value in whole.model.policy.state_dict().items():
        assert (value == resumed.model.policy.state_dict()[name]).all(), name


def test_killed_runs_resume(whole: dict[str, Any], tmp_path: Path) -> None:
    """SIGKILL in the first stage, in a checkpoint's writing, and in the third stage.

    benchmarks/kill_test.py does the same twenty times at random moments.
    """
    folder = tmp_path / "run"
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([runs.__name__])  # what it imports takes longer than the run
    marks = [
        lambda: len(checkpoint_files(folder)) > 0,
        lambda: bool(list(folder.glob(".checkpoint*.tmp"))),
        lambda: (folder / "policy.safetensors").exists(),
    ]
    for again, mark in enumerate(marks):
        for half_written in folder.glob(".*.tmp"):  # of a kill before; the run itself removes them
            half_written.unlink()
        process = context.Process(target=runs.run_in_few_copies, args=(folder, again > 0))
        process.start()
        while not mark():
            assert process.is_alive(), "the run ended before it could be killed"
            time.sleep(0.0005)
        process.kill()
        process.join()
    runs.run(folder, resume=True)
    assert runs.outcome(folder) == whole
    assert not list(folder.glob(".*.tmp"))


def test_second_signal_ends_at_once() -> None:
    with StopSignals() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
