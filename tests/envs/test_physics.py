"""The physics: parity with Gymnasium-Robotics, trimmed against full collision, the object alone."""

import importlib.util
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_follow_object.envs import TASKS, FetchEnv, ObjectEnv, Region, Task, object_only
from sb3_follow_object.envs.scene import fetch_scene, fetch_spec

AROUND_GRIPPER = Region("gripper", (-0.15, -0.15), (0.15, 0.15))
BLOCKED = Task("Blocked", AROUND_GRIPPER, AROUND_GRIPPER, blocked_gripper=True)


def original(env_id: str) -> gym.Env:
    robotics = pytest.importorskip("gymnasium_robotics")
    gym.register_envs(robotics)
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


USER_SCENE = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body name="shelf" pos="0 0.4 0.1"><geom name="shelf" type="box" size="0.1 0.1 0.1"/></body>
    <body name="hand" mocap="true" pos="0 0 1"/>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0"/>
      <geom name="arm" type="capsule" size="0.02 0.1"/>
    </body>
    <body name="mug" pos="0.1 0 0.05"><freejoint/><geom name="mug" size="0.05" mass="0.2"/></body>
    <body name="cup" pos="0.4 0 0.05"><freejoint/><geom name="cup" size="0.05" mass="0.2"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="arm"/></equality>
  <contact><exclude body1="arm" body2="mug"/></contact>
  <actuator><motor joint="hinge"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor>
</mujoco>
"""


def test_object_only_drops_the_robot_of_any_scene() -> None:
    spec = mujoco.MjSpec.from_string(USER_SCENE)
    model = object_only(spec, "mug").compile()
    bodies = {model.body(index).name for index in range(model.nbody)}
    assert bodies == {"world", "shelf", "mug", "cup", "mug:mocap"}
    assert (model.nu, model.nsensor, model.nexclude, model.neq) == (0, 0, 0, 1)
    data = mujoco.MjData(model)
    data.mocap_pos[0] = [0.1, 0.0, 0.3]
    mujoco.mj_step(model, data, nstep=500)
    np.testing.assert_allclose(data.body("mug").xpos, [0.1, 0.0, 0.3], atol=1e-3)
    assert spec.compile().nu == 1  # the scene that was given is as it was


@pytest.mark.parametrize(("name", "message"), [("jug", "no body 'jug'"), ("arm", "no free joint")])
def test_object_only_refuses_in_a_sentence(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        object_only(mujoco.MjSpec.from_string(USER_SCENE), name)


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
