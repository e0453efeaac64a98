"""Moving pictures in one file: the story that README shows, the film in TensorBoard's log."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ..common.extras import MissingExtra, need
from ..common.files import atomic_write
from ..ddpg.actor_files import load_actor
from ..envs import IDS, object_id
from ..envs.batch import MAX_DISPLACEMENT
from ..imagination.goal_predictor import GoalPredictor
from ..runs.run_folder import POLICY, trained_steps
from .pictures import EachStep, frame, imagined_way, labelled, make_drawn, play

_SIDE = 300  # pixels of a panel of the story
_COLOURS = 256
_FRAME_MS = 40  # an env step
_HOLD_MS = 1500  # the last frame
_TRIES = 20  # episodes, until one succeeds
_UNSEEN = (0.0, 0.0, -5.0)
_TAG = "film/last_policy_on_original_goals"


def draw_story(
    policy_file: str | os.PathLike[str],
    predictor: GoalPredictor,
    env_id: str,
    out: str | os.PathLike[str],
    seed: int = 0,
) -> None:
    """Write the method as three moving panels: object alone, imagined goals, robot.

    On the left the object is pulled along the way that F_phi imagines for it (paper, section 4.1),
    in the middle the goals on it appear level by level (4.2), on the right the trained robot brings
    the object to the original goal.

    Args:
        policy_file: written by `save_actor`.
        predictor: F_phi of the task.
        env_id: a task of this package.
        out: GIF file to create or replace.
        seed: of the episode; the first from it on in which the robot succeeds is shown.

    Raises:
        MissingExtra: imageio and Pillow are not installed.
        RuntimeError: there is nothing to draw with, or the robot does not succeed in 20 episodes.
        ValueError: the policy does not fit the task.
    """
    seed = _first_success(policy_file, env_id, seed)
    robot = _episode(policy_file, env_id, seed)
    imagined, path = _imagined_frames(predictor, env_id, seed, len(robot))
    alone = _object_frames(env_id, path, seed)
    panels = zip(
        _small(alone, "1  the object alone"),
        _small(imagined, "2  imagined goals"),
        _small(robot, "3  the robot"),
        strict=True,
    )
    atomic_write(out, gif([np.concatenate(row, axis=1) for row in panels], _FRAME_MS, _HOLD_MS))


def add_film(run: Path, env_id: str, seed: int = 0) -> None:
    """Add a film of a run's policy to its log for TensorBoard, if there is TensorBoard.

    Args:
        run: folder of a run.
        env_id: its task.
        seed: of the episode.
    """
    try:
        need("tensorboard", "plots")
        summaries = need("tensorboard.compat.proto.summary_pb2", "plots")
        tensorboard = need("torch.utils.tensorboard", "plots")
    except MissingExtra:
        return
    frames = _episode(run / POLICY, env_id, seed)
    height, width, _ = frames[0].shape
    picture = gif(frames, _FRAME_MS, _HOLD_MS)
    image = summaries.Summary.Image(
        height=height, width=width, colorspace=3, encoded_image_string=picture
    )
    value = summaries.Summary.Value(tag=_TAG, image=image)
    with tensorboard.SummaryWriter(run) as writer:
        writer._get_file_writer().add_summary(
            summaries.Summary(value=[value]), trained_steps(run) or 0
        )


def gif(frames: Sequence[np.ndarray], frame_ms: int, last_ms: int) -> bytes:
    """Return frames (height, width, 3) of uint8 as an animated GIF that begins anew at its end.

    Args:
        frames: at least 1.
        frame_ms: for which each is shown, milliseconds.
        last_ms: for which the last one is.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    pil = need("PIL.Image", "video")
    few = np.concatenate(frames[:: max(1, len(frames) // 4)])
    # Of the ways to choose colours the one that keeps those of small things, as goals are.
    palette = pil.fromarray(few).quantize(_COLOURS, pil.Quantize.MAXCOVERAGE)
    images = [pil.fromarray(each).quantize(palette=palette, dither=0) for each in frames]
    durations = [frame_ms] * (len(images) - 1) + [last_ms]
    file = io.BytesIO()
    images[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=images[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )
    return file.getvalue()


def _episode(policy_file: Any, env_id: str, seed: int) -> list[np.ndarray]:
    """Play an episode; return its frames."""
    frames: list[np.ndarray] = []
    _play(policy_file, make_drawn(env_id), [seed], lambda env: frames.append(frame(env)))
    return frames


def _first_success(policy_file: Any, env_id: str, seed: int) -> int:
    """Return the seed of the first episode that succeeds; drawing the tries would take long."""
    if env_id not in IDS:
        raise ValueError(f"{env_id!r} is no task of this package, which the story is drawn of")
    tries = range(seed, seed + _TRIES)
    success = _play(policy_file, gym.make(env_id), tries, lambda env: None)
    if success is None:
        raise RuntimeError(f"the robot of {policy_file} does not succeed in {_TRIES} episodes")
    return success


def _play(policy_file: Any, env: gym.Env, seeds: Sequence[int], each_step: EachStep) -> int | None:
    """Play an episode of each seed until one succeeds; return its seed, or None."""
    try:
        actor, _ = load_actor(policy_file, env.observation_space, env.action_space)  # type: ignore[arg-type]
        succeeds = (seed for seed in seeds if play(actor, env, 1, seed, each_step))
        return next(succeeds, None)
    finally:
        env.close()


def _imagined_frames(
    predictor: GoalPredictor, env_id: str, seed: int, n: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Draw n frames in which the goals appear; return them and the imagined path (T + 1, 3)."""
    env = make_drawn(env_id)
    try:
        obs, _ = env.reset(seed=seed)
        way, frames = imagined_way(predictor, obs, np.zeros(0)), []
        for level in np.linspace(0, len(way), n).round().astype(int):
            shown = way.copy()
            shown[level:] = _UNSEEN  # all are drawn, so that each keeps its colour
            env.unwrapped.set_markers(shown)  # type: ignore[attr-defined]
            frames.append(frame(env))
        path = predictor.paths(obs["achieved_goal"][None], obs["desired_goal"][None])[0]
        return frames, path
    finally:
        env.close()


def _object_frames(env_id: str, path: np.ndarray, seed: int) -> list[np.ndarray]:
    """Draw the object alone, pulled along a path of positions (T + 1, 3)."""
    env = gym.make(object_id(env_id), render_mode="rgb_array")
    try:
        obs, _ = env.reset(seed=seed)
        frames = [frame(env)]
        for target in path[1:]:
            action = np.zeros(env.action_space.shape or (), np.float32)
            pull = (target - obs["achieved_goal"]) / MAX_DISPLACEMENT
            action[:3] = np.clip(pull, -1.0, 1.0)
            obs, *_ = env.step(action)
            frames.append(frame(env))
        return frames
    finally:
        env.close()


def _small(frames: Sequence[np.ndarray], text: str) -> list[np.ndarray]:
    pil = need("PIL.Image", "video")
    size = (_SIDE, _SIDE)
    return [
        labelled(np.asarray(pil.fromarray(each).resize(size, pil.Resampling.LANCZOS)), text)
        for each in frames
    ]
