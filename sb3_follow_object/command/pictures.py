"""Pictures and videos of a task, its imagined goals and a trained robot."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ..any_task.scene_picture import Drawn, draw_points
from ..common.extras import need
from ..common.files import atomic_write
from ..ddpg.actor_files import load_actor
from ..envs import IDS
from ..envs.graphics import find_graphics
from ..envs.robot_copies import robot_maker
from ..imagination.goal_predictor import GoalPredictor

# Episodes side by side in the picture of imagined goals.
_PANELS = 3


def draw_task(env_id: str, out: str | os.PathLike[str], seed: int = 0) -> None:
    """Write a picture of a task, with the regions that starts and goals come from.

    Args:
        env_id: the task; only this package's show their regions.
        out: PNG file to create or replace.
        seed: of the start and goal in the picture.

    Raises:
        MissingExtra: imageio is not installed.
        RuntimeError: there is nothing to draw with.
    """
    env = _make(env_id, show_regions=True)
    try:
        env.reset(seed=seed)
        write_png(out, _frame(env))
    finally:
        env.close()


def draw_imagined(
    env_id: str, predictor: GoalPredictor, out: str | os.PathLike[str], seed: int = 0
) -> None:
    """Write a picture of imagined goals h_1 .. h_T in a few episodes (paper, section 4.2).

    Args:
        env_id: a task of this package.
        predictor: its F_phi.
        out: PNG file to create or replace.
        seed: of the first episode.

    Raises:
        MissingExtra: imageio is not installed.
        RuntimeError: there is nothing to draw with.
    """
    env = _make(env_id)
    try:
        panels = []
        for panel in range(_PANELS):
            obs, _ = env.reset(seed=seed + panel)
            path = predictor.paths(obs["achieved_goal"][None], obs["desired_goal"][None])[0]
            if env_id in IDS:
                env.unwrapped.set_markers(path[1:])  # type: ignore[attr-defined]
                panels.append(_frame(env))
            else:
                panels.append(draw_points(env, path[1:], obs["desired_goal"][None]))
        write_png(out, np.concatenate(panels, axis=1))
    finally:
        env.close()


def record(
    policy_file: str | os.PathLike[str],
    env_id: str,
    out: str | os.PathLike[str],
    n_episodes: int = 5,
    seed: int = 0,
) -> float:
    """Write a video of noise-free episodes with original goals; return their success rate.

    Args:
        policy_file: written by `save_actor`.
        env_id: the task.
        out: MP4 file to create or replace.
        n_episodes: at least 1.
        seed: of the first episode, at least 0.

    Raises:
        MissingExtra: imageio or its ffmpeg is not installed.
        RuntimeError: there is nothing to draw with.
        ValueError: no episodes are asked for, a negative seed, or the policy does not fit the task.
    """
    if n_episodes < 1:
        raise ValueError(f"episodes is {n_episodes}; it must be at least 1")
    if seed < 0:
        raise ValueError(f"seed is {seed}; it must be at least 0")
    imageio = need("imageio", "video")
    need("imageio_ffmpeg", "video")
    out = Path(out)
    env = _make(env_id)
    # The writer knows the format by the ending; a name of its own keeps half a video apart.
    temporary = out.with_name(f".{out.stem}.{os.getpid()}.mp4")
    try:
        _check_can_write(temporary, out)
        actor, _ = load_actor(policy_file, env.observation_space, env.action_space)  # type: ignore[arg-type]
        successes = 0
        with imageio.get_writer(temporary, fps=env.metadata.get("render_fps", 25)) as video:
            for episode in range(n_episodes):
                obs, info = env.reset(seed=seed + episode)
                video.append_data(_frame(env))
                over = False
                while not over:
                    action, _ = actor.predict(obs, deterministic=True)
                    obs, _, terminated, truncated, info = env.step(action)
                    video.append_data(_frame(env))
                    over = terminated or truncated
                successes += bool(info["is_success"])
        os.replace(temporary, out)
        return successes / n_episodes
    finally:
        temporary.unlink(missing_ok=True)
        env.close()


def _make(env_id: str, **options: Any) -> gym.Env:
    if env_id in IDS:
        return gym.make(env_id, render_mode="rgb_array", **options)
    if sys.platform == "linux":
        # Gymnasium's renderer takes the name as it stands, and without one tries a window first,
        # which ends a process without a screen.
        os.environ["MUJOCO_GL"] = find_graphics()
    plain = robot_maker(env_id)()
    if "rgb_array" not in plain.metadata.get("render_modes", ()):
        return Drawn(plain)
    plain.close()
    return robot_maker(env_id, render_mode="rgb_array")()


def _frame(env: gym.Env) -> np.ndarray:
    try:
        return np.asarray(env.render(), dtype=np.uint8)
    except (RuntimeError, ValueError):
        raise
    except Exception as error:  # graphics libraries, and somebody's environment, raise anything
        raise RuntimeError(
            f"the task cannot be drawn here: {type(error).__name__}: {error}"
        ) from error


def _check_can_write(temporary: Path, out: Path) -> None:
    """Raise the OSError that a whole film later would say the encoder had ended."""
    try:
        temporary.touch()
    except OSError as error:
        error.filename = str(out)
        raise


def write_png(out: str | os.PathLike[str], image: np.ndarray) -> None:
    """Write a picture as a whole or not at all."""
    need("imageio", "video")
    data = need("imageio.v3", "video").imwrite("<bytes>", image, extension=".png")
    atomic_write(out, data)
