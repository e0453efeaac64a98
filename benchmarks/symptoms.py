"""Draw the curves of docs/when_it_does_not_learn.md from logs that are kept.

    python benchmarks/symptoms.py

Reads validations of runs of before 0.2.0 in benchmarks/symptoms and benchmarks/remedies, and SB3's
log of a run that was stopped after 201,600 env steps: `sb3-follow-object train --env
FollowObject/PnPSimpleV2-v0 --method her --seed 0 --steps 300000 --threads 1`. Writes
docs/images/symptoms.
"""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

HERE = Path(__file__).parent
OUT = HERE.parent / "docs" / "images" / "symptoms"
Column = tuple[np.ndarray, np.ndarray]

MOVED, K_MAX, SUCCESS = "train/moved_share", "curriculum/k_max", "eval/success_rate"
LAST = 12  # validations
BY_CHANCE = (0.02, 0.05)  # of PnPSimpleV2's episodes, docs/evidence.md
LEVELS = HERE / "remedies" / "PnPInsertion-small-batch-levels.csv"


def validations(run: str) -> Path:
    """Return the file of a run's validations."""
    return HERE / "symptoms" / f"{run}.csv"


def column(file: Path, x: str, y: str) -> Column:
    """Return two columns of a CSV file, where both have a number."""
    with open(file, newline="") as rows:
        pairs = [(float(row[x]), float(row[y])) for row in csv.DictReader(rows) if row[y]]
    return np.array(pairs).T[0], np.array(pairs).T[1]


def panels(*names: str) -> tuple[Figure, list[Any]]:
    """Return a figure with one panel a logged name, below each other, against env steps."""
    figure = Figure(figsize=(5.2, 2.4 * len(names)), layout="constrained")
    axes = list(figure.subplots(len(names), 1, squeeze=False)[:, 0])
    for axis, name in zip(axes, names, strict=True):
        axis.set(xlabel="env steps", title=name)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        axis.grid(alpha=0.3)
        if name == SUCCESS:
            axis.set_ylim(-0.02, 1.02)
    return figure, axes


def save(figure: Figure, name: str) -> None:
    """Write a picture, with a legend in its first panel."""
    figure.axes[0].legend()
    OUT.mkdir(parents=True, exist_ok=True)
    figure.savefig(OUT / name, dpi=110, metadata={"Software": None})


def never_touches() -> None:
    """The share of the replay buffer that moved the object, where nothing is learned."""
    figure, axes = panels(MOVED, SUCCESS)
    file = HERE / "symptoms" / "PnPSimpleV2-her-0.csv"
    for axis, name in zip(axes, (MOVED, SUCCESS), strict=True):
        axis.plot(*column(file, "eval/env_steps", name), marker=".", label="PnPSimpleV2, HER")
    axes[0].axhspan(*BY_CHANCE, alpha=0.2, label="random actions")
    axes[0].set_ylim(0, 0.4)
    save(figure, "never_touches.png")


def stands() -> None:
    """Levels that are passed by chance, and how far the policy gets in fact."""
    figure, axes = panels(K_MAX, SUCCESS)
    runs = {
        "batches of 256, full noise": HERE / "remedies" / "PnPInsertion-small-batch.csv",
        "batches of 1024, half the noise": validations("PnPInsertion-fo-0"),
    }
    for label, file in runs.items():
        axes[0].plot(*column(file, "env_steps", "k_max"), label=label)
        axes[1].plot(*column(file, "env_steps", "success_rate"))
    save(figure, "stands.png")
    figure, (axis,) = panels("success level by level")
    axis.plot(*column(LEVELS, "level", "success"), marker="o", label="batches of 256, full noise")
    axis.xaxis.set_major_formatter("{x:.0f}")
    axis.set(xlabel="level", ylim=(-0.02, 1.02))
    save(figure, "level_by_level.png")


def rests() -> None:
    """Two runs that rest at low levels and go on by themselves."""
    figure, axes = panels(K_MAX, SUCCESS)
    for run in ("PnPSimpleV2-fo-0", "PnPShelf-fo-1"):
        axes[0].plot(*column(validations(run), "env_steps", "k_max"), label=run)
        axes[1].plot(*column(validations(run), "env_steps", "success_rate"))
    save(figure, "rests.png")


def swings() -> None:
    """Validations late in long runs."""
    figure, axes = panels(SUCCESS, f"the last {LAST} of them")
    for run in ("PushDoubleObstacles-fo-0", "PnPInsertion-fo-0"):
        steps, rates = column(validations(run), "env_steps", "success_rate")
        axes[0].plot(steps, rates, label=run)
        axes[1].plot(np.arange(LAST), rates[-LAST:], marker=".")
    axes[1].xaxis.set_major_formatter("{x:.0f}")
    axes[1].set(xlabel="validation of 76 episodes", ylim=(0.8, 1.02))
    save(figure, "swings.png")


def main() -> None:
    """Draw all."""
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    for draw in (never_touches, stands, rests, swings):
        draw()


if __name__ == "__main__":
    main()
