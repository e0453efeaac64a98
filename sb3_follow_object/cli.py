"""The command `sb3-follow-object`: train, evaluate, watch, plot, compare, predictor."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from .methods import METHODS

# Nothing heavier here: --help must not wait for torch. The commands import what they use.

if TYPE_CHECKING:
    from .experiment import RunConfig

PROGRAM = "sb3-follow-object"
# Settings that only runs with imagined goals read.
_OF_IMAGINED = (
    "curriculum",
    "predictor_fit",
    "n_paths",
    "test_every",
    "n_test_episodes",
    "store_tests",
)
USER_ERROR, INTERRUPTED = 2, 130
CURVE, VIDEO = "curve.png", "video.mp4"


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        message += self._nearest(message)
        self.exit(USER_ERROR, f"{PROGRAM}: {message} (see {self.prog} --help)\n")

    def _nearest(self, message: str) -> str:
        """Return what may have been meant by a word that argparse does not know."""
        choice = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        option = re.search(r"unrecognized arguments: (--[\w-]+)", message)
        near: list[str] = []
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


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status: 0, 2 on bad input, 130 on Ctrl-C.

    Args:
        argv: the arguments after the program's name; by default the process's.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    args = _parser().parse_args(arguments)
    args.command_line = shlex.join([PROGRAM, *arguments])
    try:
        args.run_command(args)
    except (ValueError, OSError, RuntimeError, MemoryError, OverflowError) as error:
        print(f"{PROGRAM}: {_sentence(error)}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        hint = "interrupted"
        if args.run_command is _train and args.run.exists():
            hint += f"; go on with: {PROGRAM} train --resume --run {shlex.quote(str(args.run))}"
        if args.run_command is _compare:
            hint += "; the same command goes on where it stopped"
        print(f"{PROGRAM}: {hint}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _sentence(error: Exception) -> str:
    """Say in one line what went wrong."""
    if isinstance(error, MemoryError):
        return f"there is not enough memory ({error})"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.strerror}: {error.filename}"
    return " ".join(str(error).split())


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROGRAM, description="Follow the Object for Stable-Baselines3.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_train(commands)
    _add_about_runs(commands)
    _add_compare(commands)

    predictor = commands.add_parser("predictor", help="learn F_phi alone, stages one and two")
    predictor.set_defaults(run_command=_predictor, method="fo")
    predictor.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    _add_settings(predictor)
    return parser


def _add_train(commands: Any) -> None:
    """Add the command that trains in a run folder."""
    train = commands.add_parser("train", help="train a robot in a run folder")
    train.set_defaults(run_command=_train)
    train.add_argument("--run", type=Path, required=True, metavar="FOLDER", help="run folder")
    _add_settings(train)
    train.add_argument("--method", choices=METHODS, help="default: fo")
    train.add_argument(
        "--steps",
        type=int,
        metavar="N",
        help="env steps, all stages counted; with --resume: other ones than before",
    )
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


def _add_about_runs(commands: Any) -> None:
    """Add the commands that test, film and draw what is in run folders."""
    evaluate = commands.add_parser("evaluate", help="test a run's policy on original goals")
    evaluate.set_defaults(run_command=_evaluate)
    evaluate.add_argument("run", type=Path, help="folder with policy.safetensors and config.json")
    evaluate.add_argument("--episodes", type=int, default=380, metavar="N", help="default: 380")
    evaluate.add_argument("--seed", type=int, metavar="N", help="of the episodes; default: run's")
    evaluate.add_argument(
        "--env", metavar="ID", help="another task; the figure is kept in RUN for plot --results"
    )
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")

    watch = commands.add_parser("watch", help="film a run's policy")
    watch.set_defaults(run_command=_watch)
    watch.add_argument("run", type=Path, help="folder with policy.safetensors and config.json")
    watch.add_argument("--episodes", type=int, default=5, metavar="N", help="default: 5")
    watch.add_argument("--seed", type=int, default=0, metavar="N", help="of the episodes")
    watch.add_argument("--out", type=Path, metavar="FILE.mp4", help=f"default: RUN/{VIDEO}")

    plot = commands.add_parser("plot", help="draw success and k_max of one or several runs")
    plot.set_defaults(run_command=_plot)
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


def _add_compare(commands: Any) -> None:
    """Add the command that runs a grid."""
    compare = commands.add_parser("compare", help="run a grid of tasks, methods and seeds")
    compare.set_defaults(run_command=_compare)
    compare.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="of the results")
    compare.add_argument("--tasks", nargs="+", required=True, metavar="TASK", help="e.g. PnPShelf")
    compare.add_argument(
        "--methods", nargs="+", required=True, metavar="METHOD", help="e.g. fo her"
    )
    compare.add_argument(
        "--seeds", nargs="+", type=int, default=[0], metavar="N", help="default: 0"
    )
    compare.add_argument("--steps", type=int, metavar="N", help="env steps of each run")
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


def _add_set(parser: argparse.ArgumentParser) -> None:
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
        _illustrate(args.run, config, bar.say)
    if not args.quiet:
        row = {name: result[name] for name in ("task", "method", "seed", "k_max")}
        row |= {"env steps": f"{result['env_steps']:,}", "minutes": result["wall_s"] / 60.0}
        _print_table({**row, "success": f"{result['success_rate']:.3f} of {result['episodes']}"})


def _illustrate(run: Path, config: RunConfig, say: Callable[[str], None]) -> None:
    """Draw what a finished run folder has no new picture of; say what could not be drawn."""
    from .experiment import POLICY, PREDICTOR, RESULT
    from .goal_predictor import GoalPredictor
    from .pictures import draw_imagined, draw_task, record
    from .plots import draw_curves

    env_id = config.env_id
    makers: dict[str, Callable[[Path], Any]] = {
        CURVE: lambda out: draw_curves([run], out),
        "task.png": lambda out: draw_task(env_id, out),
    }
    if (run / PREDICTOR).exists():
        predictor = GoalPredictor.load(run / PREDICTOR, env_id=env_id)
        makers["imagined.png"] = lambda out: draw_imagined(env_id, predictor, out)
    makers[VIDEO] = lambda out: record(run / POLICY, env_id, out)
    failed: dict[str, list[str]] = {}
    for name, make in makers.items():
        picture = run / name
        if picture.exists() and picture.stat().st_mtime >= (run / RESULT).stat().st_mtime:
            continue
        try:
            make(run / name)
        except Exception as error:  # graphics drivers raise anything; the run itself is done
            failed.setdefault(" ".join(str(error).split()), []).append(name)
    for reason, names in failed.items():
        say(f"left out {', '.join(names)}: {reason}")


def _config(args: argparse.Namespace) -> RunConfig:
    """Return the configuration that the flags describe."""
    from .config import parse_override, run_config

    if args.env is None:
        raise ValueError("say which task to train with --env, e.g. --env FollowObject/PnPShelf-v0")
    overrides = {"n_timesteps": args.steps, "n_envs": args.n_envs}
    overrides |= {"n_threads": args.threads, "torch_threads": args.threads}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    config = run_config(
        args.env,
        method=args.method,
        preset=args.preset or "default",
        file=args.config,
        seed=args.seed or 0,
        overrides=overrides | dict(parse_override(text) for text in args.set),
    )
    for text in args.set:
        if text.split("=")[0].split(".")[0] in _OF_IMAGINED and not config.settings["imagine"]:
            raise ValueError(
                f"--set {text} does nothing: method {config.method!r} imagines no goals"
            )
    return config


def _resumed_config(args: argparse.Namespace) -> RunConfig:
    """Return the folder's configuration; flags may repeat it and change only the steps."""
    from .config import load_config

    config = load_config(args.run)
    if args.steps is not None:
        config = dataclasses.replace(config, total_timesteps=args.steps)
    said = {
        "env": (args.env, config.full_id),
        "method": (args.method, config.method),
        "seed": (args.seed, config.seed),
        "n-envs": (args.n_envs, config.settings.get("n_envs")),
        "threads": (args.threads, config.torch_threads),
    }
    for name, (given, kept) in said.items():
        if given is not None and given != kept:
            raise ValueError(f"the run in {args.run} has --{name} {kept}, not {given}")
    if args.set or args.config or args.preset:
        args.env, args.method, args.seed = config.full_id, config.method, config.seed
        args.steps = config.total_timesteps
        return _config(args)  # train() compares it with the folder's
    return config


