"""Tasks whose objects cannot be followed are refused in one sentence."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from scenes import KITCHEN
from test_derived import Tidy

from sb3_follow_object.any_task.derived import derived
from sb3_follow_object.any_task.tasks import effector_seen_in
from sb3_follow_object.settings.presets import run_config

pytestmark = pytest.mark.usefixtures("few_resets")


class Massless(Tidy):
    def __init__(self) -> None:
        super().__init__()
        mug = self.model.body("mug")
        grip = self.model.body("grip")
        self.model.body_mass[[mug.id, grip.id]] = 0.0


class Dense(Tidy):
    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return -np.linalg.norm(achieved - desired, axis=-1)


class Saturating(Tidy):
    """Pays a distance that is -1 where it is far."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return -np.tanh(10.0 * np.linalg.norm(achieved - desired, axis=-1))


class PaysForActions(Tidy):
    """Its steps pay more than its `compute_reward` knows of."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward - 0.25, terminated, truncated, info


class NoJudge(Tidy):
    compute_reward = is_success = None  # type: ignore[assignment]

    def step(self, action: np.ndarray) -> Any:
        return self._observation(), 0.0, False, False, {}


class Posed(Tidy):
    def __init__(self) -> None:
        super().__init__()
        pose = gym.spaces.Box(-np.inf, np.inf, (7,))
        spaces = dict(self.observation_space.spaces)  # type: ignore[attr-defined]
        self.observation_space = gym.spaces.Dict(
            {**spaces, "achieved_goal": pose, "desired_goal": pose}
        )


class NoPhysics(Tidy):
    def __init__(self) -> None:
        super().__init__()
        self.physics = [self.model, self.data]  # where nobody looks

    def __getattr__(self, name: str) -> Any:
        if name in ("model", "data"):
            return self.physics[name == "data"]
        raise AttributeError(name)

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if name == "physics":
            del self.__dict__["model"], self.__dict__["data"]


class EndsThere(Tidy):
    """Ends its episodes at the goal."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, info["is_success"], truncated, info


class EndsOpen(EndsThere):
    """A drawer is to be opened; the episode ends once it is."""

    def __init__(self) -> None:
        super().__init__()
        self.body = "handle"

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        handle, rail = self.data.body("handle").xpos, self.data.joint("rail").xaxis
        self.goal = handle + rail * self.np_random.uniform(0.05, 0.09)
        return self._observation(), {}


class MovedGeom(Tidy):
    """Its shelf is moved as a geom, not as a body."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        found = super().reset(seed=seed)
        shelf = self.model.body("shelf").geomadr[0]
        self.model.geom_pos[shelf, 0] = self.np_random.uniform(-0.1, 0.1)
        return found


class Rebuilt(Tidy):
    """Has one body more in every other episode."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        spec = mujoco.MjSpec.from_string(KITCHEN)
        if seed and seed % 2:
            spec.worldbody.add_body(name="guest")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        return super().reset(seed=seed)


class Buttons(Tidy):
    """Is played with buttons."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Discrete(3)  # type: ignore[assignment]


def beside_a_finger(bodies: str, gravity: float = -9.81) -> str:
    """A scene of these bodies and a finger that turns where it touches nothing."""
    return f"""
<mujoco>
  <option gravity="0 0 {gravity}"/>
  <worldbody>
    <body name="finger" pos="0 0 0.6">
      <joint name="turn" axis="0 0 1"/><geom size="0.02" mass="0.1"/><site name="tip"/>
    </body>
    {bodies}
  </worldbody>
  <actuator><position joint="turn"/></actuator>
</mujoco>
"""


PUCK = beside_a_finger("""
    <body name="puck">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <geom size="0.02" mass="0.1"/>
    </body>
""")


class EndsOnSlides(EndsThere):
    """A puck on two slides; its goals are both ways off."""

    def __init__(self) -> None:
        super().__init__()
        self.model = mujoco.MjModel.from_xml_string(PUCK)
        self.data, self.body = mujoco.MjData(self.model), "puck"

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.goal = np.append(self.np_random.uniform(0.1, 0.3, 2), 0.0)
        return self._observation(), {}


PARTED = beside_a_finger("""
    <body name="sledge">
      <joint name="x" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.1"/>
      <body name="puck" pos="0 0 0.1">
        <joint name="y" type="slide" axis="0 1 0"/><geom size="0.02" mass="0.1"/>
      </body>
    </body>
