"""`sb3-follow-object picture`: tasks side by side, imagined goals, the method moving."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

# Nothing heavier here: --help must not wait for torch.

_ENDINGS = {"tasks": ".png", "imagined": ".png", "story": ".gif"}


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line's."""
    picture = subparsers.add_parser("picture", help="draw tasks, imagined goals, the method")
    picture.add_argument(
        "what",
        choices=list(_ENDINGS),
        help="tasks: all side by side, or that of --env; imagined: goals of a RUN; story: object "
        "alone, imagined goals and robot of a RUN, moving",
    )
    picture.add_argument("run", type=Path, nargs="?", metavar="RUN", help="folder of a run")
    picture.add_argument("--env", metavar="ID", help="of tasks: this one alone")
    picture.add_argument("--seed", type=int, default=0, metavar="N", help="of the episode")
    picture.add_argument("--out", type=Path, metavar="FILE", help="default: WHAT.png or .gif")


def run(args: argparse.Namespace) -> None:
    """Draw what is asked for and print its name."""
    out = args.out or Path(args.what + _ENDINGS[args.what]).absolute()
    if out.suffix.lower() != _ENDINGS[args.what]:
        raise ValueError(f"{out} does not end in {_ENDINGS[args.what]}, which is what is written")
    if args.seed < 0:
        raise ValueError(f"seed is {args.seed}; it must be at least 0")
    if (args.run is None) != (args.what == "tasks"):
        wanted = "takes no RUN" if args.what == "tasks" else "needs the folder of a RUN"
        raise ValueError(f"picture {args.what} {wanted}")
    if args.env is not None and args.what != "tasks":
        raise ValueError(f"picture {args.what} takes no --env; a RUN says which task it is of")
    if args.env is not None:
        from ..envs.goal_envs import check_task
        from .pictures import draw_task

        draw_task(check_task(args.env), out, args.seed)
    elif args.what == "tasks":
        from .pictures import draw_tasks

        draw_tasks(out, args.seed)
    else:
        _draw_run(args.what, args.run, out, args.seed)
    print(out)


def _draw_run(what: str, run: Path, out: Path, seed: int) -> None:
    from ..imagination.goal_predictor import GoalPredictor
    from ..runs.object_stage_files import PREDICTOR
    from ..runs.run_folder import POLICY
    from ..settings.presets import load_config
    from .films import draw_story
    from .pictures import draw_imagined

    env_id = load_config(run).env_id
    predictor = GoalPredictor.load(run / PREDICTOR, env_id=env_id)
    if what == "imagined":
        draw_imagined(env_id, predictor, out, seed)
    else:
        draw_story(run / POLICY, predictor, env_id, out, seed)
