"""Pictures and films of a task, its imagined goals and a trained robot."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ..any_task.context import read_context
from ..any_task.scene_picture import GOAL_RGBA, Drawn, draw_points
from ..common.extras import need
from ..common.files import NAME_LETTERS, atomic_write
from ..ddpg.actor_files import load_actor
from ..envs import IDS, TASKS
from ..envs.graphics import find_graphics
from ..envs.picture import marker_colours
from ..envs.robot_copies import robot_maker
from ..envs.task_table import BUILT_IN
from ..imagination.goal_predictor import GoalPredictor
from ..imagination.imagined_goals import points_along

# Episodes side by side in the picture of imagined goals, and tasks in a row of all tasks.
_PANELS = 3
_TASKS_IN_A_ROW = 4
# Imagined goals in pictures: shares of the way, as the levels of a curriculum "path".
_LEVELS = 25
_INK = (30, 35, 50)
_LETTERS = 22  # pixels

EachStep = Callable[[gym.Env], None]
EachEpisode = Callable[[int, bool], None]


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
    env = make_drawn(env_id, show_regions=True)
    try:
        env.reset(seed=seed)
        write_png(out, frame(env))
    finally:
        env.close()


def draw_tasks(out: str | os.PathLike[str], seed: int = 0) -> None:
    """Write a picture of the paper's eight tasks side by side, each with its name and regions.

    Args:
        out: PNG file to create or replace.
        seed: of the starts and goals in it.

    Raises:
        MissingExtra: imageio is not installed.
        RuntimeError: there is nothing to draw with.
    """
    panels = []
    for name in TASKS:
        env_id = f"FollowObject/{name}-v0"
        if env_id not in BUILT_IN:  # somebody's own
            continue
        env = make_drawn(env_id, show_regions=True)
        try:
            env.reset(seed=seed)
            panels.append(labelled(frame(env), name))
        finally:
            env.close()
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % _TASKS_IN_A_ROW)
    rows = [panels[i : i + _TASKS_IN_A_ROW] for i in range(0, len(panels), _TASKS_IN_A_ROW)]
    write_png(out, np.concatenate([np.concatenate(row, axis=1) for row in rows]))


def draw_imagined(
    env_id: str, predictor: GoalPredictor, out: str | os.PathLike[str], seed: int = 0
) -> None:
    """Write a picture of imagined goals in a few episodes (paper, section 4.2).

    Args:
        env_id: a task whose object can be followed.
        predictor: its F_phi.
        out: PNG file to create or replace.
        seed: of the first episode.

    Raises:
        MissingExtra: imageio is not installed.
        RuntimeError: there is nothing to draw with.
    """
    write_png(out, np.concatenate(imagined_panels(env_id, predictor, _PANELS, seed), axis=1))


def imagined_panels(
    env_id: str, predictor: GoalPredictor, n_episodes: int, seed: int = 0
) -> list[np.ndarray]:
    """Draw episodes that begin, with the goals that F_phi imagines in them.

    The goals lie evenly along the object's way, the first levels dark, the last yellow.

    Args:
        env_id: a task whose object can be followed.
        predictor: its F_phi.
        n_episodes: how many.
        seed: of the first.

    Raises:
        RuntimeError: there is nothing to draw with.
    """
    env = make_drawn(env_id)
    try:
        panels = []
        for panel in range(n_episodes):
            obs, _ = env.reset(seed=seed + panel)
            way = imagined_way(predictor, obs, read_context(predictor.context, env))
            if env_id in IDS:
                env.unwrapped.set_markers(way)  # type: ignore[attr-defined]
                panels.append(frame(env))
            else:
                goal = predictor.space.point(obs["desired_goal"][None])
                panels.append(_imagined_elsewhere(env, way, goal))
        return panels
    finally:
        env.close()


def _imagined_elsewhere(env: gym.Env, way: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Draw imagined goals (n, 3) and a goal (1, 3), in metres, in an environment of others."""
    levels = np.column_stack([marker_colours(len(way)), np.ones(len(way))])
    return draw_points(env, np.vstack([way, goal]), np.vstack([levels, GOAL_RGBA]))


