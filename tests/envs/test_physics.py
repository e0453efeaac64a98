"""The physics: parity with Gymnasium-Robotics, trimmed against full collision, the object alone."""

import importlib.util
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import gymnasium_robotics
import mujoco
import numpy as np
import pytest

from sb3_follow_object.envs import TASKS, FetchEnv, ObjectEnv, Region, Task
from sb3_follow_object.envs.scene import PULLER, fetch_scene, fetch_spec, object_scene

AROUND_GRIPPER = Region("gripper", (-0.15, -0.15), (0.15, 0.15))
BLOCKED = Task("Blocked", AROUND_GRIPPER, AROUND_GRIPPER, blocked_gripper=True)


def original(env_id: str) -> gym.Env:
    gym.register_envs(gymnasium_robotics)
    try:
        env = gym.make(env_id).unwrapped
        env.reset(seed=0)
    except AssertionError:
        pytest.skip(f"gymnasium-robotics does not work with mujoco {mujoco.__version__}")
    return env


@pytest.mark.parametrize(
    ("env_id", "task"),
    [("FetchPickAndPlace-v4", TASKS["PnPSimpleV1"]), ("FetchPush-v4", BLOCKED)],
    ids=["pick_and_place", "push"],
)
def test_parity_with_gymnasium_robotics(env_id: str, task: Task) -> None:
    theirs, ours = original(env_id), FetchEnv(task)
    ours.reset(seed=0)
    simulation = ours.simulation
    source, data = theirs.data, simulation.data[0]
    for seed in range(20):
        obs, _ = theirs.reset(seed=seed)
        mujoco.mj_resetData(simulation.scene.model, data)
        for field in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
            getattr(data, field)[:] = getattr(source, field)
        mujoco.mj_forward(simulation.scene.model, data)
        data.qacc_warmstart[:] = source.qacc_warmstart
        simulation.goals[0] = obs["desired_goal"]
        simulation.refresh(0)
        for action in np.random.default_rng(seed).uniform(-1, 1, (50, 4)).astype(np.float32):
            expected, reward, *_ = theirs.step(action)
            found, our_reward, *_ = ours.step(action)
            for key, values in expected.items():
                np.testing.assert_allclose(found[key], values, rtol=0, atol=1e-6, err_msg=key)
            assert our_reward == reward


@pytest.fixture(scope="module")
def collision_equality() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "collision_equality.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("behaviour", ["random", "touch", "corner"])
@pytest.mark.parametrize("name", TASKS)
def test_reachable_collision_equals_full_bit_for_bit(
    collision_equality: ModuleType, name: str, behaviour: str
) -> None:
    result = collision_equality.compare(TASKS[name], behaviour, n_episodes=3, seed=1)
    assert result["equal_episodes"] == 3
    if behaviour == "touch":
        assert result["episodes_object_moved"] >= 1


@pytest.mark.parametrize("name", TASKS)
def test_a_resting_object_stays_and_the_gripper_stands_at_its_place(name: str) -> None:
    marks = fetch_scene(TASKS[name]).landmarks
    np.testing.assert_allclose(marks.gripper, (1.342, 0.749, 0.535), atol=1e-3)
    assert marks.rest_height == pytest.approx(0.425, abs=1e-3)
    env = ObjectEnv(name)
    obs, _ = env.reset(seed=0)
    for _ in range(5):
        later, *_ = env.step(np.zeros(7))
    np.testing.assert_allclose(later["achieved_goal"], obs["achieved_goal"], atol=1e-3)


def test_the_object_alone_follows_its_actions_and_is_stopped_by_obstacles() -> None:
    free, walled = ObjectEnv("PnPSimpleV1"), ObjectEnv("PnPObstacle")
    action = np.zeros(7)
    action[1] = 1.0  # towards the wall
    ends = {}
    for name, env in (("free", free), ("walled", walled)):
        env.reset(seed=0)
        for _ in range(30):
            obs, *_ = env.step(action)
        ends[name] = obs["achieved_goal"][1]
    assert ends["free"] > 1.0
    assert ends["walled"] < 0.8125


def test_blocked_fingers_stay_closed() -> None:
    env = FetchEnv("PushSideGap")
    env.reset(seed=0)
    for _ in range(5):
        obs, *_ = env.step(np.array([0.0, 0.0, 0.0, 1.0]))
    assert obs["observation"][9:11].tolist() == [0.0, 0.0]


def test_the_tube_stands_at_the_goal_and_leaves_room_for_the_object() -> None:
    env = ObjectEnv("PnPInsertion")
    for seed in range(5):
        obs, _ = env.reset(seed=seed)
        data = env.simulation.data[0]
        np.testing.assert_allclose(data.body("tube").xpos[:2], obs["desired_goal"][:2])
        assert data.body("tube").xpos[2] == pytest.approx(0.4)
        data.qpos[:3] = obs["desired_goal"]
        mujoco.mj_forward(env.simulation.scene.model, data)
        walls = {f"tube{i}" for i in range(4)}
        touched = {env.simulation.scene.model.geom(g).name for g in data.contact.geom.ravel()}
        assert not walls & touched


@pytest.mark.parametrize("name", TASKS)
def test_the_object_is_alone_with_what_stands_and_what_pulls_it(name: str) -> None:
    whole, alone = fetch_scene(TASKS[name]).model, object_scene(TASKS[name]).model
    kept = {whole.body(body).name for body in range(whole.nbody)}
    kept = {body for body in kept if not body.startswith("robot0:")}
    assert {alone.body(body).name for body in range(alone.nbody)} == {*kept, PULLER}
    assert (alone.nv, alone.nu, alone.neq) == (6, 0, 1)
    for body in kept:
        for field in ("pos", "mass", "inertia", "ipos", "iquat"):
            ours, theirs = (getattr(model.body(body), field) for model in (alone, whole))
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{body} {field}")
    whole_geoms, geoms = (
        sorted(
            (model.body(model.geom_bodyid[g]).name, *model.geom_pos[g], *model.geom_size[g])
            for g in range(model.ngeom)
            if model.body(model.geom_bodyid[g]).name in kept
        )
        for model in (whole, alone)
    )
    assert geoms == whole_geoms


def test_the_trimmed_model_keeps_masses_joints_and_inertias() -> None:
    task = TASKS["PnPInsertion"]
    full, trimmed = fetch_spec(task).compile(), fetch_scene(task).model
    assert trimmed.nbody < full.nbody
    assert trimmed.ngeom == full.ngeom
    for body in range(trimmed.nbody):
        name = trimmed.body(body).name
        for field in ("mass", "inertia", "ipos", "iquat"):
            ours, theirs = (getattr(m.body(name), field) for m in (trimmed, full))
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{name} {field}")
    np.testing.assert_array_equal(trimmed.dof_damping, full.dof_damping)
    np.testing.assert_array_equal(trimmed.jnt_range, full.jnt_range)
