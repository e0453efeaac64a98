"""F_phi: what it learns of paths, how it predicts, and its folder on the disk."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
import toy

from sb3_follow_object.common.files import atomic_write
from sb3_follow_object.imagination.goal_predictor import GoalPredictor
from sb3_follow_object.imagination.predictor_files import FACTS_FILE, TENSORS_FILE

SMALL: dict[str, Any] = {"env_id": "Toy-v0", "physics": "abc", "hidden": (64, 64)}


@pytest.fixture(scope="module")
def predictor() -> GoalPredictor:
    return GoalPredictor.fit(*toy.paths(400), **SMALL)


def query(n: int, seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    path, goal = toy.paths(n, seed)
    return path[:, 0], goal, np.random.default_rng(seed).integers(1, toy.HORIZON + 1, n)


def test_unseen_paths_are_met_to_a_few_millimetres(predictor: GoalPredictor) -> None:
    path, goal = toy.paths(200, seed=9)
    error = 1000 * np.linalg.norm(predictor.paths(path[:, 0], goal) - path, axis=2).mean(axis=0)
    assert error[0] == 0
    assert error.max() < 20  # the goal is 300 mm away
    assert predictor.error_mm.shape == (toy.HORIZON,)
    # The reported error is that of unseen paths.
    np.testing.assert_allclose(predictor.error_mm, error[1:], rtol=0.5)


def test_k_counts_steps_ahead(predictor: GoalPredictor) -> None:
    path, goal = toy.paths(50, seed=3)
    for k in (1, 4, 10):
        imagined = predictor.predict(path[:, 0], goal, np.full(50, k))
        assert np.linalg.norm(imagined - path[:, k], axis=1).mean() < 0.02
    np.testing.assert_array_equal(predictor.paths(path[:, 0], goal)[:, 0], path[:, 0])


def test_a_prediction_does_not_depend_on_its_batch(predictor: GoalPredictor) -> None:
    start, goal, k = query(64)
    together = predictor.predict(start, goal, k)
    assert together.dtype == np.float64
    alone = [predictor.predict(start[i : i + 1], goal[i : i + 1], k[i : i + 1]) for i in range(64)]
    np.testing.assert_allclose(together, np.concatenate(alone), atol=1e-6)
    np.testing.assert_allclose(predictor.paths(start, goal)[np.arange(64), k], together, atol=1e-6)


def test_an_empty_batch_is_answered(predictor: GoalPredictor) -> None:
    assert predictor.predict(*query(0)).shape == (0, 3)


def test_fitting_depends_on_its_seed_alone_and_leaves_global_randomness_be() -> None:
    data = toy.paths(20)
    torch.manual_seed(1)
    np.random.seed(1)
    before = torch.get_rng_state(), np.random.get_state()[1].copy()
    first = GoalPredictor.fit(*data, **SMALL, epochs=2, seed=3)
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])
    torch.manual_seed(2)
    again = GoalPredictor.fit(*data, **SMALL, epochs=2, seed=3)
    other = GoalPredictor.fit(*data, **SMALL, epochs=2, seed=4)
    np.testing.assert_array_equal(first.predict(*query(9)), again.predict(*query(9)))
    np.testing.assert_array_equal(first.error_mm, again.error_mm)
    assert not np.array_equal(first.predict(*query(9)), other.predict(*query(9)))


def test_progress_is_reported_after_each_epoch_and_falls() -> None:
    seen: list[tuple[int, float]] = []
    GoalPredictor.fit(
        *toy.paths(60), **SMALL, epochs=5, progress=lambda epoch, loss: seen.append((epoch, loss))
    )
    assert [epoch for epoch, _ in seen] == [1, 2, 3, 4, 5]
    assert seen[-1][1] < seen[0][1]


def test_a_coordinate_that_never_varies_is_not_blown_up() -> None:
    path, goal = toy.paths(100)
    path[..., 2], goal[..., 2] = 0.425, 0.425
    flat = GoalPredictor.fit(path, goal, **SMALL, epochs=10)
    moved = path[:, 0] + [0, 0, 0.0005]  # a robot's scene settles half a millimetre elsewhere
    imagined = flat.predict(moved, goal, np.full(100, 5))
    assert np.abs(imagined - flat.predict(path[:, 0], goal, np.full(100, 5))).max() < 0.005


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"paths": np.zeros((4, 11, 2))}, "paths must have the shape"),
        ({"paths": np.zeros((1, 11, 3)), "goals": np.zeros((1, 3))}, "n >= 2"),
        ({"goals": np.zeros((3, 3))}, "goals must have the shape"),
        ({"goals": np.full((4, 3), np.nan)}, "finite"),
        ({"hidden": (0,)}, "hidden"),
        ({"hidden": ()}, "hidden"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"epochs": 0}, "epochs"),
        ({"batch_size": 0}, "batch_size"),
        ({"test_share": 1.0}, "test_share"),
    ],
)
def test_bad_data_and_settings_are_refused(change: dict[str, Any], message: str) -> None:
    good = {"paths": np.zeros((4, 11, 3)), "goals": np.zeros((4, 3)), **SMALL}
    with pytest.raises(ValueError, match=message):
        GoalPredictor.fit(**{**good, **change})


@pytest.mark.parametrize("k", [0, 11])
def test_k_outside_the_horizon_is_refused(predictor: GoalPredictor, k: int) -> None:
    with pytest.raises(ValueError, match=r"k must lie in 1\.\.10"):
        predictor.predict(np.zeros((1, 3)), np.zeros((1, 3)), np.array([k]))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"k": [2.5]}, r"k must hold whole numbers, got 2\.5 in it"),
        ({"k": [np.nan]}, "k must hold finite numbers"),
        ({"k": [True]}, "k must hold finite numbers"),
        ({"start": [[0.0, np.nan, 0.0]]}, "start must hold finite numbers"),
        ({"goal": [[0.0, 0.0, np.inf]]}, "goal must hold finite numbers"),
    ],
)
def test_what_nothing_can_be_imagined_from_is_refused(
    predictor: GoalPredictor, change: dict[str, Any], sentence: str
) -> None:
    query = {"start": np.zeros((1, 3)), "goal": np.zeros((1, 3)), "k": [3]}
    with pytest.raises(ValueError, match=sentence):
        predictor.predict(**{**query, **change})  # type: ignore[arg-type]
    whole = predictor.predict(np.zeros((1, 3)), np.zeros((1, 3)), np.array([3]))
    same = predictor.predict(np.zeros((1, 3)), np.zeros((1, 3)), np.array([3.0]))
    np.testing.assert_array_equal(whole, same)
    assert predictor.predict(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).shape == (0, 3)


def test_wrong_shapes_are_refused(predictor: GoalPredictor) -> None:
    with pytest.raises(ValueError, match="shapes"):
        predictor.predict(np.zeros((2, 3)), np.zeros((1, 3)), np.array([1, 1]))


# Files


def test_saving_and_loading_keeps_everything(predictor: GoalPredictor, tmp_path: Path) -> None:
    predictor.save(tmp_path / "new")
    loaded = GoalPredictor.load(tmp_path / "new", env_id="Toy-v0", physics="abc")
    np.testing.assert_array_equal(loaded.predict(*query(30)), predictor.predict(*query(30)))
    np.testing.assert_array_equal(loaded.error_mm, predictor.error_mm)
    assert (loaded.horizon, loaded.env_id, loaded.physics) == (toy.HORIZON, "Toy-v0", "abc")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [FACTS_FILE, TENSORS_FILE]


def test_half_the_bytes_imagine_nearly_the_same(predictor: GoalPredictor, tmp_path: Path) -> None:
    predictor.save(tmp_path / "whole")
    predictor.save(tmp_path / "half", half=True)
    whole, half = ((tmp_path / name / TENSORS_FILE).stat().st_size for name in ("whole", "half"))
    assert half < 0.6 * whole
    loaded = GoalPredictor.load(tmp_path / "half", env_id="Toy-v0", physics="abc")
    np.testing.assert_allclose(loaded.predict(*query(30)), predictor.predict(*query(30)), atol=2e-3)
    loaded.save(tmp_path / "again", half=True)
    same = (tmp_path / "again" / TENSORS_FILE).read_bytes()
    assert same == (tmp_path / "half" / TENSORS_FILE).read_bytes()


def test_a_predictor_for_another_task_or_physics_is_refused(
    predictor: GoalPredictor, tmp_path: Path
) -> None:
    predictor.save(tmp_path)
    with pytest.raises(ValueError, match="made for env_id 'Toy-v0', not for 'Other-v0'"):
        GoalPredictor.load(tmp_path, env_id="Other-v0")
    with pytest.raises(ValueError, match="made for physics 'abc'"):
        GoalPredictor.load(tmp_path, physics="abd")


def edit_facts(folder: Path, **changes: Any) -> None:
    facts = json.loads((folder / FACTS_FILE).read_text())
    (folder / FACTS_FILE).write_text(json.dumps({**facts, **changes}))


def test_a_module_before_the_id_is_no_part_of_a_tasks_name(tmp_path: Path) -> None:
    small = {**SMALL, "hidden": (4,)}
    for env_id in ("Toy-v0", "Own/Toy-v0"):
        made = GoalPredictor.fit(*toy.paths(8), **{**small, "env_id": f"a.module:{env_id}"})
        assert made.env_id == env_id
        made.save(tmp_path)
        assert json.loads((tmp_path / FACTS_FILE).read_text())["env_id"] == env_id
        edit_facts(tmp_path, env_id=f"a.module:{env_id}")  # as files of before have it
        for wanted in (env_id, f"a.module:{env_id}", f"another:{env_id}"):
            assert GoalPredictor.load(tmp_path, env_id=wanted).env_id == env_id
        with pytest.raises(ValueError, match=f"made for env_id '{env_id}', not for 'Other-v0'"):
            GoalPredictor.load(tmp_path, env_id="a.module:Other-v0")


def edit_tensors(folder: Path, **changes: torch.Tensor) -> None:
    """Change tensors and sign them anew, so that only the later checks can notice."""
    tensors = safetensors.torch.load((folder / TENSORS_FILE).read_bytes())
    data = safetensors.torch.save({**tensors, **changes})
    (folder / TENSORS_FILE).write_bytes(data)
    edit_facts(folder, sha256=hashlib.sha256(data).hexdigest())


def test_a_predictor_of_an_object_moved_otherwise_is_refused(tmp_path: Path) -> None:
    made = GoalPredictor.fit(*toy.paths(8), **{**SMALL, "hidden": (4,)}, object_on_table=True)
    made.save(tmp_path)
    assert GoalPredictor.load(tmp_path, object_on_table=True).object_on_table is True
    assert GoalPredictor.load(tmp_path).object_on_table is True
    with pytest.raises(ValueError, match=r"made with object_on_table=True, not False"):
        GoalPredictor.load(tmp_path, object_on_table=False)


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"horizon": 0},
        {"horizon": 11},
        {"horizon": True},
        {"horizon": 10**12},
        {"hidden": [64]},
        {"hidden": [64, 64, 64]},
        {"hidden": [10**9, 10**9]},
        {"hidden": "64"},
        {"env_id": None},
        {"physics": 3},
        {"sha256": "0" * 64},
        {"error_mm": [float("nan")] * toy.HORIZON},
        {"error_mm": ["1"] * toy.HORIZON},
    ],
)
def test_changed_facts_are_refused(
    predictor: GoalPredictor, tmp_path: Path, change: dict[str, Any]
) -> None:
    predictor.save(tmp_path)
    edit_facts(tmp_path, **change)
    with pytest.raises(ValueError, match=r"predictor\."):
        GoalPredictor.load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"0.bias": torch.full((64,), float("nan"))},
        {"0.bias": torch.zeros(63)},
        {"0.bias": torch.zeros(64, dtype=torch.float64)},
        {"extra": torch.zeros(1)},
        {"input_std": torch.zeros(7, dtype=torch.float64)},
    ],
)
def test_changed_tensors_are_refused(
    predictor: GoalPredictor, tmp_path: Path, change: dict[str, torch.Tensor]
) -> None:
    predictor.save(tmp_path)
    edit_tensors(tmp_path, **change)
    with pytest.raises(ValueError, match=TENSORS_FILE):
        GoalPredictor.load(tmp_path)


@pytest.mark.parametrize("name", [FACTS_FILE, TENSORS_FILE])
def test_missing_cut_and_oversized_files_are_refused(
    predictor: GoalPredictor, tmp_path: Path, name: str
) -> None:
    predictor.save(tmp_path)
    whole = (tmp_path / name).read_bytes()
    for data in (whole[:-5], b"", b"\xff" * 100, whole + bytes(5_000_000)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=name):
            GoalPredictor.load(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(ValueError, match="No such file"):
        GoalPredictor.load(tmp_path)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    atomic_write(path, b"older than new")

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"older than new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
