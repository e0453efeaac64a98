"""`sb3-follow-object demo`: a policy that came with the package plays its task."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

# Nothing heavier here: --help must not wait for torch.

POLICIES = Path(__file__).parent / "demo_policies"
_TASK = "PnPShelf"


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line's."""
    demo = subparsers.add_parser("demo", help="watch a trained robot, no training needed")
    demo.add_argument("task", nargs="?", default=_TASK, help=f"e.g. PushSideGap; default: {_TASK}")
    demo.add_argument("--episodes", type=int, default=5, metavar="N", help="default: 5")
    demo.add_argument("--seed", type=int, default=0, metavar="N", help="of the first episode")
    demo.add_argument(
        "--out",
        type=Path,
        metavar="FILE.mp4",
        help="film it; default: a window, or without a display demo-TASK.mp4",
    )


def run(args: argparse.Namespace) -> None:
    """Play some episodes in a window or into a film, and say how many succeeded."""
    from .pictures import check_counts, record

    policy, env_id = demo_policy(args.task), f"FollowObject/{_name(args.task)}-v0"
    check_counts(args.episodes, args.seed)

    def say(episode: int, success: bool) -> None:
        outcome = "success" if success else "the goal is missed"
        print(f"episode {episode + 1} of {args.episodes}: {outcome}", flush=True)

    print(f"{env_id}: the policy in {policy.name}, original goals, no noise", flush=True)
    out = args.out
    if out is None and _has_window():
        try:
            rate = _play_in_window(policy, env_id, args.episodes, args.seed, say)
        except _WindowClosed:
            print("the window was closed")
            return
    else:
        out = out or Path(f"demo-{_name(args.task)}.mp4")
        if out.suffix.lower() != ".mp4":
            raise ValueError(f"{out} does not end in .mp4, which is what is written")
        rate = record(policy, env_id, out, args.episodes, args.seed, say)
        print(out)
    print(f"success {rate:.2f} of {args.episodes}")


def demo_policy(task: str) -> Path:
    """The file of the trained policy that came with the package for a task.

    Args:
        task: its name or its id, e.g. "PnPShelf".

    Raises:
        ValueError: there is none for that task.
    """
    from ..common.suggestions import did_you_mean

    names = sorted(path.stem for path in POLICIES.glob("*.safetensors"))
    name = _name(task)
    if name not in names:
        raise ValueError(f"no policy for {task!r} came with the package{did_you_mean(name, names)}")
    return POLICIES / f"{name}.safetensors"


def _name(task: str) -> str:
    return task.removeprefix("FollowObject/").removesuffix("-v0")


def _has_window() -> bool:
    """Whether a window can be opened here."""
    from ..envs.graphics import WINDOWS, why_not

    if sys.platform == "darwin":  # MuJoCo opens its windows under a Python of its own only
        return "MJPYTHON_BIN" in os.environ
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return False
    return why_not(WINDOWS) is None


def _play_in_window(policy: Path, env_id: str, n_episodes: int, seed: int, say: Any) -> float:
    """Play at the pace of the simulated time."""
    import gymnasium as gym

    from ..ddpg.actor_files import load_actor
    from .pictures import play

    env = gym.make(env_id, render_mode="human")
    try:
        actor, _ = load_actor(policy, env.observation_space, env.action_space)  # type: ignore[arg-type]
        return play(actor, env, n_episodes, seed, _Pace(), say)
    finally:
        env.close()


class _WindowClosed(Exception):
    """Nobody looks any more."""


class _Pace:
    """Waits until a frame's time after the last call is over; raises when the window is closed."""

    def __init__(self) -> None:
        self._next = time.monotonic()

    def __call__(self, env: Any) -> None:
        if env.unwrapped.window_closed:
            raise _WindowClosed
        now = time.monotonic()
        time.sleep(max(0.0, self._next - now))
        self._next = max(self._next, now) + 1.0 / env.metadata["render_fps"]
