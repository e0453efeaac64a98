"""What can be written after `sb3-follow-object`, and what is said of what cannot."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

from ..settings.methods import METHODS, who_trains
from . import completion, demo, export, picture, report
from .picture_names import CURVE, VIDEO

# Nothing heavier here: --help must not wait for torch.

PROGRAM = "sb3-follow-object"
USER_ERROR = 2


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and what may have been meant, and exit with 2."""
        message += self._nearest(message)
        self.exit(USER_ERROR, f"{PROGRAM}: {message} (see {self.prog} --help)\n")

    def _nearest(self, message: str) -> str:
        """Return what may have been meant by a word that argparse does not know."""
        choice = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        option = re.search(r"unrecognized arguments: (--[\w-]+)", message)
        near: list[str] = []
        if choice and (who := who_trains(choice[1])):
            return f"; {who}"
        if choice:
            near = get_close_matches(choice[1], re.findall(r"[\w-]+", choice[2]), n=1)
        elif option:
            known = {*self._options()} - {option[1]}  # another command may have it
            near = get_close_matches(option[1], known, n=1, cutoff=0.7)
        return f"; did you mean {near[0]!r}?" if near else ""

    def _options(self) -> list[str]:
        """Return the options of this parser and of its commands."""
        known = list(self._option_string_actions)
        for action in self._actions:
            if isinstance(action.choices, dict):  # the commands
                known += [name for parser in action.choices.values() for name in parser._options()]
        return known


Command = Callable[[argparse.Namespace], None]


def make_parser(commands: Mapping[str, Command]) -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Args:
        commands: what each of the command names runs; comes back as `run_command`.
    """
    parser = Parser(prog=PROGRAM, description="Follow the Object for Stable-Baselines3.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    demo.add_parser(subparsers)
    _add_train(subparsers)
    _add_about_runs(subparsers)
    _add_compare(subparsers)
    report.add_parser(subparsers)
    picture.add_parser(subparsers)
    export.add_parser(subparsers)

    predictor = subparsers.add_parser("predictor", help="learn F_phi alone, stages one and two")
    predictor.set_defaults(method="fo")
    predictor.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    _add_settings(predictor)

    inspect = subparsers.add_parser("inspect", help="say what is found in a task of others")
    inspect.add_argument("--env", required=True, metavar="ID", help="e.g. FetchPush-v4")
    inspect.add_argument(
        "--out", type=Path, metavar="FILE.png", help="draw starts, goals and imagined goals"
    )
    inspect.add_argument(
        "--predictor", type=Path, metavar="FOLDER", help="that imagines; default: the kept one"
    )

    settings = subparsers.add_parser("settings", help="list what --set can change")
    settings.add_argument(
        "name", nargs="?", metavar="NAME", help="one of them, or a group, e.g. curriculum"
    )
    for name, subparser in subparsers.choices.items():
        subparser.set_defaults(run_command=commands[name])
    completion.add_shell_options(parser)
    return parser


def _add_train(subparsers: Any) -> None:
    """Add the command that trains in a run folder."""
    train = subparsers.add_parser("train", help="train a robot in a run folder")
    train.add_argument("--run", type=Path, required=True, metavar="FOLDER", help="run folder")
    _add_settings(train)
    train.add_argument("--method", choices=METHODS, help="default: fo")
    train.add_argument(
        "--steps",
        type=_whole,
        metavar="N",
        help="env steps, all stages counted; with --resume: other ones than before",
    )
    train.add_argument("--n-envs", type=int, metavar="N", help="parallel copies of the robot")
    train.add_argument(
        "--threads",
        type=int,
        metavar="N",
        help="threads of the simulation and of gradient steps",
    )
    again = train.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="go on with the run in the folder")
    again.add_argument(
        "--resume-or-start", action="store_true", help="go on if the folder holds a run, else start"
    )
    train.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _add_about_runs(subparsers: Any) -> None:
    """Add the commands that test, film and draw what is in run folders."""
    evaluate = subparsers.add_parser("evaluate", help="test a run's policy on original goals")
    evaluate.add_argument("run", type=Path, help="folder with policy.safetensors and config.json")
    evaluate.add_argument("--episodes", type=int, default=380, metavar="N", help="default: 380")
    evaluate.add_argument("--seed", type=int, metavar="N", help="of the episodes; default: run's")
    evaluate.add_argument(
        "--env", metavar="ID", help="another task; the figure is kept in RUN for plot --results"
    )
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")

    watch = subparsers.add_parser("watch", help="film a run's policy")
    watch.add_argument("run", type=Path, help="folder with policy.safetensors and config.json")
    watch.add_argument("--episodes", type=int, default=5, metavar="N", help="default: 5")
    watch.add_argument("--seed", type=int, default=0, metavar="N", help="of the episodes")
    watch.add_argument("--out", type=Path, metavar="FILE.mp4", help=f"default: RUN/{VIDEO}")

    plot = subparsers.add_parser("plot", help="draw success and k_max of one or several runs")
    plot.add_argument("runs", type=Path, nargs="*", metavar="RUN", help="run folders")
    plot.add_argument(
        "--results", type=Path, metavar="FOLDER", help="draw the paper's figures of all runs in it"
    )
    plot.add_argument(
        "--out",
        type=Path,
        metavar="PATH",
        help=f"PNG, default: RUN/{CURVE}, or of several {CURVE}; of --results a folder",
    )


def _add_compare(subparsers: Any) -> None:
    """Add the command that runs a grid."""
    compare = subparsers.add_parser("compare", help="run a grid of tasks, methods and seeds")
    compare.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="of the results")
    compare.add_argument("--tasks", nargs="+", required=True, metavar="TASK", help="e.g. PnPShelf")
    compare.add_argument(
        "--methods", nargs="+", required=True, metavar="METHOD", help="e.g. fo her"
    )
    compare.add_argument(
        "--seeds", nargs="+", type=int, default=[0], metavar="N", help="default: 0"
    )
    compare.add_argument("--steps", type=_whole, metavar="N", help="env steps of each run")
    compare.add_argument("--preset", choices=("default", "paper"), default="default")
    _add_set(compare)
    compare.add_argument(
        "--paper-evaluation",
        action="store_true",
        help="validate on 380 episodes after each of the paper's epochs of 1,900 episodes",
    )
    compare.add_argument("--jobs", type=int, metavar="N", help="runs at once; default: as fit")
    compare.add_argument("--threads", type=int, metavar="N", help="cores of each run")
    compare.add_argument("--ray", metavar="ADDRESS", help="of a Ray cluster, or local")
    compare.add_argument(
        "--retry-failed", action="store_true", help="try runs again that were given up"
    )
    compare.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Options that say which task is trained and how."""
    parser.add_argument("--env", metavar="ID", help="task, e.g. FollowObject/PnPShelf-v0")
    parser.add_argument("--seed", type=int, metavar="N", help="decides the whole run; default: 0")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--preset", choices=("default", "paper"), help="settings of the package")
    source.add_argument("--config", type=Path, metavar="FILE.yml", help="settings of your own")
    _add_set(parser)


def _whole(text: str) -> int:
    """Read a whole number, also as 1e6 and 1_000_000."""
    try:
        return int(text)
    except ValueError:
        with suppress(ValueError):
            if (number := float(text)).is_integer():
                return int(number)
        raise argparse.ArgumentTypeError(f"invalid int value: {text!r}") from None


def _add_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set",
        action="extend",
        nargs="+",
        default=[],
        metavar="KEY.SUB=VALUE",
        help="change one setting, e.g. curriculum.p=0.5; may be repeated; "
        f"`{PROGRAM} settings` lists them",
    )
