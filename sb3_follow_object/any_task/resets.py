"""Where a task's episodes begin and what their goals are, recorded from its real resets."""

from __future__ import annotations

import copy
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import gymnasium as gym
import numpy as np

from ..common.array_trees import load_tree, save_tree
from ..envs.goal_space import goal_space
from ..envs.physics_engine import mujoco
from ..envs.robot_parts import robot_bodies, standing
from .physics_access import physics_of
from .same_physics import check_same_physics

SURFACE_SHARE, SURFACE_HEIGHT = 0.99, 0.012  # share of the goals, metres off the start's height
_SAME = 1e-6  # metres, and parts of a unit quaternion


@dataclass(frozen=True)
class Resets:
    """What n resets began with.

    Attributes:
        goals: (n, 3) metres.
        starts: achieved goals, (n, 3) metres.
        qpos: of all joints, (n, nq).
        qvel: likewise, (n, nv).
        places: of all bodies, (n, nbody, 7): position in metres and quaternion.
    """

    goals: np.ndarray
    starts: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    places: np.ndarray

    def __len__(self) -> int:
        return len(self.goals)

    def on_surface(self) -> bool:
        """Whether nearly all goals lie as high as the object starts, so that it can be pushed."""
        space = goal_space(self.goals.shape[1:])
        off = np.abs(space.height(self.goals) - space.height(self.starts))
        return bool((off < SURFACE_HEIGHT).mean() >= SURFACE_SHARE)

    def save(self, path: Path) -> None:
        """Write one file."""
        names = [each.name for each in fields(self)]
        save_tree(path, dict(zip(names, astuple(self), strict=True)))

    @classmethod
    def load(cls, path: Path) -> Resets:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is missing or damaged.
        """
        tree = load_tree(path)
        try:
            return cls(**{each.name: tree[each.name] for each in fields(cls)})
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} holds no recorded resets") from error


def record_resets(env: gym.Env, n: int) -> tuple[Resets, mujoco.MjModel, mujoco.MjData]:
    """Reset an environment n times and keep where each episode begins.

    Args:
        env: with Dict goal observations; reset i has the seed i.
        n: at least 1.

    Returns:
        The resets, and a copy of the first one's model and data.

    Raises:
        ValueError: what can be touched is moved or reshaped between episodes in a way that no body
            tells of.
    """
    rows: list[tuple[np.ndarray, ...]] = []
    first: tuple[mujoco.MjModel, mujoco.MjData] | None = None
    for seed in range(n):
        obs, _ = env.reset(seed=seed)
        model, data = physics_of(env)
        mujoco.mj_kinematics(model, data)  # places of bodies are stale where they were moved
        if first is None:
            first = copy.copy(model), copy.copy(data)
        check_same_physics(first, (model, data))
        rows.append(
            (
                np.array(obs["desired_goal"], np.float64),
                np.array(obs["achieved_goal"], np.float64),
                data.qpos.copy(),
                data.qvel.copy(),
                np.concatenate([data.xpos, data.xquat], axis=1),
            )
        )
    assert first is not None
    return Resets(*(np.stack(column) for column in zip(*rows, strict=True))), *first


def varying_bodies(model: mujoco.MjModel, resets: Resets) -> frozenset[int]:
    """Bodies that stand still within an episode and elsewhere in another, the robot's left out."""
    spread = np.ptp(resets.places, axis=0).max(axis=1)
    stands = standing(model) & ~robot_bodies(model)
    return frozenset(int(body) for body in np.flatnonzero(stands & (spread > _SAME)) if body)
