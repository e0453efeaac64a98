"""The two faces of a batched simulation: a gymnasium.Env of one copy, an SB3 VecEnv of many."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from stable_baselines3.common.vec_env import VecEnv

from ..common.copies import WholeCopies
from ..common.numbers import checked_whole
from ..common.vec_env_copies import let_vec_envs_be_copied
from .batch import BatchedSimulation
from .physics_engine import mujoco
from .picture import Picture
from .scene import Scene

let_vec_envs_be_copied()

RewardType = Literal["sparse", "dense"]
RENDER_MODES = ("human", "rgb_array")
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 25}


class _GoalFace(WholeCopies):
    """What both faces share: the simulation, its spaces, reward and success, pictures."""

    simulation_type: type[BatchedSimulation]
    simulation: BatchedSimulation
    reward_type: RewardType

    def _start(
        self,
        simulation: BatchedSimulation,
        reward_type: RewardType,
        render_mode: str | None,
        show_regions: bool,
    ) -> None:
        if reward_type not in ("sparse", "dense"):
            raise ValueError(f"reward_type must be 'sparse' or 'dense', not {reward_type!r}.")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode must be None, 'rgb_array' or 'human', not {render_mode!r}."
            )
        self.simulation = simulation
        self.reward_type = reward_type
        self.render_mode = render_mode
        self._picture = Picture(simulation.scene, show_regions)

    @property
    def model(self) -> mujoco.MjModel:
        """The physics, shared by every environment of the task in this process; not to be written.

        What is only seen is left out of it.
        """
        return self.simulation.scene.model

    @property
    def dt(self) -> float:
        """Seconds in a step."""
        return self.simulation.dt

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Rewards (...) of achieved goals (..., 3) for desired ones (..., 3).

        Sparse: 0 within the scene's success distance (0.05 m in this package's own tasks), else -1.
        Dense: minus the distance in metres. `info` is unused.
        """
        distance = _distance(achieved_goal, desired_goal)
        if self.reward_type == "dense":
            return -distance
        return -(distance > self.simulation.scene.success_distance).astype(np.float32)

    def is_success(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> Any:
        """Whether achieved goals (..., 3) lie that near to desired ones, bool (...)."""
        within = self.simulation.scene.success_distance
        return _distance(achieved_goal, desired_goal) <= within

    def set_markers(self, points: np.ndarray) -> None:
        """Points (n, 3) in metres that pictures show from now on, such as imagined goals."""
        self._picture.set_markers(points)

    def close(self) -> None:
        """Let threads and windows go."""
        self.simulation.close()
        self._picture.close()


class SingleEnv(_GoalFace, gym.Env):
    """A batch of one as a gymnasium.Env; it never ends, `gymnasium.make` truncates at T."""

    metadata = METADATA

    def _set_up(
        self, scene: Scene, reward_type: RewardType, render_mode: str | None, show_regions: bool
    ) -> None:
        self._start(self.simulation_type(scene, 1), reward_type, render_mode, show_regions)
        self.observation_space, self.action_space = _spaces(self.simulation)
        # What the physics was when the data that was handed out was last left to its reader.
        self._left: np.ndarray | None = None

    @property
    def data(self) -> mujoco.MjData:
        """The state of the physics; what is written into it counts from the next step on."""
        if self._left is None:
            self._left = self.simulation.physics(0)
        return self.simulation.data[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Draw object and goal and start an episode; `options` is unused."""
        super().reset(seed=seed)
        self.simulation.reset(0, self.np_random)
        if self._left is not None:
            self._left = self.simulation.physics(0)
        if self.render_mode == "human":
            self.render()
        return self._observation(), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move on by 0.04 s; the action (action_size,) is clipped to [-1, 1].

        Where the physics diverges the episode is truncated with its last good observation, and the
        info says "diverged".

        Raises:
            ValueError: the action has another shape or is not finite.
        """
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"The action has shape {action.shape}, not {self.action_space.shape}.")
        if self._left is None:
            self.simulation.step(action[None])
        else:
            if not np.array_equal(self._left, self.simulation.physics(0)):
                self.simulation.take_in(0)
            self.simulation.step(action[None])
            self._left = self.simulation.physics(0)
        obs = self._observation()
        if self.render_mode == "human":
            self.render()
        achieved, desired = obs["achieved_goal"], obs["desired_goal"]
        info: dict[str, Any] = {"is_success": bool(self.is_success(achieved, desired))}
        fault = self.simulation.faults[0]
        if fault is not None:
            info["diverged"] = fault
        reward = float(self.compute_reward(achieved, desired, info))
        return obs, reward, False, fault is not None, info

    @property
    def window_closed(self) -> bool:
        """Whether somebody closed the window that "human" opened; steps go on without it."""
        return self._picture.window_closed

    def render(self) -> np.ndarray | None:
        """A picture (480, 480, 3) with "rgb_array"; None, and a window, with "human"."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode='rgb_array' or 'human'.")
            return None
        if self.render_mode == "rgb_array":
            return self._picture.draw(self.simulation, 0)
        self._picture.draw_window(self.simulation, 0)
        return None

    def _observation(self) -> dict[str, np.ndarray]:
        observation, achieved = self.simulation.observe()
        return {
            "observation": observation[0],
            "achieved_goal": achieved[0],
            "desired_goal": self.simulation.goals[0].copy(),
        }


class BatchVecEnv(_GoalFace, VecEnv):
    """A batch of N as an SB3 VecEnv that resets by itself and truncates at T."""

    metadata = METADATA

    def __init__(
        self,
        scene: Scene,
        n_envs: int,
        n_threads: int | None,
        *,
        seed: int | None,
        reward_type: RewardType,
        render_mode: str | None,
        show_regions: bool,
        max_episode_steps: int | None,
    ) -> None:
        if max_episode_steps is not None:  # copies that are stepped together need an end
            max_episode_steps = checked_whole("max_episode_steps", max_episode_steps, 1)
        if seed is not None:
            seed = checked_whole("seed", seed, 0)
        simulation = self.simulation_type(scene, n_envs, n_threads)
        self._start(simulation, reward_type, render_mode, show_regions)
        super().__init__(n_envs, *_spaces(simulation))
        self.metadata = METADATA  # the line above has left out the frames a second
        self.horizon = scene.task.horizon if max_episode_steps is None else max_episode_steps
        self._generators = [seeding.np_random()[0] for _ in range(n_envs)]
        self._actions = np.zeros((n_envs, simulation.action_size))
        if seed is not None:
            self.seed(seed)

    @property
    def spec(self) -> EnvSpec:
        """Gymnasium's spec of each copy, which says how long its episodes are."""
        scene = self.simulation.scene
        env_id = f"FollowObject/{scene.task.name}{'Object' if scene.alone else ''}-v0"
        spec = gym.registry.get(env_id) or EnvSpec(env_id, max_episode_steps=scene.task.horizon)
        if spec.max_episode_steps != self.horizon:
            spec = copy.copy(spec)
            spec.max_episode_steps = self.horizon
        return spec

    @property
    def data(self) -> list[mujoco.MjData]:
        """The states of the physics of all copies; to be read, not to be written."""
        return self.simulation.data

    def reset(self) -> dict[str, np.ndarray]:
        """Start an episode in every copy; seeds set by `seed()` count from here."""
        for index, seed in enumerate(self._seeds):
            if seed is not None:
                self._generators[index] = seeding.np_random(seed)[0]
            self.simulation.reset(index, self._generators[index])
        self._reset_seeds()
        self._reset_options()
        return self._observations()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (n_envs, action_size) for `step_wait`."""
        self._actions = np.asarray(actions)

    def step_wait(
        self,
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Move all copies on by 0.04 s; those at T start anew and tell their last observation.

        A copy whose physics diverges rests on its last good observation until T, so that all
        copies stay in step; the info at its episode's end says "diverged".

        Raises:
            ValueError: the actions have another shape or are not finite.
        """
        expected = (self.num_envs, self.simulation.action_size)
        if self._actions.shape != expected:
            raise ValueError(f"The actions have shape {self._actions.shape}, not {expected}.")
        self.simulation.step(self._actions)
        obs = self._observations()
        achieved, desired = obs["achieved_goal"], obs["desired_goal"]
        rewards = self.compute_reward(achieved, desired, None).astype(np.float32)
        dones = self.simulation.steps >= self.horizon
        infos: list[dict[str, Any]] = [
            {"is_success": success, "TimeLimit.truncated": done}
            for success, done in zip(
                self.is_success(achieved, desired).tolist(), dones.tolist(), strict=True
            )
        ]
        if dones.any():
            for index in np.flatnonzero(dones):
                infos[index]["terminal_observation"] = {
                    key: values[index].copy() for key, values in obs.items()
                }
                if self.simulation.faults[index] is not None:
                    infos[index]["diverged"] = self.simulation.faults[index]
                self.simulation.reset(int(index), self._generators[index])
            obs = self._observations()
        if self.render_mode == "human":
            self.render()
        return obs, rewards, dones, infos

    def get_state(self) -> dict[str, Any]:
        """All that a resumed run needs to go on as if never stopped, generators included."""
        return {
            **self.simulation.get_state(),
            "generators": [generator.bit_generator.state for generator in self._generators],
            "seeds": list(self._seeds),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from what `get_state` gave.

        Raises:
            ValueError: it comes from another number of copies or another task.
        """
        self.simulation.set_state(state)
        for generator, saved in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = saved
        self._seeds = list(state["seeds"])  # those that the next reset() would still use

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture (480, 480, 3) of every copy."""
        return [self._picture.draw(self.simulation, index) for index in range(self.num_envs)]

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """All copies tiled with "rgb_array"; the first copy in a window with "human"."""
        if (mode or self.render_mode) == "human":
            self._picture.draw_window(self.simulation, 0)
            return None
        return super().render(mode)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute, which all copies share but for their `data`, once for each index."""
        value = getattr(self, attr_name)
        return [value[i] if attr_name == "data" else value for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute, which all copies share.

        Raises:
            ValueError: it is asked for some copies only.
        """
        if len(set(self._get_indices(indices))) < self.num_envs:
            raise ValueError(f"all copies share {attr_name!r}; set it without indices.")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method, once for each index."""
        method = getattr(self, method_name)
        return [method(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """No copy is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def _observations(self) -> dict[str, np.ndarray]:
        observation, achieved = self.simulation.observe()
        desired = self.simulation.goals.copy()
        return {"observation": observation, "achieved_goal": achieved, "desired_goal": desired}


def _distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    first, second = np.asarray(first), np.asarray(second)
    # Coordinate by coordinate: the sums of linalg.norm(axis=-1) in a sixth of its time.
    squares = [np.square(first[..., i] - second[..., i]) for i in range(first.shape[-1])]
    return np.asarray(np.sqrt(sum(squares[1:], start=squares[0])))


def _spaces(simulation: BatchedSimulation) -> tuple[spaces.Dict, spaces.Box]:
    sizes = {"observation": simulation.observation_size, "achieved_goal": 3, "desired_goal": 3}
    observation = spaces.Dict(
        {key: spaces.Box(-np.inf, np.inf, (size,), np.float64) for key, size in sizes.items()}
    )
    return observation, spaces.Box(-1.0, 1.0, (simulation.action_size,), np.float32)
