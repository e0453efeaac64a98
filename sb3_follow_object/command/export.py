"""`sb3-follow-object export`: a run's policy as an ONNX file or as a folder for the hub."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

# Nothing heavier here: --help must not wait for torch.


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line's."""
    export = subparsers.add_parser("export", help="hand a run's policy on: ONNX, or for the hub")
    export.add_argument("run", type=Path, help="folder with policy.safetensors and config.json")
    export.add_argument(
        "--onnx", type=Path, metavar="FILE.onnx", help="normaliser and clipping inside"
    )
    export.add_argument(
        "--hub", type=Path, metavar="FOLDER", help="new folder for the Hugging Face hub"
    )


def run(args: argparse.Namespace) -> None:
    """Write what is asked for and print its name."""
    if args.onnx is None and args.hub is None:
        raise ValueError("say what to write: --onnx FILE.onnx, --hub FOLDER or both")
    if args.onnx is not None:
        print(_export_onnx(args.run, args.onnx))
    if args.hub is not None:
        _export_for_hub(args.run, args.hub)
        print(args.hub)


def _export_onnx(run: Path, out: Path) -> Path:
    from ..ddpg.onnx_files import export_onnx
    from ..runs.hub_folder import load_hub_folder
    from ..settings.presets import load_config

    if out.suffix.lower() != ".onnx":
        raise ValueError(f"{out} does not end in .onnx, which is what is written")
    load_config(run)  # imports the module that registers the task
    export_onnx(load_hub_folder(run)[0], out)
    return out


def _export_for_hub(run: Path, folder: Path) -> None:
    from ..common.reports import reason
    from ..runs.hub_folder import CARD, FILM, load_hub_folder, write_hub_folder
    from ..runs.run_folder import POLICY
    from .pictures import record

    write_hub_folder(run, folder)
    _, config = load_hub_folder(folder)
    try:
        record(folder / POLICY, config.env_id, folder / FILM)
    except Exception as error:  # graphics drivers raise anything; the folder is whole without
        print(f"left out {FILM}: {reason(error)}; the hub shows {CARD} without it")