def imagined_way(
    predictor: GoalPredictor, obs: dict[str, np.ndarray], context: np.ndarray
) -> np.ndarray:
    """Where imagined goals are (25, 3), evenly along the way from an episode's start to its goal.

    Args:
        predictor: F_phi.
        obs: that an episode begins with.
        context: what F_phi sees beside it, (c,).
    """
    start, goal = obs["achieved_goal"][None], obs["desired_goal"][None]
    paths = predictor.paths(start, goal, context[None])
    shares = np.arange(1, _LEVELS + 1) / _LEVELS
    return predictor.space.point(points_along(paths, shares, predictor.space)[0])


def record(
    policy_file: str | os.PathLike[str],
    env_id: str,
    out: str | os.PathLike[str],
    n_episodes: int = 5,
    seed: int = 0,
    each_episode: EachEpisode = lambda episode, success: None,
) -> float:
    """Write a video of noise-free episodes with original goals; return their success rate.

    Args:
        policy_file: written by `save_actor`.
        env_id: the task.
        out: MP4 file to create or replace.
        n_episodes: at least 1.
        seed: of the first episode, at least 0.
        each_episode: called with an episode's number, from 0, and its success.

    Raises:
        MissingExtra: imageio or its ffmpeg is not installed.
        RuntimeError: there is nothing to draw with.
        ValueError: no episodes are asked for, a negative seed, or the policy does not fit the task.
    """
    check_counts(n_episodes, seed)
    imageio = need("imageio", "video")
    need("imageio_ffmpeg", "video")
    out = Path(out)
    env = make_drawn(env_id)
    # The writer knows the format by the ending; a name of its own keeps half a video apart.
    temporary = out.with_name(f".{out.stem[:NAME_LETTERS]}.{os.getpid()}.mp4")
    try:
        _check_can_write(temporary, out)
        actor, _ = load_actor(policy_file, env.observation_space, env.action_space)  # type: ignore[arg-type]
        fps = env.metadata.get("render_fps", 25)
        with imageio.get_writer(temporary, fps=fps) as video:

            def film(env: gym.Env) -> None:
                video.append_data(frame(env))

            rate = play(actor, env, n_episodes, seed, film, each_episode)
        os.replace(temporary, out)
        return rate
    finally:
        temporary.unlink(missing_ok=True)
        env.close()


def play(
    actor: Any,
    env: gym.Env,
    n_episodes: int,
    seed: int,
    each_step: EachStep,
    each_episode: EachEpisode = lambda episode, success: None,
) -> float:
    """Play noise-free episodes and return their success rate.

    Args:
        actor: has SB3's `predict`.
        env: the task.
        n_episodes: at least 1.
        seed: of the first episode.
        each_step: called with the environment after each reset and step.
        each_episode: called with an episode's number, from 0, and its success.
    """
    successes = 0
    for episode in range(n_episodes):
        obs, info = env.reset(seed=seed + episode)
        each_step(env)
        over = False
        while not over:
            action, _ = actor.predict(obs, deterministic=True)
            obs, _, terminated, truncated, info = env.step(action)
            each_step(env)
            over = terminated or truncated
        successes += bool(info["is_success"])
        each_episode(episode, bool(info["is_success"]))
    return successes / n_episodes


def check_counts(n_episodes: int, seed: int) -> None:
    """Raise a ValueError unless there are episodes and their seeds are not negative."""
    if n_episodes < 1:
        raise ValueError(f"episodes is {n_episodes}; it must be at least 1")
    if seed < 0:
        raise ValueError(f"seed is {seed}; it must be at least 0")


def make_drawn(env_id: str, **options: Any) -> gym.Env:
    """Make an environment whose `render` returns pictures."""
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


def frame(env: gym.Env) -> np.ndarray:
    """Draw an environment; one error says whatever keeps it from being drawn."""
    try:
        return np.asarray(env.render(), dtype=np.uint8)
    except (RuntimeError, ValueError):
        raise
    except Exception as error:  # graphics libraries, and somebody's environment, raise anything
        raise RuntimeError(
            f"the task cannot be drawn here: {type(error).__name__}: {error}"
        ) from error


def labelled(image: np.ndarray, text: str) -> np.ndarray:
    """Write a line of text into the upper left corner of a picture (height, width, 3)."""
    pil = need("PIL.Image", "video").fromarray(image)
    font = need("PIL.ImageFont", "video").load_default(_LETTERS)
    need("PIL.ImageDraw", "video").Draw(pil).text((10, 8), text, fill=_INK, font=font)
    return np.asarray(pil)


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
