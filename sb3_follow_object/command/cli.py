"""The command `sb3-follow-object` and what each of its commands runs."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.reports import Report, Trouble, reason
from ..settings.methods import check_methods
from . import demo, export, picture, report
from .arguments import (
    check_agreed,
    make_absolute,
    overrides_of,
    policy_of,
    said_with_set,
    shell_line,
)
from .cli_options import PROGRAM, USER_ERROR, make_parser
from .picture_names import CURVE, IMAGINED, TASK, VIDEO
from .streams import leave_streams, open_streams

# Nothing heavier here: --help must not wait for torch. The commands import what they use.

if TYPE_CHECKING:
    from ..settings.run_config import RunConfig

INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status: 0, 2 on bad input, 130 on Ctrl-C.

    Args:
        argv: the arguments after the program's name; by default the process's.
    """
    open_streams()
    try:
        return _run(sys.argv[1:] if argv is None else list(argv))
    finally:
        leave_streams()


def _run(arguments: list[str]) -> int:
    # Read as PyTorch is imported. Its threads wait for each other less greedily: with the default
    # of 300,000 turns two of them that share a core for a moment hold each other up.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    args = argparse.Namespace(run_command=None)  # until it is read
    try:
        make_parser(_COMMANDS).parse_args(arguments, args)
        make_absolute(args)
        args.command_line = shell_line([PROGRAM, *arguments])
        args.run_command(args)
    except (ValueError, OSError, RuntimeError, MemoryError, OverflowError) as error:
        print(f"{PROGRAM}: {_sentence(error)}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        from ..settings.run_config import CONFIG

        hint = "interrupted"
        if args.run_command is _train and (args.run / CONFIG).exists():
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
    said = reason(error)
    if isinstance(error, ValueError):
        from ..envs.goal_envs import SAY_GOALS

        if said.endswith(SAY_GOALS):  # which Python alone can
            said += (
                ", as arguments of RobotTask in a module of your own (docs/tutorials/own_robot.md)"
            )
    return said


def _train(args: argparse.Namespace) -> None:
    from ..runs.experiment import train
    from ..runs.progress import ProgressBar
    from ..runs.run_folder import CONFIG

    folder = args.run
    resume = args.resume or (args.resume_or_start and (folder / CONFIG).exists())
    config = _resumed_config(args) if resume else _config(args)
    with ProgressBar(config.total_timesteps, quiet=args.quiet) as bar:
        result = train(
            config,
            folder,
            resume=resume,
            report=bar.say,
            progress=bar.update,
            command=args.command_line,
        )
    if not args.quiet:
        row = {name: result.get(name) for name in ("task", "method", "seed", "k_max")}
        row |= {"minutes": result["wall_s"] / 60.0, **_outcome(result)}
        try:
            _print_table(row)
        except OSError as error:
            bar.say(Trouble(f"the result is in {folder}, but not printed: {reason(error)}"))
    # Last, since no graphics library is to be trusted with a result that nobody has seen.
    _illustrate(folder, config, bar.say)


def _illustrate(run: Path, config: RunConfig, say: Callable[[str], None]) -> None:
    """Draw what a finished run folder has no new picture of; say what could not be drawn."""
    from ..runs.object_stage_files import PREDICTOR
    from ..runs.run_folder import POLICY, RESULT

    env_id = config.env_id

    def draw(name: str) -> None:
        from ..comparison.plots import draw_curves
        from ..imagination.goal_predictor import GoalPredictor
        from .films import add_film
        from .pictures import draw_imagined, draw_task, record

        out = run / name
        if name == CURVE:
            draw_curves([run], out)
        elif name == TASK:
            draw_task(env_id, out)
        elif name == IMAGINED:
            draw_imagined(env_id, GoalPredictor.load(run / PREDICTOR, env_id=env_id), out)
        else:
            record(run / POLICY, env_id, out)
            add_film(run, env_id)

    failed: dict[str, list[str]] = {}
    for name in (CURVE, TASK, IMAGINED, VIDEO):
        if name == IMAGINED and not (run / PREDICTOR).exists():
            continue
        try:
            picture = run / name
            if picture.exists() and picture.stat().st_mtime >= (run / RESULT).stat().st_mtime:
                continue
            draw(name)
        except Exception as error:  # graphics drivers raise anything; the run itself is done
            failed.setdefault(reason(error), []).append(name)
    for why, names in failed.items():
        say(f"left out {', '.join(names)}: {why}")


def _config(args: argparse.Namespace) -> RunConfig:
    """Return the configuration that the flags describe."""
    from ..comparison.cells import unread
    from ..settings.presets import run_config

    if args.env is None:
        raise ValueError("say which task to train with --env, e.g. --env FollowObject/PnPShelf-v0")
    config = run_config(
        args.env,
        method=args.method,
        preset=args.preset or "default",
        file=args.config,
        seed=args.seed or 0,
        overrides=overrides_of(args),
        report=_told(args),
    )
    for text in args.set:
        if why := unread(text.split("=")[0], config):
            raise ValueError(f"--set {text} does nothing: {why}")
    return config


def _resumed_config(args: argparse.Namespace) -> RunConfig:
    """Return the folder's configuration; flags may repeat it and change only the steps."""
    from ..envs.task_table import BUILT_IN
    from ..settings.presets import load_config
    from ..settings.stages import StageSettings

    config = load_config(args.run)
    if args.steps is not None:
        config = dataclasses.replace(config, total_timesteps=args.steps)
    stages = config.settings
    env = args.env and args.env.rpartition(":")[2]
    said: dict[str, tuple[Any, list[Any]]] = {
        "env": (env if env in BUILT_IN else args.env, [config.full_id]),
        "method": (args.method, [config.method]),
        "seed": (args.seed, [config.seed]),
        "n-envs": (args.n_envs, [stages.get("n_envs", StageSettings.n_envs)]),
        # --set may have given one of the two numbers that the flag gives
        "threads": (args.threads, [config.torch_threads, stages.get("n_threads")]),
    }
    for name, (given, kept) in said.items():
        if given is not None and given not in kept:
            raise ValueError(f"the run in {args.run} has --{name} {kept[0]}, not {given}")
    if args.set or args.config or args.preset:
        args.env, args.method, args.seed = config.full_id, config.method, config.seed
        if not any(text.startswith("n_timesteps=") for text in args.set):
            args.steps = config.total_timesteps
        return _config(args)  # train() compares it with the folder's
    return config


def _evaluate(args: argparse.Namespace) -> None:
    from ..comparison.cross import cross_test
    from ..imagination.predictor_files import without_module
    from ..runs.evaluation import evaluate
    from ..runs.run_folder import trained_steps
    from ..settings.presets import load_config

    config = load_config(args.run)
    env_id = args.env or config.env_id
    seed = config.seed if args.seed is None else args.seed
    policy = policy_of(args.run)
    if without_module(env_id) == without_module(config.env_id):
        episodes = evaluate(policy, env_id, args.episodes, seed)
        rate, reached = episodes.success_rate, float(episodes.reached.mean())
    else:
        rate, reached = cross_test(args.run, env_id, args.episodes, seed, _warn), None
    result = {
        "env": env_id,
        "method": config.method,
        "seed": config.seed,
        "episodes": args.episodes,
        "success_rate": rate,
        **({} if reached is None else {"reached_rate": reached}),
        "env_steps": trained_steps(args.run),
    }
    if args.json:
        print(json.dumps(result))
    else:
        row = {name: result[name] for name in ("env", "method", "seed")}
        _print_table(row | _outcome(result))
        if reached is not None:
            print(f"reached at any step: {reached:.3f} of {args.episodes}")


def _outcome(result: dict[str, Any]) -> dict[str, str]:
    """Return the columns of a test's result."""
    steps = result["env_steps"]
    return {
        "env steps": "-" if steps is None else f"{steps:,}",
        "success": f"{result['success_rate']:.3f} of {result.get('episodes', '?')}",
    }


def _warn(sentence: str) -> None:
    print(f"{PROGRAM}: {sentence}", file=sys.stderr)


def _told(args: argparse.Namespace) -> Report:
    """Return what prints a sentence, or with `--quiet` does not."""
    return (lambda sentence: None) if getattr(args, "quiet", False) else _warn


def _watch(args: argparse.Namespace) -> None:
    from ..settings.presets import load_config
    from .pictures import record

    config = load_config(args.run)
    out = _named(args.out or args.run / VIDEO, ".mp4")
    rate = record(policy_of(args.run), config.env_id, out, args.episodes, args.seed)
    print(f"{out}: success {rate:.2f} of {args.episodes}")


def _plot(args: argparse.Namespace) -> None:
    from ..comparison.figures import draw_results
    from ..comparison.plots import draw_curves

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
    from ..common.files import lock
    from ..comparison.cells import Settings
    from ..comparison.compare import Comparison, runs_left, share_cores, write_report
    from ..comparison.executors import Executor, LocalExecutor
    from ..comparison.grid import plan
    from ..comparison.grid_display import GridDisplay
    from ..envs.batch import cores

    check_methods(args.methods)
    overrides = said_with_set(args.set)
    check_agreed("steps", args.steps, overrides)
    check_agreed("threads", args.threads, overrides)
    settings = Settings(args.steps, args.preset, overrides, args.paper_evaluation)
    grid = (args.out, args.tasks, args.methods, args.seeds, settings)
    # What is invalid is refused before a cluster is asked for.
    wanted = plan(*grid, report=_told(args))
    left = runs_left(args.out, wanted, args.retry_failed)
    executor: Executor
    if args.ray is None:
        jobs, threads = share_cores(cores(), left, args.jobs, args.threads)
        executor = LocalExecutor(jobs, args.out / "logs")
    else:
        from ..comparison.ray_executor import RayExecutor, connect

        jobs, threads = share_cores(
            connect(args.ray, args.threads or 1), left, args.jobs, args.threads or 1
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
        print((args.out / "table.md").read_text(encoding="utf-8"), end="")
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(wanted)} runs failed: {', '.join(failed)}")


def _predictor(args: argparse.Namespace) -> None:
    from ..common.files import lock, remove_half_written
    from ..runs.hub_folder import check_new
    from ..runs.predictor_cache import OF_OBJECT_STAGE, learn_predictor

    args.steps = args.n_envs = args.threads = None
    folder = args.out
    config = _config(args)
    for text in args.set:
        if text.partition("=")[0].partition(".")[0] not in OF_OBJECT_STAGE:
            raise ValueError(
                f"--set {text} does nothing: F_phi is learned without the robot, from "
                + ", ".join(OF_OBJECT_STAGE)
            )
    check_new(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder, wait=False):
        remove_half_written(folder)
        learn_predictor(config, folder)
    print(folder)


def _inspect(args: argparse.Namespace) -> None:
    from ..imagination.goal_predictor import GoalPredictor
    from .inspecting import draw_found, inspect

    if args.out is not None:
        _named(args.out, ".png")
    elif args.predictor is not None:
        raise ValueError("--predictor is for the picture; say with --out FILE.png where it goes")
    if args.predictor is not None:
        GoalPredictor.load(args.predictor, env_id=args.env)  # before what takes long
    facts = inspect(args.env, _warn)
    width = max(map(len, facts))
    for name, words in facts.items():
        print(f"{name:<{width}}  {words}")
    if args.out is not None:
        draw_found(args.env, args.out, args.predictor)
        print(args.out)


def _settings(args: argparse.Namespace) -> None:
    from ..settings.docs_tables import lines_with_preset

    print(*lines_with_preset(args.name), sep="\n")


def _print_table(row: dict[str, Any]) -> None:
    """Print one result."""
    from rich.table import Table

    from ..runs.progress import Terminal

    table = Table()
    for name in row:
        table.add_column(name, overflow="fold")  # of names that differ in their last letter only
    table.add_row(*map(_cell, row.values()))
    Terminal().print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


_COMMANDS = {
    "train": _train,
    "evaluate": _evaluate,
    "watch": _watch,
    "plot": _plot,
    "compare": _compare,
    "predictor": _predictor,
    "inspect": _inspect,
    "settings": _settings,
    "demo": demo.run,
    "export": export.run,
    "report": report.run,
    "picture": picture.run,
}

if __name__ == "__main__":
    sys.exit(main())
