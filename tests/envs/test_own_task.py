"""A task of one's own: registered in a module, known to every command by module and id."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from cli_runs import TINY
from gymnasium.utils.env_checker import check_env
from registered_tasks import forget_tasks
from tiny_runs import bare_run

from sb3_follow_object.command.cli import main
from sb3_follow_object.comparison.cells import Settings
from sb3_follow_object.comparison.grid import plan
from sb3_follow_object.envs import (
    TASKS,
    Box,
    FetchVecEnv,
    Height,
    Region,
    Task,
    make_vec,
    object_id,
    physics_id,
    register_task,
    tasks,
)
from sb3_follow_object.envs.scene import fetch_scene
from sb3_follow_object.envs.tasks import Landmarks
from sb3_follow_object.settings.presets import load_config, run_config

MODULE = "own_tasks"
SUPPORT = str(Path(__file__).parents[1] / "support")  # where that lies
NAME = "PushPast"
OWN = f"FollowObject/{NAME}-v0"
FULL = f"{MODULE}:{OWN}"
MAIN = "import sys; from sb3_follow_object.command.cli import main"
FEW_COPIES = "import tiny_runs; tiny_runs.evaluate_in_few_copies(); "
NEAR = Region("gripper", (-0.15, -0.15), (0.15, 0.0))
FAR = Region("gripper", (-0.10, 0.15), (0.10, 0.25))


@pytest.fixture
def own() -> Task:
    run_config(FULL, method="her")
    return TASKS[NAME]


def test_its_environments_are_like_the_packages(own: Task) -> None:
    assert register_task(replace(own)) == OWN, "an equal task may be registered again"
    for env_id in (OWN, object_id(OWN)):
        # The check of drawing opens a window; test_envs.py draws without one.
        check_env(gym.make(env_id).unwrapped, skip_render_check=True)
        assert gym.make(env_id).spec.max_episode_steps == own.horizon  # type: ignore[union-attr]
    venv = make_vec(FULL, 2, 1, seed=0)
    assert isinstance(venv, FetchVecEnv)
    assert np.isfinite(venv.reset()["observation"]).all()
    assert physics_id(OWN) != physics_id("FollowObject/PushSideGap-v0")


def test_another_task_of_its_name_is_refused(own: Task) -> None:
    with pytest.raises(ValueError, match="another task's already"):
        register_task(replace(own, horizon=41))
    with pytest.raises(ValueError, match="another task's already"):
        register_task(replace(own, name="PnPShelf"))
    with pytest.raises(ValueError, match="'FollowObject/PushPastObject-v0' is another"):
        register_task(replace(own, name=f"{NAME}Object"))
    assert TASKS[NAME] == own
    assert TASKS["PnPShelf"].name == "PnPShelf" and TASKS["PnPShelf"] != own


def test_presets_treat_it_as_the_most_similar_task(own: Task) -> None:
    for method in ("fo", "her", "sldr"):
        for preset in ("default", "paper"):
            mine, theirs = (
                run_config(env_id, method=method, preset=preset)
                for env_id in (FULL, "FollowObject/PushSideGap-v0")
            )
            assert mine == replace(theirs, env_id=OWN, module=MODULE)


def test_a_grid_calls_it_by_its_short_name(own: Task, tmp_path: Path) -> None:
    (cell,) = plan(tmp_path, [FULL], ["fo"], [0], Settings(steps=1000, paper_evaluation=True))
    assert (cell.name, cell.task) == (f"{NAME}-fo-0", NAME)
    assert f"--env {FULL}" in cell.command
    assert cell.config.eval_every == 1900 * own.horizon


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda: Box((0.0, 0.0, 0.2), (0.1, 0.0, 0.1)), "half-sizes must be positive"),
        (lambda: Region("gripper", (0.1, 0.0), (0.0, 0.1)), "is empty"),
        (lambda: Region("robot", (0.0, 0.0), (0.1, 0.1)), "'gripper' or 'table'"),  # type: ignore[arg-type]
        (lambda: Task("Push Past", NEAR, FAR), "letters and digits"),
        (
            lambda: Task("PushPast", NEAR, FAR, horizon=0),
            "horizon of PushPast is 0",
        ),
        (lambda: Task("PushPast", NEAR, FAR, obstacles=[]), "tuples"),  # type: ignore[arg-type]
        (
            lambda: Task("PushPast", NEAR, Region("gripper", (5.0, 0.0), (5.1, 0.1))),
            r"PushPast: its goals lie up to 5.73 m from the robot's shoulder, but its arm reaches",
        ),
        (lambda: Task("PushPast", NEAR, FAR, Height(0.0, 5.0)), r"goals lie up to 4.7\d m from"),
        (lambda: Task("PushPast", NEAR, Region("table", (0, 0), (np.inf, 0))), "up to inf m"),
        (
            lambda: Task("PushPast", Region("table", (-0.30, 0.0), (0.0, 0.1)), FAR),
            "would start up to 0.05 m beside the table",
        ),
        (
            lambda: Task("PushPast", NEAR, FAR, obstacles=(Box((0, -0.1, 0.25), (0.1,) * 3),)),
            r"would start inside the obstacle at \(0, -0.1, 0.25\)",
        ),
    ],
)
def test_a_task_that_cannot_be_is_refused(wrong: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        wrong()


def test_reach_and_table_are_those_of_the_scene() -> None:
    for task in TASKS.values():
        scene = fetch_scene(task)
        for name in ("gripper", "table", "rest_height"):
            measured, said = getattr(scene.landmarks, name), getattr(tasks.COMMON, name)
            np.testing.assert_allclose(measured, said, atol=1e-3, err_msg=task.name)
        model, data = scene.model, mujoco.MjData(scene.model)
        data.qpos[:] = scene.qpos
        mujoco.mj_forward(model, data)
        shoulder = model.body("robot0:shoulder_pan_link")
        np.testing.assert_allclose(data.xpos[shoulder.id], tasks.SHOULDER, atol=1e-4)
        table = model.geom_size[model.body("table0").geomadr[0]]
        np.testing.assert_allclose(table[:2], tasks.TABLE_HALF_SIZE)
        hand = model.body("robot0:gripper_link").id
        arm = float(np.linalg.norm(data.site("robot0:grip").xpos - data.xpos[hand]))
        while hand != shoulder.id:
            arm += float(np.linalg.norm(model.body_pos[hand]))
            hand = model.body_parentid[hand]
        assert arm == pytest.approx(tasks.REACH, abs=0.005)


def test_regions_without_a_place_for_the_object_are_refused() -> None:
    below_gripper = Task("Below", Region("gripper", (-0.05, -0.05), (0.05, 0.05)), FAR)
    landmarks = Landmarks((1.34, 0.75, 0.55), (1.3, 0.75, 0.2), 0.425)
    with pytest.raises(ValueError, match=r"Below: no point of .* lies 0.1 m from"):
        below_gripper.sample(np.random.default_rng(0), landmarks)


def test_module_that_cannot_be_imported_is_named() -> None:
    with pytest.raises(ValueError, match="on PYTHONPATH"):
        run_config("no_such_module:FollowObject/PushPast-v0")


def test_commands_train_resume_and_test_it_in_processes_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")  # films take longer than the rest
    env = {**os.environ, "PYTHONPATH": SUPPORT, "PYTHONWARNINGS": "ignore"}

    def commands(*lines: list[str]) -> subprocess.CompletedProcess[str]:
        """Command lines one after the other, until one fails, in a process of their own."""
        code = FEW_COPIES + MAIN if "PYTHONPATH" in env else MAIN
        code += f"; sys.exit({' or '.join(f'main({words})' for words in lines)})"
        line = [sys.executable, "-c", code]
        return subprocess.run(line, env=env, cwd=tmp_path, capture_output=True, text=True)

    run = str(tmp_path / "run")
    train, test = ["train", "--env", FULL, "--run", run], ["evaluate", run, "--episodes", "4"]
    small = ["--n-envs", "2", "--threads", "1", "--set", *TINY]
    small += ["keep_last_checkpoint=true"]
    assert main([*train, "--steps", "2200", *small]) == 0
    forget_tasks()
    done = commands([*train, "--resume", "--steps", "2400"], test)
    assert done.returncode == 0, done.stderr
    assert NAME in done.stdout
    env.pop("PYTHONPATH")
    done = commands(test)
    assert done.returncode == 2 and "on PYTHONPATH" in done.stderr

    # And through Python, where the configuration tells the module.
    assert load_config(run).full_id == FULL


def test_a_module_before_the_id_does_not_change_the_kind() -> None:
    code = "from sb3_follow_object.envs import make_vec\n"
    code += f"print(type(make_vec({FULL!r}, 2, 1)).__name__)"
    env = {**os.environ, "PYTHONPATH": SUPPORT, "PYTHONWARNINGS": "ignore"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["FetchVecEnv"], done.stderr


@pytest.mark.usefixtures("own")
def test_a_save_is_loaded_where_its_module_was_not_imported(tmp_path: Path) -> None:
    small = {"policy_kwargs": {"net_arch": [8]}, "gradient_steps": 1, "batch_size": 8}
    small |= {"buffer_size": 100}
    run = bare_run(FULL, imagine=False, n_envs=1, n_threads=1, algorithm=small)
    run.learn(run.horizon).save(tmp_path / "save")
    run.close()
    code = "from sb3_follow_object import FollowObject\n"
    code += f"print(FollowObject.load({str(tmp_path / 'save')!r}).env_id)"
    env = {**os.environ, "PYTHONPATH": SUPPORT, "PYTHONWARNINGS": "ignore"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == [OWN], done.stderr