""")
BALLS = beside_a_finger(
    """
    <body name="pole">
      <joint name="ball" type="ball"/><geom size="0.02" pos="0.2 0 0" mass="0.1"/>
    </body>
""",
    gravity=0.0,
)


class EndsOnParents(EndsOnSlides):
    """A puck on one slide, the other being its parent's."""

    def __init__(self) -> None:
        super().__init__()
        self.model = mujoco.MjModel.from_xml_string(PARTED)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.goal[2] = 0.1
        return self._observation(), {}


class EndsTruncated(EndsOnSlides):
    """Says of the goal that the time is over."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward, False, terminated, info


class EndsOnBall(EndsOnSlides):
    """The end of a pole on a ball joint."""

    def __init__(self) -> None:
        super().__init__()
        self.model = mujoco.MjModel.from_xml_string(BALLS)
        self.data, self.body = mujoco.MjData(self.model), "pole"
        self.offset = np.array([0.2, 0.0, 0.0])

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        way = self.np_random.uniform([-1.0, 0.5, 0.5], 1.0)
        self.goal = 0.2 * way / np.linalg.norm(way)
        return self._observation(), {}


class PlacedPuck(EndsOnSlides):
    """The puck begins where its body is moved to."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, _, _, info = super().step(action)
        return obs, reward, False, False, info

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.model.body("puck").pos[:2] = self.np_random.uniform(-0.1, 0.1, 2)
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}


class MovedSlide(PlacedPuck):
    """The puck begins where the zero of its slide is moved to."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        EndsOnSlides.reset(self, seed=seed)
        self.model.qpos0[self.model.joint("x").qposadr[0]] = self.np_random.uniform(-0.1, 0.1)
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}


class MovedDrawer(Tidy):
    """The drawer, which is not the object, is moved by its body."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.model.body("drawer").pos[0] = self.np_random.uniform(-0.1, 0.1)
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), {}


class SwitchedOff(Tidy):
    """Its shelf can be touched in half of the episodes."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        shelf = self.model.body("shelf").geomadr[0]
        on = 0 if seed is None else seed % 2
        self.model.geom_contype[shelf] = self.model.geom_conaffinity[shelf] = on
        return super().reset(seed=seed)


class Reshaped(Tidy):
    """Its shelf is a ball in half of the episodes."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        kinds = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
        shelf = self.model.body("shelf").geomadr[0]
        self.model.geom_type[shelf] = kinds[(seed or 0) % 2]
        return super().reset(seed=seed)


HILLS = KITCHEN.replace(
    "<asset>", '<asset><hfield name="hills" nrow="2" ncol="2" size="1 1 .1 .1"/>'
).replace(
    "<worldbody>", '<worldbody><geom name="hills" type="hfield" hfield="hills" pos="0 0 -1"/>', 1
)


class Hilly(Tidy):
    """Its ground has other hills in each episode."""

    def __init__(self) -> None:
        super().__init__()
        self.model = mujoco.MjModel.from_xml_string(HILLS)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        found = super().reset(seed=seed)
        self.model.hfield_data[:] = self.np_random.uniform(0.0, 1.0, 4)
        return found


GATE = '<body name="gate" mocap="true" pos="1 1 1"><geom type="box" size=".1 .1 .1"/></body>'


class Gated(Tidy):
    """A gate moves up and down."""

    def __init__(self) -> None:
        super().__init__()
        spec = KITCHEN.replace("</worldbody>", f"{GATE}</worldbody>")
        self.model = mujoco.MjModel.from_xml_string(spec)
        self.data = mujoco.MjData(self.model)

    def step(self, action: np.ndarray) -> Any:
        self.data.mocap_pos[1, 2] = 1.0 + 0.1 * np.sin(self.data.time)
        return super().step(action)


class Raises(Tidy):
    """Looks up what it does not know once the drawer is open."""

    def step(self, action: np.ndarray) -> Any:
        if self.data.joint("rail").qpos[0] > 0.05:
            raise KeyError("open")
        return super().step(action)