def _evaluate(args: argparse.Namespace) -> None:
    from .config import load_config
    from .cross import cross_test
    from .experiment import POLICY, evaluate, trained_steps

    config = load_config(args.run)
    env_id = args.env or config.env_id
    seed = config.seed if args.seed is None else args.seed
    if env_id in (config.env_id, config.full_id):
        rate = evaluate(args.run / POLICY, env_id, args.episodes, seed).success_rate
    else:
        rate = cross_test(args.run, env_id, args.episodes, seed)
    result = {
        "env": env_id,
        "method": config.method,
        "seed": config.seed,
        "episodes": args.episodes,
        "success_rate": rate,
        "env_steps": trained_steps(args.run),
    }
    if args.json:
        print(json.dumps(result))
    else:
        _print_table(result)


def _watch(args: argparse.Namespace) -> None:
    from .config import load_config
    from .experiment import POLICY
    from .pictures import record

    config = load_config(args.run)
    out = _named(args.out or args.run / VIDEO, ".mp4")
    rate = record(args.run / POLICY, config.env_id, out, args.episodes, args.seed)
    print(f"{out}: {args.episodes} episodes, success {rate:.2f}")


def _plot(args: argparse.Namespace) -> None:
    from .figures import draw_results
    from .plots import draw_curves

    if bool(args.runs) == bool(args.results):
        raise ValueError("give either run folders or --results FOLDER, a folder of run folders")
    if args.results:
        for path in draw_results(args.results, args.out or args.results / "figures"):
            print(path)
        return
    out = args.out or (args.runs[0] / CURVE if len(args.runs) == 1 else Path(CURVE))
    draw_curves(args.runs, _named(out, ".png"))
    print(out)


