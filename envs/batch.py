"""N copies of one scene stepped together in native threads, read into arrays once a step."""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ..common.copies import WholeCopies
from ..common.numbers import checked_whole
from .physics_engine import mujoco
from .scene import OBJECT, TUBE, Scene, weld_targets

_LOGGER = logging.getLogger("sb3_follow_object")
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
MAX_DISPLACEMENT = 0.05  # metres a step at action 1


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class BatchedSimulation(WholeCopies):
    """N copies of a scene, moved through the mocap body that the scene's one weld pulls.

    A copy of it, pickled or not, steps as it does, with memory and threads of its own; after a fork
    both processes have what they need, too.

    What an observation and the next action need is read right after stepping, as the last substep
    left it: poses then lag the joint positions by one substep, as in Gymnasium-Robotics.
    Subclasses say what an action moves and what is observed.

    Args:
        scene: what to simulate.
        n_envs: number of copies, at least 1.
        n_threads: threads that step them; None takes one a core, but no more than copies.

    Raises:
        ValueError: `n_envs` or `n_threads` is below 1.
    """

    action_size: int
    observation_size: int

    def __init__(self, scene: Scene, n_envs: int, n_threads: int | None = None) -> None:
        n_envs = checked_whole("n_envs", n_envs, 1)
        n_threads = cores() if n_threads is None else checked_whole("n_threads", n_threads, 1)
        self.scene = scene
        self.n_envs = n_envs
        self.n_threads = min(n_threads, n_envs)
        self.goals = np.zeros((n_envs, 3))
        # What mujoco warned of in a copy's episode, and when; None while all is well. Such a copy
        # rests on what it showed last until it is reset.
        self.faults: list[str | None] = [None] * n_envs
        self.steps = np.full(n_envs, -1)  # of the episode; -1 before there is one
        self._target_pos = np.zeros((n_envs, 3))
        self._target_quat = np.zeros((n_envs, 4))
        self._connect()

    def _connect(self) -> None:
        """Set what belongs to this object in this process; a copy sets its own."""
        facts = set(vars(self))
        self._take_memory()
        self._connected = vars(self).keys() - facts

    def _take_memory(self) -> None:
        """Set what is mujoco's memory, a view of it or found in the scene; subclasses add to it."""
        model = self.scene.model
        self._pool: ThreadPoolExecutor | None = None
        self._pool_process = 0
        self.dt = model.opt.timestep * self.scene.substeps
        self.data = [mujoco.MjData(model) for _ in range(self.n_envs)]
        self._find(model)

        # What each copy shows after a step: name -> (n_envs, ...), and where it is read from.
        self.read: dict[str, np.ndarray] = {}
        self._views: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in range(self.n_envs)]
        self._watch("welded_pos", [d.xpos[self._welded] for d in self.data])
        self._watch("welded_quat", [d.xquat[self._welded] for d in self.data])
        self._watch("object_pos", [d.site_xpos[self._object_site] for d in self.data])
        self._watch("object_mat", [d.site_xmat[self._object_site] for d in self.data])
        self._watch("qvel", [d.qvel for d in self.data])
        self._warnings = [d.warning.number for d in self.data]
        self._no_warning = bytes(self._warnings[0].nbytes)
        self._mocap_pos = [d.mocap_pos[self._mocap] for d in self.data]
        self._mocap_quat = [d.mocap_quat[self._mocap] for d in self.data]

    def _find(self, model: mujoco.MjModel) -> None:
        """Find the ids of what is moved and read."""
        self._mocap, self._welded = weld_targets(model)
        self._tube = int(model.body(TUBE).mocapid[0]) if self.scene.task.tube else None
        self._object_qpos = int(model.joint(f"{OBJECT}:joint").qposadr[0])
        self._object_qvel = int(model.joint(f"{OBJECT}:joint").dofadr[0])
        self._object_site = int(model.site(OBJECT).id)

    # What a subclass says -------------------------------------------------------------------------

    def control(self, actions: np.ndarray) -> None:
        """Set what the next step pulls at, from clipped actions (n_envs, action_size)."""
        raise NotImplementedError

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations (n_envs, observation_size) and achieved goals (n_envs, 3), newly made."""
        raise NotImplementedError

    def after_substeps(self, index: int) -> None:
        """Called for each copy once it was stepped, before it is read."""

    # Stepping -------------------------------------------------------------------------------------

    def reset(self, index: int, rng: np.random.Generator) -> None:
        """Start an episode in one copy: draw object and goal, forget the past."""
        model, data = self.scene.model, self.data[index]
        mujoco.mj_resetData(model, data)
        self.goals[index] = self._place(index, rng)
        self.steps[index] = 0
        self.faults[index] = None
        mujoco.mj_forward(model, data)
        self.refresh(index)

    def _place(self, index: int, rng: np.random.Generator) -> np.ndarray:
        """Put the object where an episode begins and return its goal (3,), in metres."""
        scene, data = self.scene, self.data[index]
        start, goal = scene.task.sample(rng, scene.landmarks)
        data.time = scene.time
        data.qpos[:] = scene.qpos
        data.qvel[:] = scene.qvel
        data.qpos[self._object_qpos : self._object_qpos + 2] = start
        if self._tube is not None:
            data.mocap_pos[self._tube] = (goal[0], goal[1], self._table_top)
        return goal

    def step(self, actions: np.ndarray) -> None:
        """Move all copies on by one env step of 0.04 s.

        Args:
            actions: (n_envs, action_size), clipped to [-1, 1] here.

        Raises:
            ValueError: an action is not finite, or no episode has begun.
        """
        if self.steps.min() < 0:
            raise ValueError("no episode has begun: call reset() first")
        if not np.isfinite(actions).all():
            index = int(np.argwhere(~np.isfinite(actions))[0, 0])
            raise ValueError(
                f"The action of environment {index} is {actions[index].tolist()}; "
                "actions must be finite."
            )
        self.control(np.clip(actions, -1.0, 1.0))
        self.steps += 1
        todo = iter(range(self.n_envs))
        if self.n_threads == 1:
            self._drain(todo)
        else:
            pool = self._threads()
            others = [pool.submit(self._drain, todo) for _ in range(self.n_threads - 1)]
            self._drain(todo)
            for other in others:
                other.result()

    def refresh(self, index: int) -> None:
        """Read one copy into the arrays of the batch."""
        for row, view in self._views[index]:
            row[...] = view

    def physics(self, index: int) -> np.ndarray:
        """What the physics of one copy goes on from, as mujoco counts it."""
        state = np.empty(mujoco.mj_stateSize(self.scene.model, STATE))
        mujoco.mj_getState(self.scene.model, self.data[index], state, STATE)
        return state

    def take_in(self, index: int) -> None:
        """Read one copy anew, whose state somebody else has written."""
        mujoco.mj_forward(self.scene.model, self.data[index])
        self.refresh(index)

    def close(self) -> None:
        """Let the threads go."""
        if self._pool is not None and self._pool_process == os.getpid():
            self._pool.shutdown()
        self._pool = None

    # Resuming -------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, np.ndarray]:
        """All that the next steps depend on, as arrays with one row a copy."""
        size = mujoco.mj_stateSize(self.scene.model, STATE)
        physics = np.empty((self.n_envs, size))
        for row, data in zip(physics, self.data, strict=True):
            mujoco.mj_getState(self.scene.model, data, row, STATE)
        read = {f"read/{name}": values.copy() for name, values in self.read.items()}
        return {
            "physics": physics,
            "goals": self.goals.copy(),
            "steps": self.steps.copy(),
            "faults": list(self.faults),
            "task": repr(self.scene.task),
            **read,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from what `get_state` gave.

        Raises:
            ValueError: it comes from another number of copies or another task.
        """
        task = repr(self.scene.task)
        if state.get("task", task) != task:  # the first checkpoints do not say it
            raise ValueError(f"The state is not of {self.scene.task.name} but of {state['task']}.")
        size = mujoco.mj_stateSize(self.scene.model, STATE)
        if state["physics"].shape != (self.n_envs, size):
            raise ValueError(
                f"The state has shape {state['physics'].shape}, but {self.n_envs} environments of "
                f"{self.scene.task.name} need {(self.n_envs, size)}."
            )
        for row, data in zip(state["physics"], self.data, strict=True):
            mujoco.mj_resetData(self.scene.model, data)
            mujoco.mj_setState(self.scene.model, data, row, STATE)
        self.goals[:] = state["goals"]
        self.steps[:] = state["steps"]
        self.faults[:] = state["faults"]
        for name, values in self.read.items():
            values[:] = state[f"read/{name}"]

    # Copying --------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        facts = {name: value for name, value in vars(self).items() if name not in self._connected}
        return {**facts, "state": self.get_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        facts = dict(state)
        resumed = facts.pop("state")
        del facts["_connected"]
        vars(self).update(facts)
        self._connect()
        self.set_state(resumed)
        # Poses follow from the state, but the next step's start does not: it is put back.
        for row, data, warnings in zip(resumed["physics"], self.data, self._warnings, strict=True):
            mujoco.mj_forward(self.scene.model, data)
            mujoco.mj_setState(self.scene.model, data, row, STATE)
            warnings[:] = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> BatchedSimulation:
        twin = memo[id(self)] = type(self).__new__(type(self))
        twin.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        for theirs, ours in zip(twin.data, self.data, strict=True):
            mujoco.mj_copyData(theirs, self.scene.model, ours)
        return twin

    # Inside ---------------------------------------------------------------------------------------

    def _threads(self) -> ThreadPoolExecutor:
        """The threads beside the caller's; those of a parent process do not survive its fork."""
        if self._pool is None or self._pool_process != os.getpid():
            self._pool = ThreadPoolExecutor(self.n_threads - 1)
            self._pool_process = os.getpid()
        return self._pool

    @property
    def _table_top(self) -> float:
        model, table = self.scene.model, self.scene.model.body("table0")
        return float(table.pos[2] + model.geom_size[table.geomadr[0], 2])

    def _watch(self, name: str, views: list[np.ndarray]) -> None:
        self.read[name] = np.zeros((self.n_envs, *views[0].shape), dtype=views[0].dtype)
        for index, view in enumerate(views):
            self._views[index].append((self.read[name][index], view))

    def _drain(self, todo: Iterator[int]) -> None:
        # Threads share one range iterator: each takes the next copy, so uneven copies balance out.
        model, substeps = self.scene.model, self.scene.substeps
        for index in todo:
            if self.faults[index] is not None:
                continue
            data = self.data[index]
            self._mocap_pos[index][...] = self._target_pos[index]
            self._mocap_quat[index][...] = self._target_quat[index]
            mujoco.mj_step(model, data, substeps)
            self.after_substeps(index)
            if self._warnings[index].tobytes() != self._no_warning:  # in a tenth of any()'s time
                self._note_fault(index)
            else:
                self.refresh(index)

    def _object_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """The object's linear and angular velocity, world frame, per env step, (n_envs, 3) each."""
        first = self._object_qvel
        linear = self.read["qvel"][:, first : first + 3]
        spin = self.read["qvel"][:, first + 3 : first + 6]
        matrices = self.read["object_mat"].reshape(-1, 3, 3)
        return linear * self.dt, rotate(matrices, spin) * self.dt

    def _note_fault(self, index: int) -> None:
        kind = mujoco.mjtWarning(int(np.argmax(self._warnings[index] > 0))).name
        self.faults[index] = f"{kind.removeprefix('mjWARN_')} at step {self.steps[index]}"
        _LOGGER.warning(
            "the physics of environment %d (%s) diverged: %s; its episode is dropped",
            index,
            self.scene.task.name,
            self.faults[index],
        )


def rotate(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Products of matrices (n, i, j) and vectors (n, j), shape (n, i)."""
    return np.matmul(matrices, vectors[:, :, None])[:, :, 0]


def euler_angles(matrices: np.ndarray) -> np.ndarray:
    """Euler angles (n, 3) of rotation matrices (n, 3, 3), in Gymnasium-Robotics' convention.

    About x, then y, then z of the fixed frame, negated; the first is 0 where the second is upright.
    """
    cosine = np.hypot(matrices[:, 2, 2], matrices[:, 1, 2])
    regular = cosine > 4 * np.finfo(np.float64).eps
    first = np.where(regular, -np.arctan2(matrices[:, 1, 2], matrices[:, 2, 2]), 0.0)
    second = -np.arctan2(-matrices[:, 0, 2], cosine)
    third = np.where(
        regular,
        -np.arctan2(matrices[:, 0, 1], matrices[:, 0, 0]),
        -np.arctan2(-matrices[:, 1, 0], matrices[:, 1, 1]),
    )
    return np.stack([first, second, third], axis=1)
