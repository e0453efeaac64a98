"""The object alone, moved by a mocap body it is welded to (section 4.1 of the paper)."""

from __future__ import annotations

import numpy as np

from .batch import MAX_DISPLACEMENT, BatchedSimulation, euler_angles
from .faces import BatchVecEnv, RewardType, SingleEnv
from .scene import object_scene
from .task_table import find_task, task_of
from .tasks import Task


class ObjectSimulation(BatchedSimulation):
    """Actions move the mocap body off the object's pose: 3 for position, 4 for its quaternion."""

    action_size = 7
    observation_size = 12
    on_table = False

    def control(self, actions: np.ndarray) -> None:
        """Pull the object off its pose by 0.05 times the action."""
        self._target_pos[:] = self.read["welded_pos"] + actions[:, :3] * MAX_DISPLACEMENT
        self._target_quat[:] = self.read["welded_quat"] + actions[:, 3:] * MAX_DISPLACEMENT
        if self.on_table:
            self._keep_on_surface()
            self._target_pos[:, 2] = self.scene.landmarks.rest_height
            self._target_quat[:, 1:3] = 0.0  # upright: turned about the vertical only

    def _keep_on_surface(self) -> None:
        """Pull no object over the edge of what it lies on."""
        low, high = self.scene.surface
        np.clip(self._target_pos[:, :2], low, high, out=self._target_pos[:, :2])

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Position, Euler angles, linear and angular velocity (n_envs, 12), and positions."""
        position = self.read["object_pos"]
        angles = euler_angles(self.read["object_mat"].reshape(-1, 3, 3))
        parts = (position, angles, *self._object_velocities())
        return np.concatenate(parts, axis=1), position.copy()


class ObjectEnv(SingleEnv):
    """One task's object alone as a gymnasium.Env; goals, reward and T are the robot's.

    The observation (12,) is position (m), Euler angles (rad), linear and angular velocity (per env
    step); the action (7,) in [-1, 1] moves the object's position and quaternion by 0.05 times it.

    Args:
        task: key in `TASKS`, or a row of one's own.
        on_table: whether the object may not leave the table, neither upwards nor over its edge, so
            that its paths are those of an object that is pushed. The paper's object may.
        reward_type: "sparse" (0 within 0.05 m of the goal, else -1) or "dense" (minus metres).
        render_mode: None, "rgb_array" or "human".
        show_regions: draw where start and goal come from.

    Raises:
        ValueError: an unknown task, reward or render mode.
    """

    simulation_type = ObjectSimulation
    simulation: ObjectSimulation

    def __init__(
        self,
        task: str | Task,
        *,
        on_table: bool = False,
        reward_type: RewardType = "sparse",
        render_mode: str | None = None,
        show_regions: bool = False,
    ) -> None:
        self._set_up(object_scene(find_task(task)), reward_type, render_mode, show_regions)
        self.simulation.on_table = on_table


class ObjectVecEnv(BatchVecEnv):
    """N copies of a task's object alone as one SB3 VecEnv.

    Args:
        env_id: a registered id such as "FollowObject/PnPShelfObject-v0", or a row of one's own.
        n_envs: number of copies, at least 1.
        n_threads: threads that step them; None takes one a processor.
        seed: copy i draws what `ObjectEnv.reset(seed=seed + i)` draws; None is random.
        on_table, reward_type, render_mode, show_regions: as in `ObjectEnv`.
        max_episode_steps: T; None is the task's.

    Raises:
        ValueError: an unknown id or option, or a number below 1.
    """

    simulation_type = ObjectSimulation
    simulation: ObjectSimulation

    def __init__(
        self,
        env_id: str | Task,
        n_envs: int,
        n_threads: int | None = None,
        *,
        seed: int | None = None,
        on_table: bool = False,
        reward_type: RewardType = "sparse",
        render_mode: str | None = None,
        show_regions: bool = False,
        max_episode_steps: int | None = None,
    ) -> None:
        super().__init__(
            object_scene(task_of(env_id, alone=True)),
            n_envs,
            n_threads,
            seed=seed,
            reward_type=reward_type,
            render_mode=render_mode,
            show_regions=show_regions,
            max_episode_steps=max_episode_steps,
        )
        self.simulation.on_table = on_table
