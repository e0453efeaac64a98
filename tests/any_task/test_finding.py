"""The object is found by watching, and what cannot be followed is refused with a reason."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import arm_and_wall
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scenes import KITCHEN, fingers, kitchen

from sb3_follow_object.any_task import finding
from sb3_follow_object.any_task.finding import Observed, find_effector, find_object, observe
from sb3_follow_object.envs.registration import import_task


class Kitchen(gym.Env):
    """The kitchen with a goal for a point of one of its bodies; its things lie anew each time."""

    def __init__(self, body: str = "grip", offset: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
        self.model, self.data = kitchen()
        self.body, self.offset = body, np.array(offset)
        box = gym.spaces.Box(-np.inf, np.inf, (3,))
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = gym.spaces.Dict(dict.fromkeys(keys, box))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        for joint in (2, 3):  # the mug's and the empty root's
            place = self.data.joint(joint).qpos
            place[:2] += self.np_random.uniform(-0.05, 0.05, 2)
            place[3:] = self.np_random.normal(size=4)
            place[3:] /= np.linalg.norm(place[3:])
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 5)
        return self._observation(), -1.0, False, False, {}

    def _observation(self) -> dict[str, np.ndarray]:
        body = self.data.body(self.body)
        achieved = body.xpos + body.xmat.reshape(3, 3) @ self.offset
        tip = self.data.site("tip").xpos.copy()
        return {"observation": tip, "achieved_goal": achieved, "desired_goal": np.zeros(3)}


def _entries(seen: Observed) -> tuple[int, int, int] | None:
    found = find_effector(seen)
    return None if found is None else found.entries


@pytest.fixture(scope="module")
def arm() -> Iterator[Observed]:
    env = gym.make(arm_and_wall.ARM)
    yield observe(env)
    env.close()


def test_the_tutorials_box_is_found(arm: Observed) -> None:
    found = find_object(arm)
    assert (found.name, found.of_robot) == ("box", False)
    assert found.error < 1e-6 and np.abs(found.offset).max() < 1e-6
    effector = find_effector(arm)
    assert effector is not None and effector.entries == (0, 1, 2)
    assert effector.off < 0.003, "the stick's lower end, though it is lifted"


def test_a_point_off_a_body_is_mapped_to_the_body_with_the_joint() -> None:
    seen = observe(Kitchen("grip", (0.01, 0.02, 0.03)))
    found = find_object(seen)
    assert seen.model.body(found.body).name == "mug"
    np.testing.assert_allclose(found.offset, [0.01, 0.05, 0.04], atol=1e-9)


def test_a_drawers_handle_is_followed_like_an_object() -> None:
    env = Kitchen("handle")
    seen = observe(env)
    assert seen.model.body(find_object(seen).body).name == "drawer", "though nothing touched it"
    assert find_object(seen, "handle").body == find_object(seen).body


class FromJoints(arm_and_wall.ArmAndWall):  # type: ignore[name-defined, misc]
    """Reads where the box is from its joint, which is a step ahead of MuJoCo's bodies."""

    def _observation(self) -> dict[str, np.ndarray]:
        told = super()._observation()
        return {**told, "achieved_goal": self.data.qpos[3:6].astype(np.float32)}


def test_a_goal_that_is_read_from_joints_is_the_bodys_too() -> None:
    found = find_object(observe(FromJoints()))
    assert found.name == "box" and found.error < 1e-6


def test_the_effector_is_a_point_of_the_robot_in_the_observation() -> None:
    assert _entries(observe(Kitchen())) == (0, 1, 2)


class Grip(Kitchen):
    """A hand over a box that tells its own place, the box's, and where its fingers meet."""

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__("box")
        self.model, self.data = fingers()
        self.scale = scale
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:2] = self.np_random.uniform(-0.1, 0.1, 2)
        self.data.joint(4).qpos[:2] = self.np_random.uniform(-0.1, 0.1, 2)
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}

    def _observation(self) -> dict[str, np.ndarray]:
        box, hand = self.data.body("box").xpos.copy(), self.data.body("hand").xpos
        told = self.scale * np.concatenate([hand, box, self.data.site("grip").xpos])
        return {"observation": told, "achieved_goal": box, "desired_goal": np.zeros(3)}


