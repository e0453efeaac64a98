"""What moves an object in its task and not in its own scene is refused, in one sentence."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scenes import KITCHEN
from test_derived import Tidy

from sb3_follow_object.any_task.derived import derived

pytestmark = pytest.mark.usefixtures("few_resets")


class OtherRange(Tidy):
    """Its drawer comes out by another length in each episode."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        found = super().reset(seed=seed)
        self.model.joint("rail").range[1] = self.np_random.uniform(0.05, 0.1)
        return found


class OtherAxis(Tidy):
    """Its drawer comes out another way in each episode."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        found = super().reset(seed=seed)
        way = self.np_random.uniform(-0.5, 0.5)
        self.model.joint("rail").axis[:] = np.sin(way), -np.cos(way), 0.0
        return found


class OtherMesh(Tidy):
    """Its mug is larger or smaller in each episode."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.model.mesh_vert[:] = self.vertices * self.np_random.uniform(0.8, 1.2)
        return super().reset(seed=seed)

    def __init__(self) -> None:
        super().__init__()
        self.vertices = self.model.mesh_vert.copy()


def with_equality(equality: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        KITCHEN.replace("<actuator>", f"<equality>{equality}</equality><actuator>")
    )


class Tied(Tidy):
    """Has one more equality, and says at each reset whether it is on."""

    equality = '<weld body1="puller" body2="mug" active="false"/>'

    def __init__(self) -> None:
        super().__init__()
        self.model = with_equality(self.equality)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        found = super().reset(seed=seed)
        self.data.eq_active[0] = self.is_on(seed or 0)
        return found

    def is_on(self, seed: int) -> bool:
        return False


class Latched(Tied):
    """Its drawer is latched in every other episode."""

    equality = '<weld name="latch" body1="cabinet" body2="drawer"/>'

    def is_on(self, seed: int) -> bool:
        return seed % 2 == 1


class Held(Tied):
    """A mocap body pulls the mug, but not before a reset says so."""

    def is_on(self, seed: int) -> bool:
        return True


class Released(Tied):
    """A mocap body pulls the mug, until a reset says that it does not."""

    equality = '<weld body1="puller" body2="mug"/>'


class Driven(Tidy):
    """Its drawer is put where the environment wants it."""

    def step(self, action: np.ndarray) -> Any:
        self.data.joint("rail").qpos = 0.08
        return super().step(action)


class Blown(Tidy):
    """A wind blows at its mug."""

    def step(self, action: np.ndarray) -> Any:
        self.data.xfrc_applied[self.model.body("mug").id, 0] = 0.1
        return super().step(action)


class MovingGoal(Tidy):
    """Its goal goes on as the robot does."""

    def step(self, action: np.ndarray) -> Any:
        self.goal = self.goal + np.array([0.0, 0.001, 0.0])
        return super().step(action)


class Above(Tidy):
    """Its goals are for what is above the mug, however the mug lies."""

    def _observation(self) -> dict[str, np.ndarray]:
        above = self.data.body("mug").xpos + np.array([0.0, 0.0, 0.1])
        return {**super()._observation(), "achieved_goal": above}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.data.joint(2).qpos[3:] = 1.0, 0.0, 0.0, 0.0
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}


class EndsAfterFive(Tidy):
    """Ends once its goal has been held for five steps."""

    held = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.held = 0
        return super().reset(seed=seed)

    def step(self, action: np.ndarray) -> Any:
        obs, reward, _, truncated, info = super().step(action)
        self.held = self.held + 1 if info["is_success"] else 0
        return obs, reward, self.held == 5, truncated, info


class EndsAway(Tidy):
    """Ends where the arm has turned too far."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, bool(abs(self.data.joint("turn").qpos[0]) > 0.02), truncated, info


class Unconstrained(Tidy):
    """Nothing touches anything."""

    def __init__(self) -> None:
        super().__init__()
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)


class Mistaken(Tidy):
    """Says once that its mug is elsewhere than it is."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        obs, info = super().reset(seed=seed)
        achieved = obs["achieved_goal"] + 0.05 * (seed == 30)
        return {**obs, "achieved_goal": achieved}, info


