"""The command `sb3-follow-object`: train, evaluate, watch, plot, predictor."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

# Nothing heavier here: --help must not wait for torch. The commands import what they use.

if TYPE_CHECKING:
    from .experiment import RunConfig

PROGRAM = "sb3-follow-object"
USER_ERROR, INTERRUPTED = 2, 130


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USER_ERROR, f"{PROGRAM}: {message} (see {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status: 0, 2 on bad input, 130 on Ctrl-C.

    Args:
        argv: the arguments after the program's name; by default the process's.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    args = _parser().parse_args(arguments)
    args.command_line = shlex.join([PROGRAM, *arguments])
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # must stand before mujoco is imported
    try:
        args.run_command(args)
    except (ValueError, OSError) as error:
        print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        hint = "interrupted"
        if args.run_command is _train:
            hint += f"; go on with: {PROGRAM} train --resume --run {shlex.quote(str(args.run))}"
        print(f"{PROGRAM}: {hint}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROGRAM, description="Follow the Object for Stable-Baselines3.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train a robot in a run folder")
    train.set_defaults(run_command=_train)
    train.add_argument("--run", type=Path, required=True, metavar="FOLDER", help="run folder")
    _add_settings(train)
    train.add_argument("--method", choices=("fo", "her"), help="default: fo")
    train.add_argument("--steps", type=int, metavar="N", help="env steps, all stages counted")
    train.add_argument("--n-envs", type=int, metavar="N", help="parallel copies of the robot")
    train.add_argument(
        "--threads", type=int, metavar="N", help="threads of the simulation and of PyTorch"
    )
    again = train.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="go on with the run in the folder")
    again.add_argument(
        "--resume-or-start", action="store_true", help="go on if the folder holds a run, else start"
    )
    train.add_argument("--quiet", action="store_true", help="print nothing but errors")

    evaluate = commands.add_parser("evaluate", help="test a run's policy on original goals")
    evaluate.set_defaults(run_command=_evaluate)
    evaluate.add_argument("run", type=Path, help="folder with policy.safetensors and config.json")
    evaluate.add_argument("--episodes", type=int, default=380, metavar="N", help="default: 380")
    evaluate.add_argument("--seed", type=int, metavar="N", help="of the episodes; default: run's")
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Options that say which task is trained and how."""
    parser.add_argument("--env", metavar="ID", help="task, e.g. FollowObject/PnPShelf-v0")
    parser.add_argument("--seed", type=int, metavar="N", help="decides the whole run; default: 0")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--preset", choices=("default", "paper"), help="settings of the package")
    source.add_argument("--config", type=Path, metavar="FILE.yml", help="settings of your own")
    parser.add_argument(
        "--set",
        action="extend",
        nargs="+",
        default=[],
        metavar="KEY.SUB=VALUE",
        help="change one setting, e.g. curriculum.p=0.5; may be repeated",
    )


def _train(args: argparse.Namespace) -> None:
    from .experiment import CONFIG, train
    from .progress import ProgressBar

    resume = args.resume or (args.resume_or_start and (args.run / CONFIG).exists())
    config = _resumed_config(args) if resume else _config(args)
    with ProgressBar(config.total_timesteps, quiet=args.quiet) as bar:
        result = train(
            config,
            args.run,
            resume=resume,
            report=bar.say,
            progress=bar.update,
            command=args.command_line,
        )
    if not args.quiet:
        row = {name: result[name] for name in ("task", "method", "seed", "env_steps")}
        row |= {"minutes": result["wall_s"] / 60.0, "k_max": result["k_max"]}
        _print_table(row | {name: result[name] for name in ("episodes", "success_rate")})


def _config(args: argparse.Namespace) -> RunConfig:
    """Return the configuration that the flags describe."""
    from .config import parse_override, run_config

    if args.env is None:
        raise ValueError("say which task to train with --env, e.g. --env FollowObject/PnPShelf-v0")
    overrides = {"n_timesteps": args.steps, "n_envs": args.n_envs}
    overrides |= {"n_threads": args.threads, "torch_threads": args.threads}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    return run_config(
        args.env,
        method=args.method,
        preset=args.preset or "default",
        file=args.config,
        seed=args.seed or 0,
        overrides=overrides | dict(parse_override(text) for text in args.set),
    )


def _resumed_config(args: argparse.Namespace) -> RunConfig:
    """Return the folder's configuration; flags may repeat it but not change it."""
    from .config import load_config

    config = load_config(args.run)
    said = {
        "env": (args.env, config.env_id),
        "method": (args.method, config.method),
        "seed": (args.seed, config.seed),
        "steps": (args.steps, config.total_timesteps),
        "n-envs": (args.n_envs, config.settings.get("n_envs")),
        "threads": (args.threads, config.torch_threads),
    }
    for name, (given, kept) in said.items():
        if given is not None and given != kept:
            raise ValueError(f"the run in {args.run} has --{name} {kept}, not {given}")
    if args.set or args.config or args.preset:
        args.env, args.method, args.seed = config.env_id, config.method, config.seed
        return _config(args)  # train() compares it with the folder's
    return config


def _evaluate(args: argparse.Namespace) -> None:
    from .config import load_config
    from .experiment import POLICY, evaluate, trained_steps

    config = load_config(args.run)
    seed = config.seed if args.seed is None else args.seed
    episodes = evaluate(args.run / POLICY, config.env_id, args.episodes, seed)
    result = {
        "env": config.env_id,
        "method": config.method,
        "seed": config.seed,
        "episodes": args.episodes,
        "success_rate": episodes.success_rate,
        "env_steps": trained_steps(args.run),
    }
    if args.json:
        print(json.dumps(result))
    else:
        _print_table(result)


def _print_table(row: dict[str, Any]) -> None:
    """Print one result."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*row)
    table.add_row(*map(_cell, row.values()))
    Console().print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
