"""N copies of an object alone, in a task that nobody here wrote, stepped together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.envs.registration import EnvSpec

from ..envs.batch import MAX_DISPLACEMENT
from ..envs.faces import BatchVecEnv
from ..envs.object_locomotion import ObjectSimulation
from ..envs.physics_engine import mujoco
from .context import located, place_numbers
from .scene import POINT, PULLER, DerivedScene
from .scene_picture import GOAL_RGBA, ScenePicture


class DerivedSimulation(ObjectSimulation):
    """As `ObjectSimulation`, of an object with any joints that starts where its task's does.

    Observations end with the context, where the task has one.
    """

    scene: DerivedScene  # type: ignore[assignment]

    def _find(self, model: mujoco.MjModel) -> None:
        self._mocap = int(model.body(PULLER).mocapid[0])
        self._welded = self.scene.welded
        self._object_site = int(model.site(POINT).id)
        body = int(model.site_bodyid[self._object_site])
        self._root = int(model.body_rootid[body])
        self._body = body
        self.observation_size = ObjectSimulation.observation_size + len(self.scene.context)

    def _take_memory(self) -> None:
        super()._take_memory()
        self._watch("spin_and_velocity", [d.cvel[self._body] for d in self.data])
        self._watch("centre", [d.subtree_com[self._root] for d in self.data])
        if self.scene.context:
            self._watch("positions", [d.xpos for d in self.data])
            self._watch("quaternions", [d.xquat for d in self.data])
            self._context = located(self.scene.context, self.scene.model)
        # The welded body's pose as the episode began: height and tilt that a surface keeps.
        self.read["first_pose"] = np.zeros((self.n_envs, 7))

    def _place(self, index: int, rng: np.random.Generator) -> np.ndarray:
        scene, data = self.scene, self.data[index]
        episode = int(rng.integers(len(scene.goals)))
        data.qpos[:], data.qvel[:] = scene.qpos[episode], scene.qvel[episode]
        data.mocap_pos[:] = scene.mocap[episode, :, :3]
        data.mocap_quat[:] = scene.mocap[episode, :, 3:]
        mujoco.mj_kinematics(scene.model, data)
        pose = np.concatenate([data.xpos[self._welded], data.xquat[self._welded]])
        data.mocap_pos[self._mocap], data.mocap_quat[self._mocap] = pose[:3], pose[3:]
        self.read["first_pose"][index] = pose
        return scene.goals[episode]

    def control(self, actions: np.ndarray) -> None:
        """Pull the object off its pose by 0.05 times the action."""
        self._target_pos[:] = self.read["welded_pos"] + actions[:, :3] * MAX_DISPLACEMENT
        self._target_quat[:] = self.read["welded_quat"] + actions[:, 3:] * MAX_DISPLACEMENT
        if self.on_table:
            self._keep_on_surface()
            first = self.read["first_pose"]
            self._target_pos[:, 2] = first[:, 2]
            self._target_quat[:] = turned_about_vertical(self._target_quat, first[:, 3:])

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """As `ObjectSimulation.observe`, with the context, (n_envs, 12 + c)."""
        observation, achieved = super().observe()
        if self.scene.context:
            bodies, numbers = self._context
            places = place_numbers(self.read["positions"], self.read["quaternions"])
            observation = np.concatenate([observation, places[:, bodies, numbers]], axis=1)
        return observation, achieved

    def _object_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocity of the object's point and its spin, world frame, per env step, (n_envs, 3)."""
        spin, velocity = np.split(self.read["spin_and_velocity"], 2, axis=1)
        arm = self.read["object_pos"] - self.read["centre"]
        return (velocity + np.cross(spin, arm)) * self.dt, spin * self.dt


class DerivedObjectVecEnv(BatchVecEnv):
    """N copies of a task's object alone as one SB3 VecEnv.

    Args:
        scene: of the object.
        n_envs: number of copies, at least 1.
        n_threads: threads that step them; None takes one a processor.
        seed: of the draws of episodes; None is random.
        on_table: whether the object keeps the height and tilt that it starts with, and keeps
            off the edge of what it lies on.

    Raises:
        ValueError: a number below 1.
    """

    simulation_type = DerivedSimulation
    simulation: DerivedSimulation

    def __init__(
        self,
        scene: DerivedScene,
        n_envs: int,
        n_threads: int | None = None,
        *,
        seed: int | None = None,
        on_table: bool = False,
    ) -> None:
        super().__init__(
            scene,  # type: ignore[arg-type]
            n_envs,
            n_threads,
            seed=seed,
            reward_type="sparse",
            render_mode=None,
            show_regions=False,
            max_episode_steps=None,
        )
        self.simulation.on_table = on_table

    @property
    def spec(self) -> EnvSpec:
        """Gymnasium's spec of each copy, which says how long its episodes are."""
        task = self.simulation.scene.task
        return EnvSpec(task.name, max_episode_steps=self.horizon)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture (480, 480, 3) of every copy, its goal in red."""
        picture = ScenePicture(self.model, self.simulation.scene.goals)
        try:
            pairs = zip(self.data, self.simulation.goals, strict=True)
            return [picture.draw(data, goal[None], GOAL_RGBA[None]) for data, goal in pairs]
        finally:
            picture.close()

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """As any VecEnv without a render mode.

        Raises:
            ValueError: a window is asked for.
        """
        if mode == "human":
            raise ValueError("an object's own scene has no window; get_images() draws it")
        return super().render(mode)


def turned_about_vertical(quaternions: np.ndarray, first: np.ndarray) -> np.ndarray:
    """What is left of turns (n, 4) off first poses (n, 4) once only turns about z are allowed."""
    conjugate = first * np.array([1.0, -1.0, -1.0, -1.0])
    turn = quaternion_product(quaternions, conjugate)
    turn[:, 1:3] = 0.0
    return quaternion_product(turn, first)


def quaternion_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Products of quaternions (n, 4), w first."""
    w, v = first[:, :1], first[:, 1:]
    w2, v2 = second[:, :1], second[:, 1:]
    real = w * w2 - np.sum(v * v2, axis=1, keepdims=True)
    return np.concatenate([real, w * v2 + w2 * v + np.cross(v, v2)], axis=1)