def _named(out: Path, ending: str) -> Path:
    """Return a file's path, if its name says what will be in it."""
    if out.suffix.lower() != ending:
        raise ValueError(f"{out} does not end in {ending}, which is what is written")
    return out


def _compare(args: argparse.Namespace) -> None:
    from .compare import Comparison, share_cores, write_report
    from .config import parse_override
    from .envs.batch import cores
    from .executors import Executor, LocalExecutor
    from .files import lock
    from .grid import LOGS, Settings, plan
    from .grid_display import GridDisplay

    overrides = dict(parse_override(text) for text in args.set)
    settings = Settings(args.steps, args.preset, overrides, args.paper_evaluation)
    grid = (args.out, args.tasks, args.methods, args.seeds, settings)
    n_runs = len(plan(*grid))  # what cannot be meant is refused before a cluster is asked for
    executor: Executor
    if args.ray is None:
        jobs, threads = share_cores(cores(), n_runs, args.jobs, args.threads)
        executor = LocalExecutor(jobs, args.out / LOGS)
    else:
        from .ray_executor import RayExecutor, connect

        jobs, threads = share_cores(
            connect(args.ray, args.threads or 1), n_runs, args.jobs, args.threads or 1
        )
        executor = RayExecutor(jobs)
    args.out.mkdir(parents=True, exist_ok=True)
    with lock(args.out, wait=False), GridDisplay(quiet=args.quiet) as display:
        comparison = Comparison(
            args.out, plan(*grid, threads), settings, executor, threads, display, args.retry_failed
        )
        try:
            failed = comparison.run()
        finally:
            write_report(args.out, display.say)
    if not args.quiet:
        print((args.out / "table.md").read_text(), end="")
    if failed:
        raise RuntimeError(f"{len(failed)} of {n_runs} runs failed: {', '.join(failed)}")


def _predictor(args: argparse.Namespace) -> None:
    import torch as th

    from .predictors import learn_predictor

    args.steps = args.n_envs = args.threads = None
    config = _config(args)
    if args.out.exists() and not (args.out.is_dir() and not any(args.out.iterdir())):
        raise ValueError(f"{args.out} is not empty; give another folder")
    th.set_num_threads(config.torch_threads)
    learn_predictor(config, args.out)
    print(args.out)


def _print_table(row: dict[str, Any]) -> None:
    """Print one result."""
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for name in row:
        table.add_column(name, overflow="fold")  # of names that differ in their last letter only
    table.add_row(*map(_cell, row.values()))
    Console().print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
