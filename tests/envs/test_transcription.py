"""What moves without the robot moves in its own scene as it does in the whole one."""

from __future__ import annotations

import arm_and_wall
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scenes import kitchen, throw

from sb3_follow_object.any_task.physics_access import physics_of
from sb3_follow_object.any_task.scene import PULLER
from sb3_follow_object.envs.registration import import_task
from sb3_follow_object.envs.robot_parts import body_name, carrier, robot_bodies, standing
from sb3_follow_object.envs.scene import weld_to
from sb3_follow_object.envs.transcription import transcribe

TENTH_OF_MM = 1e-4
SECONDS = 0.6


def passive(
    model: mujoco.MjModel, data: mujoco.MjData, varying: frozenset[int] = frozenset()
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The object's own scene and a state of it with every kept joint where it is in the whole."""
    copied = transcribe(model, data, varying)
    alone = copied.spec.compile()
    state = mujoco.MjData(alone)
    for joint, name in copied.joints.items():
        state.joint(name).qpos = data.joint(joint).qpos
        state.joint(name).qvel = data.joint(joint).qvel
    return alone, state


@pytest.mark.parametrize("env_id", ["FetchPickAndPlace-v4", "FetchPush-v4", "FetchSlide-v4"])
def test_an_object_thrown_in_anothers_environment_moves_alike(env_id: str) -> None:
    import_task(env_id)
    env = gym.make(env_id)
    env.reset(seed=1)
    model, data = physics_of(env)
    alone, state = passive(model, data)
    thrown = np.array([0.2, 0.4, 1.0, 1.0, 2.0, 3.0])
    model.geom_contype[robot_bodies(model)[model.geom_bodyid]] = 0  # the arm is in the way
    model.geom_conaffinity[robot_bodies(model)[model.geom_bodyid]] = 0
    whole = throw(model, data, "object0:joint", thrown, SECONDS)
    path = throw(alone, state, "object0:joint", thrown, SECONDS)
    assert np.ptp(whole, axis=0).max() > 0.05, "it was thrown"
    assert np.linalg.norm(whole - path, axis=1).max() <= TENTH_OF_MM
    env.close()


def test_a_disc_moves_alike_until_rounding_is_magnified() -> None:
    """Contacts jump along a disc's rim: FetchSlide's goes millimetres elsewhere after a nudge."""
    import_task("FetchSlide-v4")
    env = gym.make("FetchSlide-v4")
    rng = np.random.default_rng(0)
    for seed in range(5):
        env.reset(seed=seed)
        model, data = physics_of(env)
        alone, state = passive(model, data)
        robot = robot_bodies(model)[model.geom_bodyid]
        model.geom_contype[robot] = model.geom_conaffinity[robot] = 0
        thrown = rng.uniform([-1.5, -1.5, 0.0, -6.0, -6.0, -6.0], [1.5, 1.5, 1.0, 6.0, 6.0, 6.0])
        whole = throw(model, data, "object0:joint", thrown, 0.2)
        path = throw(alone, state, "object0:joint", thrown, 0.2)
        assert np.abs(whole - path).max() <= 1e-6
    env.close()


def test_a_box_thrown_at_the_tutorials_wall_moves_alike() -> None:
    env = gym.make(arm_and_wall.ARM)
    env.reset(seed=2)
    model, data = physics_of(env)
    alone, state = passive(model, data)
    joint = int(model.body("box").jntadr[0])
    data.joint(joint).qpos[:2] = state.joint(0).qpos[:2] = 0.38, -0.1
    thrown = np.array([0.0, 1.5, 0.0, 0.0, 0.0, 1.0])
    data.joint(joint).qvel = state.joint(0).qvel = thrown
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_step(alone, state)
        assert np.linalg.norm(data.joint(joint).qpos[:3] - state.qpos[:3]) <= TENTH_OF_MM
    assert state.qpos[1] < -0.02, "the wall has stopped it"


@pytest.mark.parametrize(
    ("joint", "velocity"),
    [
        ("rail", np.array([0.8])),
        (3, np.array([-0.3, -0.6, 0.5, 2.0, 1.0, 0.0])),
    ],
    ids=["a drawer with a spring", "a root without mass"],
)
def test_passive_joints_of_every_kind_are_kept(joint: str | int, velocity: np.ndarray) -> None:
    model, data = kitchen()
    copied = transcribe(model, data)
    name = joint if isinstance(joint, str) else copied.joints[joint]
    alone, state = passive(model, data)
    if isinstance(joint, int):
        data.joint(joint).qvel = velocity
        state.joint(name).qvel = velocity
    else:
        data.joint(joint).qvel = state.joint(name).qvel = velocity
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_step(alone, state)
    for old, new in copied.joints.items():
        np.testing.assert_allclose(state.joint(new).qpos, data.joint(old).qpos, atol=TENTH_OF_MM)


EQUAL = '<equality><connect body1="post" body2="box" anchor="0 0 0"/></equality>'
BOX = """
<mujoco>
  <option density="1000" viscosity="0.1">{flag}</option>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <body name="post" pos="0 0 0.2"/>
    <body name="box" pos="0.1 0 0.2">
      <freejoint/>
      <geom type="box" size=".04 .02 .01" mass=".2"/>
      <geom type="box" size=".1 .02 .01" mass="0" contype="0" conaffinity="0" {fluid}/>
    </body>
  </worldbody>
  {equality}
</mujoco>
"""


@pytest.mark.parametrize(
    ("words", "off"),
    [
        ({"flag": '<flag equality="disable"/>', "equality": EQUAL}, False),
        ({"equality": EQUAL}, False),
        ({"equality": EQUAL}, True),
        ({"fluid": 'fluidshape="ellipsoid" fluidcoef="0.6 0.3 1.4 1.1 0.9"'}, False),
        ({}, False),
    ],
    ids=["equalities disabled", "on", "switched off", "in water", "in water, without a shape"],
)
def test_equalities_and_water_are_those_of_the_task(words: dict[str, str], off: bool) -> None:
    model = mujoco.MjModel.from_xml_string(
        BOX.format(**{"flag": "", "equality": "", "fluid": "", **words})
    )
    data = mujoco.MjData(model)
    if off:
        data.eq_active[0] = 0
    mujoco.mj_forward(model, data)
    alone, state = passive(model, data)
    thrown = np.array([0.2, 0.4, 1.0, 1.0, 2.0, 3.0])
    for each in (data, state):
        each.qvel[:] = thrown
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_step(alone, state)
        assert np.abs(data.qpos - state.qpos).max() <= TENTH_OF_MM


def test_a_robot_is_what_hangs_on_the_first_joint_that_is_driven() -> None:
    model, _ = kitchen()
    robot = {body_name(model, int(body)) for body in np.flatnonzero(robot_bodies(model))}
    assert robot == {"arm"}, "not the bench on its root, nor the drawer, nor a free mocap body"


def test_a_mocap_body_that_pulls_a_robot_goes_with_it() -> None:
    import_task("FetchPush-v4")
    env = gym.make("FetchPush-v4")
    model, _ = physics_of(env)
    kept = [body_name(model, int(b)) for b in np.flatnonzero(~robot_bodies(model))]
    assert kept == ["world", "floor0", "table0", "object0"]
    env.close()


def test_what_stands_elsewhere_in_each_episode_becomes_a_mocap_body() -> None:
    model, data = kitchen()
    shelf, bench = model.body("shelf").id, model.body("bench").id
    alone, state = passive(model, data, frozenset([shelf]))
    assert alone.body("shelf").mocapid[0] >= 0 > alone.body("bench").mocapid[0]
    np.testing.assert_allclose(alone.body("bench").pos, data.xpos[bench])
    top = "top"
    mocap = int(alone.body("shelf").mocapid[0])
    state.mocap_pos[mocap] = (0.45, 0.05, 0.23)  # under the mug
    mujoco.mj_forward(alone, state)
    touched = {tuple(sorted((c.geom1, c.geom2))) for c in state.contact[: state.ncon]}
    mug = int(alone.body("mug").geomadr[0])
    assert (int(alone.body("shelf").geomadr[0]), mug) in touched
    assert alone.geom(top).type == mujoco.mjtGeom.mjGEOM_BOX


def test_a_scene_is_copied_without_what_older_mujoco_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(mujoco.MjSpec, "body")  # 3.2.7 has none
    alone, _ = passive(*kitchen())
    handle = alone.body("handle").id
    assert alone.body(alone.body_parentid[handle]).name == "drawer"


@pytest.mark.parametrize("of_its_own", [False, True], ids=["before 4.0", "since 4.0"])
def test_a_mocap_body_stands_in_the_objects_scene_with_any_mujoco(of_its_own: bool) -> None:
    model, data = kitchen()
    puller = model.body("puller").id
    model.body_weldid[puller] = puller if of_its_own else 0
    assert standing(model)[puller] and carrier(model, puller) == 0
    alone, _ = passive(model, data)
    assert alone.body("puller").mocapid[0] >= 0


def test_a_weld_pulls_the_part_that_has_the_mass() -> None:
    model, data = kitchen()
    copied = transcribe(model, data)
    copied.spec.worldbody.add_body(name=PULLER, mocap=True)
    weld_to(copied.spec, PULLER, "load")
    alone = copied.spec.compile()
    state = mujoco.MjData(alone)
    mujoco.mj_forward(alone, state)
    load, puller = alone.body("load").id, int(alone.body(PULLER).mocapid[0])
    for _ in range(20):
        state.mocap_pos[puller] = state.xpos[load] + [0.0, 0.0, 0.05]
        state.mocap_quat[puller] = state.xquat[load]
        before = state.xpos[load][2]
        mujoco.mj_step(alone, state, 20)
    assert state.xpos[load][2] - before > 0.02, "it follows within a step of 0.04 s"


HILLS = """
<mujoco>
  <asset>
    <hfield name="hills" nrow="3" ncol="3" size="1 1 2 .1" elevation="0 .5 .2 1 0 .3 .1 .2 .4"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="hills" pos="0 0 .3" euler="0 20 0"/>
    <body name="ball" pos="0 0 2"><freejoint/><geom size=".05"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.1, 0.2), (0.3, 0.3), (0.0, 0.0)])
def test_heights_that_an_environment_has_written_are_kept(low: float, high: float) -> None:
    model = mujoco.MjModel.from_xml_string(HILLS)
    model.hfield_data[:] = low + (high - low) * model.hfield_data
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    alone, state = passive(model, data)
    mujoco.mj_forward(alone, state)
    hit = np.zeros(1, np.int32)
    for x, y in np.random.default_rng(0).uniform(-0.6, 0.6, (20, 2)):
        for start, way in ((3.0, -1.0), (-3.0, 1.0)):  # from above, and from below
            ray = np.array([x, y, start]), np.array([0.0, 0.0, way]), None, 1, -1, hit
            there, here = mujoco.mj_ray(model, data, *ray), mujoco.mj_ray(alone, state, *ray)
            assert there > 0.0 and here == pytest.approx(there, abs=1e-6)


TIED = """
<mujoco>
  <worldbody>
    <body name="arm" pos="0 0 2"><joint name="turn"/><geom size=".1"/><site name="tip"/></body>
    <body name="one" pos="0 0 1">
      <freejoint/><geom size=".1" mass="1"/><site name="right" pos=".2 0 0"/>
    </body>
    <body name="two" pos=".5 0 1">
      <joint name="slide" type="slide"/><geom size=".1" mass="1"/><site name="left" pos="-.2 0 0"/>
    </body>
    <body name="three" pos="1 0 1"><joint name="hinge"/><geom size=".1" pos=".1 0 0"/></body>
  </worldbody>
  THINGS
  <actuator><position joint="turn"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("kind", ["weld", "connect"])
def test_what_is_tied_by_sites_stays_tied(kind: str) -> None:
    tie = f'<equality><{kind} site1="right" site2="left"/><{kind} site1="tip" site2="left"/>'
    model = mujoco.MjModel.from_xml_string(TIED.replace("THINGS", f"{tie}</equality>"))
    model.eq_active0[1] = 0  # the robot lets go
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    alone, state = passive(model, data)
    assert alone.neq == 1
    for _ in range(100):
        mujoco.mj_step(model, data)
        mujoco.mj_step(alone, state)
    name = alone.joint(0).name
    np.testing.assert_allclose(state.joint(name).qpos, data.joint(1).qpos, atol=TENTH_OF_MM)
    assert abs(data.joint("slide").qpos[0]) > 1e-3, "it was pulled"


CORD = '<tendon><fixed name="cord" {}><joint joint="{}" coef="1"/><joint joint="hinge" coef="1"/>'
CORD += "</fixed></tendon>"


def test_a_tendon_between_passive_joints_is_refused() -> None:
    def tied(things: str) -> None:
        passive(*_begun(mujoco.MjModel.from_xml_string(TIED.replace("THINGS", things))))

    wire = '<tendon><spatial {}><site site="left"/><site site="{}"/></spatial></tendon>'
    for refused in (
        CORD.format('stiffness="1"', "slide"),
        CORD.format('damping="1"', "slide"),
        CORD.format('limited="true" range="0 1"', "slide"),
        CORD.format("", "slide") + '<equality><tendon tendon1="cord"/></equality>',
        wire.format('frictionloss="1"', "right"),
    ):
        with pytest.raises(
            ValueError, match=r"tendon \w+ pulls at \w+ and at nothing of the robot"
        ):
            tied(refused)
    tied(CORD.format("", "slide"))  # nothing but measured
    tied(CORD.format('stiffness="1"', "turn"))  # the robot's
    tied(wire.format('stiffness="1"', "tip"))


def _begun(model: mujoco.MjModel) -> tuple[mujoco.MjModel, mujoco.MjData]:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data
