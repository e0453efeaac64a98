"""Kill training runs at random moments, resume them, and compare them with one never killed.

    python benchmarks/kill_test.py --out benchmarks/kill_test.json

Each run is killed with SIGKILL once in each part of its life in turn: as it starts, in each of the
three stages, while it writes a checkpoint, in the final test, or anywhere; and is resumed until it
ends. Policies, F_phi, results and evaluations must then be those of the run that was never killed,
bit for bit; only wall-clock times may differ.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
import tiny_runs as runs

# What a run prints as each part of its life begins.
PARTS = {
    "start": "",
    "stage 1": "stage 1:",
    "stage 2": "stage 2:",
    "stage 3": "learns\n",
    "final test": "final test",
}
WRITING = "a checkpoint's writing"
ANYWHERE = "anywhere"
KINDS = (*PARTS, WRITING, ANYWHERE)
CODE = """
import sys, tiny_runs as runs
from pathlib import Path
from sb3_follow_object.runs.experiment import train
folder = Path(sys.argv[1])
say = lambda sentence: print(sentence, flush=True)
train(runs.config(), folder, resume=(folder / "config.json").exists(), report=say)
"""


def start(folder: Path, log: Path) -> subprocess.Popen[bytes]:
    """Start or resume the run in a process of its own."""
    with open(log, "ab") as file:
        return subprocess.Popen(
            [sys.executable, "-c", CODE, str(folder)],
            cwd=Path(runs.__file__).parent,
            stdout=file,
            stderr=subprocess.STDOUT,
        )


def half_written(folder: Path) -> bool:
    """Whether a checkpoint is being written at this moment."""
    return any(folder.glob(".checkpoint*.tmp"))


def kill_when(process: subprocess.Popen[bytes], ready: Callable[[], bool], delay: float) -> bool:
    """Kill a process some time after a condition holds; return whether it still ran then."""
    while process.poll() is None and not ready():
        time.sleep(0.0002)
    ends = time.monotonic() + delay
    while process.poll() is None and time.monotonic() < ends:
        time.sleep(0.001)
    killed = process.poll() is None
    process.kill()
    process.wait()
    return killed


def killed_run(folder: Path, kind: str, seconds: float, rng: random.Random) -> dict[str, object]:
    """Kill a run once, resume it to its end and return what happened."""
    log = folder.with_suffix(".log")
    delay = rng.uniform(0.0, seconds if kind in ("start", ANYWHERE) else 0.15 * seconds)
    process = start(folder, log)
    if kind == WRITING:
        after = time.monotonic() + rng.uniform(0.3, 0.8) * seconds
        killed = kill_when(process, lambda: time.monotonic() > after and half_written(folder), 0.0)
    else:
        mark = PARTS.get(kind, "")
        killed = kill_when(process, lambda: mark in log.read_text(), delay)
    facts = {
        "kind": kind,
        "killed": killed,
        "half_written_checkpoint_left": half_written(folder),
        "said_last": (log.read_text().splitlines() or ["nothing yet"])[-1],
    }
    process = start(folder, log)
    if process.wait() != 0:
        raise RuntimeError(f"{folder} could not be resumed:\n{log.read_text()}")
    return facts


def summary(found: list[dict[str, object]]) -> dict[str, object]:
    """Return how many runs were killed in which part of their lives, and how many ended equal."""
    return {
        "runs": len(found),
        "equal": sum(bool(row["equal"]) for row in found),
        "killed_in": dict(Counter(str(row["kind"]) for row in found if row["killed"])),
        "half_written_checkpoints_left": sum(
            bool(row["half_written_checkpoint_left"]) for row in found
        ),
        "each": found,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--out", type=Path, help="JSON file for what was found")
    args = parser.parse_args()
    rng = random.Random(args.seed)
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.monotonic()
        if start(folder / "whole", folder / "whole.log").wait() != 0:
            raise RuntimeError((folder / "whole.log").read_text())
        seconds = time.monotonic() - began
        whole = runs.outcome(folder / "whole")
        for number in range(args.runs):
            kind = KINDS[number % len(KINDS)]
            facts = killed_run(folder / f"run{number}", kind, seconds, rng)
            same = runs.outcome(folder / f"run{number}") == whole
            found.append({**facts, "equal": same})
            print(json.dumps(found[-1]), flush=True)
            if args.out is not None:
                args.out.write_text(json.dumps(summary(found), indent=1) + "\n")
    return 0 if all(row["equal"] for row in found) else 1


if __name__ == "__main__":
    sys.exit(main())