SENTENCES = {
    Mistaken: r"an episode of the object's own scene begins 87 mm off the task's \(seed 30\)",
    OtherRange: "joint rail of body drawer has another range in other episodes",
    OtherAxis: "joint rail of body drawer has another axis in other episodes",
    OtherMesh: "geom .* of body mug has another mesh in other episodes",
    Latched: "an equality of cabinet and drawer is another in other episodes, or off in some",
    Held: 'resets switch the equality that lets puller pull mug on, .* active="true" in the model',
    Released: 'resets switch the equality .* pull mug off, .* active="false" in the model',
    Driven: r"body drawer is moved by the environment, not by its physics alone \(\d+ mm off after",
    Blown: "a force is applied to body mug, which the object's scene cannot have",
    MovingGoal: r"the goal moves within an episode, from \[.*\] to \[.*\]; an imagined goal",
    Above: "no body moves with the achieved goal",
    EndsAfterFive: "an episode with the object on its goal ended after 5 of 40 steps; imagined",
    EndsAway: r"an episode of random actions ended after \d+ of 40 steps; imagined goals need",
    Unconstrained: "the scene's options disable constraints, and with them contacts",
}
for kind in SENTENCES:
    gym.register(f"{kind.__name__}-v0", kind, max_episode_steps=40, disable_env_checker=True)


@pytest.mark.parametrize("kind", SENTENCES, ids=lambda kind: kind.__name__)
def test_what_the_objects_scene_would_lack_is_refused(kind: type[Tidy]) -> None:
    env_id = f"{kind.__name__}-v0"
    with pytest.raises(ValueError, match=f"'{env_id}': .*{SENTENCES[kind]}") as caught:
        derived(env_id)
    assert "\n" not in str(caught.value)


MARKER = '''
    <body name="marker" pos="0.5 0 0.5"><freejoint/>
      <geom size="0.01" mass="0.01" contype="0" conaffinity="0"/>
    </body>
    <body name="puller"'''


class Stroking(Tidy):
    """Has a marker at its goal, a goal that rounds, and an arm that strokes there and back."""

    def __init__(self) -> None:
        super().__init__()
        scene = KITCHEN.replace('<body name="puller"', MARKER)
        tie = '<equality><joint joint1="turn" polycoef="0.1 0 0 0 0"/></equality><actuator>'
        self.model = mujoco.MjModel.from_xml_string(scene.replace("<actuator>", tie))
        self.data = mujoco.MjData(self.model)
        arm = self.model.body("arm").geomadr[0]
        self.model.geom_pos[arm] = 0.2, 0.1, 0.05  # where it comes by the mug
        goal = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        spaces = dict(self.observation_space.spaces)  # type: ignore[attr-defined]
        self.observation_space = gym.spaces.Dict({**spaces, "desired_goal": goal})

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        found = super().reset(seed=seed)
        self.data.eq_active[0] = 0 if seed is None else seed % 2
        return found

    def step(self, action: np.ndarray) -> Any:
        for sign in (8.0, -8.0, 0.0):
            self.data.ctrl[:] = sign
            mujoco.mj_step(self.model, self.data, 10)
        self.data.joint(int(self.model.body("marker").jntadr[0])).qpos[:3] = self.goal
        obs, *others = super().step(np.zeros(1))
        return {**obs, "desired_goal": obs["desired_goal"] * (1.0 + 1e-15)}, *others


class Sucking(Tied):
    """A mocap body may pull the mug, and does not yet."""


class Dragged(Tidy):
    """What holds the mug back is not the same for all of its ways and turns."""

    DAMPING = (0.1, 0.2, 0.3, 0.01, 0.02, 0.03)

    def __init__(self) -> None:
        super().__init__()
        (first,) = self.model.body("mug").dofadr
        self.model.dof_damping[first : first + 6] = self.DAMPING


for kind in (Sucking, Dragged, Stroking):
    gym.register(f"{kind.__name__}-v0", kind, max_episode_steps=40, disable_env_checker=True)


def test_what_makes_no_difference_to_the_object_is_not_refused() -> None:
    found = derived("Stroking-v0")
    assert found.object.name == "mug" and found.robot == ("arm",)


def test_what_a_mocap_body_does_not_pull_yet_is_no_robot() -> None:
    found = derived("Sucking-v0")
    assert found.object.name == "mug"
    assert found.robot == ("arm", "puller")


def test_each_way_and_turn_of_a_joint_has_its_own_damping() -> None:
    alone = derived("Dragged-v0").scene.model
    (first,) = alone.body("mug").dofadr
    np.testing.assert_array_equal(alone.dof_damping[first : first + 6], Dragged.DAMPING)