def test_of_several_points_of_the_robot_the_one_between_its_fingertips_is_the_effector() -> None:
    seen = observe(Grip())
    found = find_effector(seen)
    assert found is not None and found.entries == (6, 7, 8)
    assert found.off < 0.03, "the fingers move apart, and end 10 mm below"
    hand = find_effector(seen, (0, 1, 2))  # as an environment may say
    assert hand is not None and hand.off == pytest.approx(0.07, abs=0.01)


def test_an_observation_that_is_scaled_holds_no_effector() -> None:
    assert find_effector(observe(Grip(scale=10.0))) is None


@pytest.mark.parametrize(
    ("body", "wanted", "sentence"),
    [
        ("arm", None, r"a point of the robot itself \(arm\): there is no object to follow"),
        ("bench", None, "no body moves with the achieved goal .*is off by"),
        (
            "grip",
            "load",
            "does not move with 'load': it is off by .* the nearest body is mug",
        ),
        ("grip", "arm", "'arm' is a part of the robot"),
        ("grip", "shelf", "'shelf' has no joint"),
        ("grip", "cup", "no body 'cup'; those that can move are .*mug"),
    ],
)
def test_what_is_no_object_is_refused(body: str, wanted: str | None, sentence: str) -> None:
    seen = observe(Kitchen(body, (0.1, 0.1, 0.1)))
    with pytest.raises(ValueError, match=sentence):
        find_object(seen, wanted)


def test_bodies_that_move_alike_are_told_apart_by_their_name() -> None:
    env = Kitchen("mug")
    seen = observe(env)
    twin = seen.model.body("empty root").id
    seen.positions[:, twin] = seen.positions[:, seen.model.body("mug").id]
    seen.rotations[:, twin] = seen.rotations[:, seen.model.body("mug").id]
    with pytest.raises(ValueError, match=r"several bodies move with .*: mug, empty root; name one"):
        find_object(seen)
    assert find_object(seen, "empty root").name == "empty root"


def test_a_bodys_name_comes_before_a_sites() -> None:
    env = Kitchen("mug")
    spec = mujoco.MjSpec.from_string(KITCHEN)
    next(body for body in spec.bodies if body.name == "load").add_site(name="mug")
    env.model = spec.compile()
    env.data = mujoco.MjData(env.model)
    assert find_object(observe(env), "mug").error < 1e-6


HALFWAY = """
<mujoco>
  <worldbody>
    <body name="drawer"><joint name="rail" type="slide" range="-1 1" limited="true"/>
      <geom size=".1"/></body>
    <body name="ball" pos="1 0 0"><joint name="ball" type="ball"/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""


def test_what_rests_halfway_or_on_a_ball_is_moved_too() -> None:
    model = mujoco.MjModel.from_xml_string(HALFWAY)
    data = mujoco.MjData(model)
    finding._nudge(model, data, model.body("drawer").id)
    assert abs(data.joint("rail").qpos[0]) == pytest.approx(0.5)
    finding._nudge(model, data, model.body("drawer").id)
    assert abs(data.joint("rail").qpos[0]) == pytest.approx(0.5), "now at the other end"
    finding._nudge(model, data, model.body("ball").id)
    assert data.joint("ball").qpos[0] < 0.98
    assert np.linalg.norm(data.joint("ball").qpos) == pytest.approx(1.0)


def test_a_gripper_that_is_the_goal_is_refused() -> None:
    import_task("FetchReach-v4")
    env = gym.make("FetchReach-v4")
    with pytest.raises(ValueError, match="train it with --method her"):
        find_object(observe(env))
    env.close()
