"""The robot's tasks have mirror images: mirrored actions have mirrored outcomes, measured."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sb3_follow_object.common.mirrors import Mirror
from sb3_follow_object.envs import TASKS, FetchEnv
from sb3_follow_object.envs.symmetry import fetch_mirrors

PAIRS = [(name, mirror) for name, task in TASKS.items() for mirror in fetch_mirrors(task)]
N_STEPS = 3
TUBE = np.array([1.3, 0.85, 0.4])  # where one stands, if there is one
AT_REST = np.zeros(3), np.zeros(3)
UPRIGHT = np.eye(3)


class Start:
    """Where the gripper is, and where a cube is and how it moves: linear and angular velocity."""

    def __init__(
        self,
        gripper: np.ndarray,
        cube: np.ndarray,
        turn: np.ndarray = UPRIGHT,
        velocities: tuple[np.ndarray, np.ndarray] = AT_REST,
        tube: np.ndarray = TUBE,
    ) -> None:
        self.gripper, self.cube, self.tube = gripper, cube, tube
        self.turn, self.velocities = turn, velocities

    def image(self, mirror: Mirror) -> Start:
        """The same on the other side."""
        m = np.diag(np.where(np.arange(3) == mirror.axis, -1.0, 1.0))
        gripper, cube, tube = (mirror.goal(each) for each in (self.gripper, self.cube, self.tube))
        linear, angular = self.velocities
        return Start(gripper, cube, m @ self.turn @ m, (m @ linear, -m @ angular), tube)


def play(env: FetchEnv, start: Start, actions: np.ndarray) -> np.ndarray:
    """Observations (N_STEPS, 25) of what follows from a start."""
    env.reset(seed=0)
    grip, opened = env.simulation.read["grip_pos"][0], np.array([1.0])
    for _ in range(40):
        way = np.clip((start.gripper - grip) / 0.05, -1.0, 1.0)
        env.step(np.append(way, opened).astype(np.float32))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, start.turn.ravel())
    joint = env.model.joint("object0:joint")
    linear, angular = start.velocities
    env.data.qpos[joint.qposadr[0] : joint.qposadr[0] + 7] = *start.cube, *quaternion
    env.data.qvel[joint.dofadr[0] : joint.dofadr[0] + 6] = *linear, *(start.turn.T @ angular)
    if env.simulation.scene.task.tube:
        env.data.mocap_pos[env.model.body("tube").mocapid[0]] = start.tube
    mujoco.mj_forward(env.model, env.data)
    env.simulation.refresh(0)
    return np.stack([env.step(action)[0]["observation"] for action in actions])


def pushes(env: FetchEnv, mirror: Mirror, n: int) -> tuple[np.ndarray, np.ndarray]:
    """What the robot does to a cube, and what it does on the other side, (n, N_STEPS, 25) each."""
    rng, seen = np.random.default_rng(0), []
    for trial in range(n):
        cube = np.append(rng.uniform([1.25, 0.62], [1.4, 0.66]), 0.425)
        aside = np.array([-0.07, 0.0, 0.01]) if trial % 2 else np.array([0.0, -0.07, 0.01])
        actions = rng.uniform(-1.0, 1.0, (N_STEPS, 4)).astype(np.float32)
        actions[:, :3] = 0.5 * actions[:, :3] - np.sign(aside) * [1.0, 1.0, 0.0]
        actions = actions.clip(-1.0, 1.0)
        start = Start(cube + aside, cube)
        there = play(env, start.image(mirror), mirror.action(actions))
        seen.append((play(env, start, actions), there))
    here, there = map(np.stack, zip(*seen, strict=True))
    return here, there


def flights(env: FetchEnv, mirror: Mirror, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The same of a cube that is thrown, turning, while the gripper stays where it is."""
    rng, seen = np.random.default_rng(0), []
    for _ in range(n):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.linalg.det(turn)
        velocities = 0.3 * rng.normal(size=3), 2.0 * rng.normal(size=3)
        start = Start(
            np.array([1.34, 0.9, 0.6]), np.array([1.15, 0.55, 0.9]), turn, velocities, TUBE
        )
        still = np.zeros((N_STEPS, 4), np.float32)
        seen.append((play(env, start, still), play(env, start.image(mirror), still)))
    here, there = map(np.stack, zip(*seen, strict=True))
    return here, there


@pytest.mark.parametrize(("name", "mirror"), PAIRS, ids=lambda value: getattr(value, "axis", value))
def test_mirrored_actions_have_mirrored_outcomes(name: str, mirror: Mirror) -> None:
    here, there = pushes(FetchEnv(name), mirror, 6)
    off = np.median(np.abs(mirror.observation(there) - here), axis=0)
    assert np.median(np.linalg.norm(here[:, -1, 3:6] - here[:, 0, 3:6], axis=1)) > 0.02
    assert off[:, :3].max() < 0.001 and off[:, 3:6].max() < 0.003


@pytest.mark.parametrize(("name", "mirror"), PAIRS, ids=lambda value: getattr(value, "axis", value))
def test_obstacles_stand_as_their_mirror_images_do(name: str, mirror: Mirror) -> None:
    env = FetchEnv(name)
    env.reset(seed=0)
    body = [env.model.body(env.model.geom_bodyid[geom]).name for geom in range(env.model.ngeom)]
    own = [i for i in range(env.model.ngeom) if env.model.geom(i).name.startswith("obstacle")]
    assert len(own) == len(TASKS[name].obstacles), body
    places = env.data.geom_xpos[own].round(6)
    images = np.array([mirror.goal(place) for place in places]).round(6).reshape(-1, 3)
    np.testing.assert_array_equal(sorted(images.tolist()), sorted(places.tolist()))


@pytest.mark.parametrize("mirror", fetch_mirrors(TASKS["PnPSimpleV1"]), ids=["x", "y"])
def test_every_entry_is_mirrored_as_it_should_be(mirror: Mirror) -> None:
    env = FetchEnv("PnPSimpleV1")
    order, sign, shift = mirror.table(25)
    turning = np.isin(np.arange(25), [11, 12, 13, 17, 18, 19])  # what pushes hardly do
    for (here, there), entries in (
        (pushes(env, mirror, 10), ~turning),
        (flights(env, mirror, 10), turning),
    ):

        def off(image: np.ndarray) -> np.ndarray:
            return np.abs(image - here).mean(axis=(0, 1))[entries]  # noqa: B023

        as_told = off(mirror.observation(there))
        # What would be if an entry's sign were the other; if no entries changed places.
        flipped = off(np.where(shift == 0.0, -sign * there[..., order], there))
        np.testing.assert_array_less(2.0 * as_told, flipped)
        swapped = np.flatnonzero(order[entries] != np.arange(25)[entries])
        unswapped = off(there * sign + shift)
        np.testing.assert_array_less(2.0 * as_told[swapped], unswapped[swapped])
