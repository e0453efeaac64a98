"""The robot's tasks: one batched simulation behind a gymnasium.Env and an SB3 VecEnv."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..common.mirrors import Mirror
from .batch import MAX_DISPLACEMENT, BatchedSimulation, euler_angles, rotate
from .faces import BatchVecEnv, RewardType, SingleEnv
from .physics_engine import mujoco
from .scene import FINGER_JOINTS, GRIP_SITE, fetch_scene
from .symmetry import fetch_mirrors
from .task_table import find_task, task_of
from .tasks import Task

# Added to the gripper's own quaternion each step, which turns it to point down.
_DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])

# Where an observation holds the object's position, Euler angles, linear velocity relative to the
# gripper and angular velocity; and the gripper's velocity.
_OBJECT = [*range(3, 6), *range(11, 20)]
_GRIP_VELOCITY = slice(20, 23)


def object_state(observations: Any) -> Any:
    """The object's own observations (n, 12) within the robot's (n, 25), as `ObjectEnv` has them.

    Units are the same: metres, radians, and both per env step. Only the linear velocity is told
    differently, relative to the gripper; the gripper's is added.

    Args:
        observations: array or tensor (n, 25) of a robot task of this package.
    """
    state = observations[:, _OBJECT]
    state[:, 6:9] += observations[:, _GRIP_VELOCITY]
    return state


class FetchSimulation(BatchedSimulation):
    """The Fetch robot: actions move gripper (3) and fingers (1), observations are v4's 25."""

    action_size = 4
    observation_size = 25

    def _take_memory(self) -> None:
        super()._take_memory()
        model = self.scene.model
        fingers = [model.joint(name) for name in FINGER_JOINTS]
        self._finger_qpos = np.array([joint.qposadr[0] for joint in fingers])
        self._finger_qvel = np.array([joint.dofadr[0] for joint in fingers])
        self._driven_qpos = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._grip_site = int(model.site(GRIP_SITE).id)
        self._controls = [d.ctrl for d in self.data]
        self.read["grip_jacobian"] = np.zeros((self.n_envs, 3, model.nv))
        self._watch("qpos", [d.qpos for d in self.data])
        self._watch("grip_pos", [d.site_xpos[self._grip_site] for d in self.data])

    def control(self, actions: np.ndarray) -> None:
        """Pull the gripper by 0.05 m times the action, and the fingers by the action itself."""
        self._target_pos[:] = self.read["welded_pos"] + actions[:, :3] * MAX_DISPLACEMENT
        self._target_quat[:] = self.read["welded_quat"] + _DOWNWARD
        if not self.scene.task.blocked_gripper:
            targets = self.read["qpos"][:, self._driven_qpos] + actions[:, 3:]
            for control, target in zip(self._controls, targets, strict=True):
                control[:] = target

    def after_substeps(self, index: int) -> None:
        """Close blocked fingers."""
        data = self.data[index]
        if self.scene.task.blocked_gripper:
            data.qpos[self._finger_qpos] = 0.0
            mujoco.mj_forward(self.scene.model, data)

    def refresh(self, index: int) -> None:
        """Read one copy, and how its joints move the gripper."""
        super().refresh(index)
        jacobian = self.read["grip_jacobian"][index]
        mujoco.mj_jacSite(self.scene.model, self.data[index], jacobian, None, self._grip_site)

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations (n_envs, 25) in the order of FetchPickAndPlace-v4, and object positions."""
        read = self.read
        linear, angular = self._object_velocities()
        grip_velocity = rotate(read["grip_jacobian"], read["qvel"]) * self.dt
        parts = (
            read["grip_pos"],
            read["object_pos"],
            read["object_pos"] - read["grip_pos"],
            read["qpos"][:, self._finger_qpos],
            euler_angles(read["object_mat"].reshape(-1, 3, 3)),
            linear - grip_velocity,
            angular,
            grip_velocity,
            read["qvel"][:, self._finger_qvel] * self.dt,
        )
        return np.concatenate(parts, axis=1), read["object_pos"].copy()


class _Mirrored:
    """What both faces of a robot task say of its symmetry."""

    simulation: BatchedSimulation

    @property
    def mirrors(self) -> tuple[Mirror, ...]:
        """Planes over which the task is symmetric."""
        return fetch_mirrors(self.simulation.scene.task)


class FetchEnv(_Mirrored, SingleEnv):
    """One robot task as a gymnasium.Env with Dict observations (paper, section 5.1).

    Args:
        task: key in `TASKS`, or a row of one's own.
        reward_type: "sparse" (0 within 0.05 m of the goal, else -1) or "dense" (minus metres).
        render_mode: None, "rgb_array" or "human".
        collision: "reachable" leaves out pairs that do not matter, "full" tests all.
        show_regions: draw where start and goal come from.

    Raises:
        ValueError: an unknown task, reward, render mode or collision.
    """

    simulation_type = FetchSimulation

    def __init__(
        self,
        task: str | Task,
        *,
        reward_type: RewardType = "sparse",
        render_mode: str | None = None,
        collision: str = "reachable",
        show_regions: bool = False,
    ) -> None:
        scene = fetch_scene(find_task(task), collision)
        self._set_up(scene, reward_type, render_mode, show_regions)


class FetchVecEnv(_Mirrored, BatchVecEnv):
    """N copies of a robot task as one SB3 VecEnv: native threads, vectorised observations.

    Args:
        env_id: a registered id such as "FollowObject/PnPShelf-v0", or a row of one's own.
        n_envs: number of copies, at least 1.
        n_threads: threads that step them; None takes one a processor.
        seed: copy i draws what `FetchEnv.reset(seed=seed + i)` draws; None is random.
        reward_type, collision, render_mode, show_regions: as in `FetchEnv`.
        max_episode_steps: T; None is the task's.

    Raises:
        ValueError: an unknown id or option, or a number below 1.
    """

    simulation_type = FetchSimulation

    def __init__(
        self,
        env_id: str | Task,
        n_envs: int,
        n_threads: int | None = None,
        *,
        seed: int | None = None,
        reward_type: RewardType = "sparse",
        collision: str = "reachable",
        render_mode: str | None = None,
        show_regions: bool = False,
        max_episode_steps: int | None = None,
    ) -> None:
        scene = fetch_scene(task_of(env_id, alone=False), collision)
        super().__init__(
            scene,
            n_envs,
            n_threads,
            seed=seed,
            reward_type=reward_type,
            render_mode=render_mode,
            show_regions=show_regions,
            max_episode_steps=max_episode_steps,
        )
