"""Progress of a training run on a terminal, or as plain lines in a log."""

from __future__ import annotations

import errno
import sys
import time
from contextlib import suppress
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..common.copies import NoCopies
from ..common.reports import Trouble

# Seconds between two lines where there is no terminal to draw a bar on.
_LINE_EVERY = 60.0
_LEAST_WIDTH, _USUAL_WIDTH = 20, 80  # letters


class Terminal(Console):
    """A console that reports a reader who has gone as the OSError it is, instead of leaving.

    What must go on without a reader uses `tell`.
    """

    def __init__(self, **options: Any):
        super().__init__(**options)
        if self.width < _LEAST_WIDTH:  # a COLUMNS that no terminal has
            self.width = _USUAL_WIDTH

    def on_broken_pipe(self) -> None:
        """Called where nobody reads any more."""
        raise OSError(errno.EPIPE, "nobody reads the standard output any more")

    def say(self, sentence: str) -> None:
        """Print a sentence; trouble goes to the standard error where the rest is not shown."""
        if self.quiet and isinstance(sentence, Trouble):
            print(sentence, file=sys.stderr)
        self.print(sentence, markup=False, highlight=False, soft_wrap=True)

    def tell(self, sentence: str) -> None:
        """Print a sentence as `say` does, to whom it may reach: a run does not end for its log."""
        try:
            self.say(sentence)
        except (OSError, ValueError):  # gone, full, or closed
            self.quiet = True


class ProgressBar(NoCopies):
    """Shows env steps, success, k_max and steps per second.

    Args:
        total: env steps of the whole run.
        quiet: show nothing but trouble.
    """

    no_copies = "a ProgressBar draws on this process's terminal and cannot be copied: make another"

    def __init__(self, total: int, quiet: bool = False):
        self._quiet = quiet
        self._total = total
        self._console = Terminal(quiet=quiet)
        self._bar = Progress(
            TextColumn("{task.completed:,.0f}/{task.total:,.0f} steps"),
            BarColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=quiet or not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total, figures="")
        self._last_line = time.monotonic()
        self._first: tuple[float, int] | None = None

    def __enter__(self) -> ProgressBar:
        with suppress(OSError):
            self._bar.start()
        return self

    def __exit__(self, *raised: object) -> None:
        with suppress(OSError):
            self._bar.stop()

    def say(self, sentence: str) -> None:
        """Print a sentence above the bar, while there is somebody to read it."""
        self._console.tell(sentence)

    def update(self, figures: dict[str, Any]) -> None:
        """Show the figures that `train` reports after each rollout."""
        now, steps = time.monotonic(), figures["env_steps"]
        speed = ""
        if self._first is None:  # one figure has no speed
            self._first = (now, steps)
        elif now > self._first[0]:
            since, first_steps = self._first
            speed = f"  {(steps - first_steps) / (now - since):,.0f} steps/s"
        rate, k_max = figures["success_rate"], figures["k_max"]
        text = "success " + ("-" if rate is None else f"{rate:.2f}")
        text += "" if k_max is None else f"  k_max {k_max}"
        text += speed
        self._bar.update(self._task, completed=min(steps, self._total), figures=text)
        if not self._console.is_terminal and now - self._last_line >= _LINE_EVERY:
            self._last_line = now
            self.say(f"{steps:,}/{self._total:,} steps  {text}")
