"""`sb3-follow-object report`: one HTML file of a run or of a comparison."""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

# Nothing heavier here: --help must not wait for torch.

_NAME = "report.html"


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line's."""
    report = subparsers.add_parser("report", help="one HTML file of a run or of a comparison")
    report.add_argument("folder", type=Path, help="of a run, or of compare's results")
    report.add_argument("--out", type=Path, metavar="FILE.html", help=f"default: FOLDER/{_NAME}")


def run(args: argparse.Namespace) -> None:
    """Write the report and print its name."""
    from ..comparison.report import is_run, write_comparison_report, write_run_report

    out = args.out or args.folder / _NAME
    if out.suffix.lower() != ".html":
        raise ValueError(f"{out} does not end in .html, which is what is written")
    if not is_run(args.folder):
        figures = sorted((args.folder / "figures").glob("*.png"))
        titles = {path.stem.replace("_", " "): path for path in figures}
        write_comparison_report(args.folder, out, titles)
    else:
        with TemporaryDirectory() as drawn:
            write_run_report(args.folder, out, _pictures(args.folder, Path(drawn)))
    print(out)


def _pictures(run: Path, drawn: Path) -> dict[str, Path]:
    """Return a run's pictures by their titles; those that it has none of are drawn."""
    from ..common.reports import reason
    from ..imagination.goal_predictor import GoalPredictor
    from ..runs.object_stage_files import PREDICTOR
    from ..runs.run_folder import POLICY
    from ..settings.presets import load_config
    from .picture_names import IMAGINED, VIDEO
    from .pictures import draw_imagined, record

    env_id = load_config(run).env_id
    titles = {IMAGINED: "Imagined goals of three episodes, the first levels dark, the last yellow"}
    titles |= {VIDEO: "Noise-free episodes with original goals"}
    found = {}
    for name, title in titles.items():
        needed = run / (PREDICTOR if name == IMAGINED else POLICY)
        path = run / name
        if not path.exists() and needed.exists():
            path = drawn / name
            try:
                if name == IMAGINED:
                    draw_imagined(env_id, GoalPredictor.load(needed, env_id=env_id), path)
                else:
                    record(needed, env_id, path, n_episodes=3)
            except Exception as error:  # graphics drivers raise anything; the rest is told
                print(f"left out {name}: {reason(error)}")
        if path.exists():
            found[title] = path
    return found