KINDS = (
    Massless,
    Dense,
    Saturating,
    PaysForActions,
    NoJudge,
    Posed,
    NoPhysics,
    EndsThere,
    EndsOpen,
    MovedGeom,
    Rebuilt,
    Buttons,
    EndsOnSlides,
    EndsOnParents,
    EndsTruncated,
    EndsOnBall,
    PlacedPuck,
    MovedSlide,
    MovedDrawer,
    SwitchedOff,
    Reshaped,
    Hilly,
    Gated,
    Raises,
)
for kind in KINDS:
    gym.register(f"{kind.__name__}-v0", kind, max_episode_steps=40, disable_env_checker=True)
gym.register("Timeless-v0", Tidy, disable_env_checker=True)


@pytest.mark.parametrize(
    ("env_id", "sentence"),
    [
        ("Massless-v0", "'Massless-v0': the object 'mug' has no mass, so nothing can pull it"),
        ("Dense-v0", "'Dense-v0': it pays 0 on the goal and -0.001 at 0.001 m from it; the rewa"),
        ("Saturating-v0", "pays 0 on the goal and -0.009.* at 0.001 m from it; the rewards must"),
        (
            "PaysForActions-v0",
            "a step pays -0.25 where compute_reward says 0 of the same goals, and hindsight mixes",
        ),
        ("NoJudge-v0", "^'NoJudge-v0' does not tell when a goal is reached, by compute_reward or"),
        (
            "Posed-v0",
            r"'Posed-v0': the environment's goals have the shape \(7,\); .* positions",
        ),
        ("EndsThere-v0", "'EndsThere-v0': an episode with the object on its goal ended after 1 of"),
        ("EndsOpen-v0", "'EndsOpen-v0': an episode with the object on its goal ended after 1 of"),
        ("EndsOnSlides-v0", "'EndsOnSlides-v0': an episode with the object on its goal ended"),
        ("EndsOnParents-v0", "'EndsOnParents-v0': an episode with the object on its goal ended"),
        ("EndsTruncated-v0", "'EndsTruncated-v0': an episode with the object on its goal ended"),
        ("EndsOnBall-v0", "'EndsOnBall-v0': an episode with the object on its goal ended"),
        ("PlacedPuck-v0", "body puck, which joints move, hangs elsewhere in other episodes, .*"),
        ("MovedSlide-v0", "joint x of body puck has another reference in other episodes, which"),
        ("MovedDrawer-v0", "body drawer, which joints move, hangs elsewhere in other episodes"),
        ("SwitchedOff-v0", r"geom \d+ of body shelf has another contype in other episodes"),
        ("Reshaped-v0", r"geom \d+ of body shelf has another type in other episodes"),
        ("Hilly-v0", "geom hills of body world has another height field in other episodes"),
        ("Gated-v0", "body gate moves within an episode without a joint, which the object's"),
        ("Raises-v0", "'Raises-v0' raised KeyError: 'open' while it was reset and stepped and"),
        (
            "MovedGeom-v0",
            r"'MovedGeom-v0': geom \d+ of body shelf has another place in other .* give it a body",
        ),
        ("Rebuilt-v0", "'Rebuilt-v0': its model has other bodies, geoms or joints in other epis"),
        ("Buttons-v0", r"'Buttons-v0': its actions are Discrete\(3\); the robot is trained with"),
        ("NoPhysics-v0", "'NoPhysics-v0': NoPhysics holds no MuJoCo simulation"),
        ("Timeless-v0", "'Timeless-v0': it does not say how long its episodes are; register it"),
        ("CartPole-v1", "'CartPole-v1': it has neither goals nor a MuJoCo simulation"),
        ("Nowhere-v0", "there is no environment 'Nowhere-v0'"),
    ],
)
def test_what_cannot_be_followed_is_refused_in_one_sentence(env_id: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence) as caught:
        derived(env_id)
    assert "\n" not in str(caught.value)


def test_an_error_is_told_in_one_sentence_where_only_the_effector_is_looked_for() -> None:
    with pytest.raises(ValueError, match="'Raises-v0' raised KeyError: 'open' while it was reset"):
        effector_seen_in("Raises-v0")


def test_a_rival_where_nothing_can_be_followed_has_the_settings_of_any_task() -> None:
    run = run_config("NoPhysics-v0", method="rher")
    assert run.settings["algorithm"]["replay_buffer_kwargs"]["moved_distance"] == 0.05
