"""Train a small network for long and watch the process: memory, open files, threads.

    python benchmarks/long_run.py --steps 5000000 --out benchmarks/long_run

Writes OUT.csv with a sample every few seconds and OUT.png. Once the replay buffer is full nothing
may grow: exit code 1 where the last quarter of the samples holds over 2% more memory, or more files
or threads, than the quarter before it.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from sb3_follow_object.common.files import atomic_write
from sb3_follow_object.runs.experiment import train
from sb3_follow_object.settings.run_config import RunConfig

COLUMNS = ("seconds", "env_steps", "resident_mb", "open_files", "threads")
LABELS = {"resident_mb": "resident memory (MB)", "open_files": "open files", "threads": "threads"}
GROWTH = 1.02


def config(steps: int, buffer_size: int, checkpoint_minutes: float) -> RunConfig:
    """DDPG + HER with a small network: most of the time goes into the simulation."""
    algorithm: dict[str, Any] = {"buffer_size": buffer_size, "batch_size": 64}
    algorithm |= {"gradient_steps": 8, "policy_kwargs": {"net_arch": [32, 32]}}
    return RunConfig(
        "FollowObject/PushSideGap-v0",
        "her",
        total_timesteps=steps,
        settings={"imagine": False, "n_envs": 16, "n_threads": 1, "algorithm": algorithm},
        eval_every=max(1, steps // 20),
        checkpoint_minutes=checkpoint_minutes,
    )


class Watcher:
    """Samples the process between rollouts, every so many seconds."""

    def __init__(self, every: float):
        self.every = every
        self.rows: list[dict[str, float]] = []
        self._began = time.monotonic()

    def __call__(self, figures: dict[str, Any]) -> None:
        now = time.monotonic() - self._began
        if self.rows and now - self.rows[-1]["seconds"] < self.every:
            return
        status = dict(
            line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines()
        )
        values = (
            round(now, 1),
            figures["env_steps"],
            round(int(status["VmRSS"].split()[0]) / 1e3, 1),
            len(os.listdir("/proc/self/fd")),
            int(status["Threads"]),
        )
        self.rows.append(dict(zip(COLUMNS, values, strict=True)))


def write(rows: list[dict[str, float]], full_at: int, out: Path) -> None:
    """Write the samples as CSV and as a picture."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    atomic_write(out.with_suffix(".csv"), text.getvalue().encode())
    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.subplots(len(LABELS), 1, sharex=True)
    for axis, (name, label) in zip(axes, LABELS.items(), strict=True):
        axis.plot([row["env_steps"] / 1e6 for row in rows], [row[name] for row in rows])
        axis.axvline(full_at / 1e6, color="grey", linestyle=":")
        axis.set(ylabel=label, ylim=(0, 1.1 * max(row[name] for row in rows)))
        axis.grid(alpha=0.3)
    axes[0].set_title("dotted: the replay buffer is full", fontsize=9)
    axes[-1].set_xlabel("env steps (millions)")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    atomic_write(out.with_suffix(".png"), picture.getvalue())


def grown(rows: list[dict[str, float]], full_at: int) -> list[str]:
    """Return what is more in the last quarter than in the one before, once the buffer is full."""
    after = [row for row in rows if row["env_steps"] > full_at]
    quarter = len(after) // 4
    if quarter < 2:
        return ["too few samples after the buffer was full to tell"]
    found = []
    for name in LABELS:
        before = median(row[name] for row in after[-2 * quarter : -quarter])
        last = median(row[name] for row in after[-quarter:])
        limit = before * GROWTH if name == "resident_mb" else before
        if last > limit:
            found.append(f"{LABELS[name]} went from {before:g} to {last:g}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=5_000_000)
    parser.add_argument("--buffer-size", type=int, default=200_000, help="transitions")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between samples")
    parser.add_argument("--checkpoint-minutes", type=float, default=5.0)
    parser.add_argument("--out", type=Path, required=True, help="without an ending")
    args = parser.parse_args()
    watcher = Watcher(args.every)
    with tempfile.TemporaryDirectory() as folder:
        train(
            config(args.steps, args.buffer_size, args.checkpoint_minutes),
            Path(folder) / "run",
            progress=watcher,
        )
    write(watcher.rows, args.buffer_size, args.out)
    found = grown(watcher.rows, args.buffer_size)
    for sentence in found:
        print(sentence, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
