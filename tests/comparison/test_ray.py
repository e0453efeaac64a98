"""The same grid on a Ray cluster of two nodes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from sb3_follow_object.command.cli import main
from sb3_follow_object.common import extras
from sb3_follow_object.common.files import lock
from sb3_follow_object.comparison import figures, ray_executor
from sb3_follow_object.comparison.ray_executor import RayExecutor, _write_files
from sb3_follow_object.comparison.worker import TRAIN, Job

SMALL = ["policy_kwargs.net_arch=[8]", "batch_size=16", "gradient_steps=2", "n_envs=2"]
SMALL += ["eval_every=1000", "n_eval_episodes=2", "n_final_episodes=2", "buffer_size=2000"]
TINY = ["object_timesteps=800", "n_paths=8", "predictor_fit.epochs=1", "predictor_fit.hidden=[8]"]
TINY += ["object_algorithm.policy_kwargs.net_arch=[8]", "object_algorithm.batch_size=16"]
TINY += ["object_algorithm.gradient_steps=2", "object_algorithm.buffer_size=2000"]
TINY += ["n_test_episodes=2", *SMALL]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes with a core each, on this machine."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'sb3-follow-object[ray]'")
    import ray
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    # Ray reads it in this case. Or its workers wait for whatever else the machine does.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112
    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    nodes = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    nodes.add_node(**node)
    try:
        yield nodes
    finally:
        ray.shutdown()
        nodes.shutdown()


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are drawn here, not on the nodes, and take longer than the runs."""
    monkeypatch.setattr(figures, "draw_results", lambda *arguments: [])


def test_grid_runs_on_two_nodes_and_its_files_come_back(
    cluster: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", "--out", str(tmp_path), "--tasks", "PushSideGap", "--methods", "fo", "her"]
    words += ["--steps", "1800", "--ray", cluster.address, "--set", *TINY]
    assert main(words) == 0, capsys.readouterr().err
    for method, names in (("fo", {"predictor", "object_stage.json"}), ("her", set())):
        run = tmp_path / f"PushSideGap-{method}-0"
        found = {path.name for path in run.iterdir()}
        assert found >= {"result.json", "policy.safetensors", "evaluations.csv", *names}
        assert not [name for name in found if name.startswith("checkpoint")]
        assert json.loads((run / "result.json").read_text())["env_steps"] >= 1800
    assert (tmp_path / "object" / "PushSideGap-0" / "predictor" / "predictor.json").exists()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("PushSideGap-*/*")}
    assert main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("PushSideGap-*/*")} == before


def test_run_that_raises_on_a_node_is_tried_twice_and_reported(
    cluster: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", "--out", str(tmp_path), "--tasks", "PushSideGap", "--methods", "cher"]
    words += ["--steps", "600", "--ray", cluster.address, "--set", *SMALL, "replay_on_device=true"]
    assert main(words) == 2
    printed = capsys.readouterr()
    assert "1 of 1 runs failed: PushSideGap-cher-0" in printed.err
    assert "it failed twice" in printed.out
    assert "| PushSideGap | failed |" in printed.out


def test_more_threads_than_a_node_has_are_refused(
    cluster: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compare", "--out", str(tmp_path / "new"), "--tasks", "PushSideGap", "--threads", "2"]
    assert main([*words, "--methods", "her", "--ray", cluster.address]) == 2
    assert "has 2 cores for a run, the largest has 1" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_only_files_that_went_along_are_removed(tmp_path: Path) -> None:
    for name in ("sent", "made_here"):
        (tmp_path / name).write_text("old")
    _write_files(tmp_path, {"made/there": b"new"}, gone={"sent"})
    assert {path.name for path in tmp_path.rglob("*")} == {"made_here", "made", "there"}


def test_ray_that_is_not_installed_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(module, name=module)

    monkeypatch.setattr(extras, "import_module", missing)
    words = ["compare", "--out", str(tmp_path / "new"), "--tasks", "PushSideGap"]
    assert main([*words, "--methods", "her", "--ray", "local"]) == 2
    assert "pip install 'sb3-follow-object[ray]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.fixture
def fake_ray(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Ray's calls without a cluster: tasks end when a test says so."""
    ray = MagicMock()
    ray.exceptions.RayError = type("RayError", (Exception,), {})
    monkeypatch.setattr(ray_executor, "need", lambda module, extra: ray)
    return ray


@pytest.mark.parametrize("lost", [False, True], ids=["comes back", "node is lost"])
def test_folder_of_a_run_that_is_away_is_locked_until_it_ends(
    lost: bool, fake_ray: MagicMock, tmp_path: Path
) -> None:
    job = Job(TRAIN, "run", str(tmp_path))
    executor = RayExecutor(1)
    executor.start(job)
    with pytest.raises(ValueError, match="another process works in"):
        RayExecutor(1).start(job)
    (reference,) = executor._jobs

    def get(asked: Any) -> Any:
        if asked is not reference:
            return []  # of the mailbox
        if lost:
            raise fake_ray.exceptions.RayError("the node died")
        with pytest.raises(ValueError, match="another process"), lock(tmp_path, wait=False):
            pass  # held until the files are back
        return {"finished": True}, {"result.json": b"{}"}, set()

    fake_ray.get.side_effect = get
    fake_ray.wait.return_value = ([reference], [])
    outcome = {"failed": "RayError: the node died"} if lost else {"finished": True}
    assert executor.messages(0.0) == [("run", outcome)]
    assert (tmp_path / "result.json").exists() != lost
    with lock(tmp_path, wait=False):
        pass  # free again


def test_folder_of_a_run_that_cannot_be_sent_is_free_again(
    fake_ray: MagicMock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(folder: Path) -> None:
        raise OSError("input/output error")

    monkeypatch.setattr(ray_executor, "_read_files", unreadable)
    with pytest.raises(OSError, match="input/output"):
        RayExecutor(1).start(Job(TRAIN, "run", str(tmp_path)))
    with lock(tmp_path, wait=False):
        pass
