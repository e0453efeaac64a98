"""How a comparison goes: a live table on a terminal, lines in a log."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

from rich.live import Live
from rich.table import Table
from rich.text import Text

from ..common.copies import NoCopies
from ..common.reports import Trouble
from ..runs.progress import Terminal

# Seconds between two reports where there is no terminal to draw on.
_LINES_EVERY = 60.0


class GridDisplay(NoCopies):
    """Shows each job under way, how many runs are done and about how long the rest will take.

    Args:
        quiet: show nothing but trouble.
        clock: tells the time in seconds.
    """

    no_copies = "a GridDisplay draws on this process's terminal and cannot be copied: make another"

    def __init__(self, quiet: bool = False, clock: Any = time.monotonic):
        self._console = Terminal(quiet=quiet)
        self._clock = clock
        self._running: dict[str, dict[str, Any]] = {}
        self._left: dict[str, int] = {}  # env steps, by cell
        self._total: dict[str, int] = {}
        self._gained = 0  # env steps since this comparison was started
        self._started: float | None = None
        self._headline = ""
        self._last_lines = clock()
        self._live = Live(
            console=self._console, auto_refresh=False, get_renderable=self._table, transient=True
        )

    def __enter__(self) -> GridDisplay:
        if self._console.is_terminal:
            with suppress(OSError):
                self._live.start()
        return self

    def __exit__(self, *raised: object) -> None:
        with suppress(OSError):
            self._live.stop()

    def say(self, sentence: str) -> None:
        """Print a sentence above the table, while there is somebody to read it."""
        self._console.tell(sentence)

    def expect(self, name: str, total: int, done: int) -> None:
        """Take a cell's env steps, in all and done already, into the estimate."""
        self._total[name] = total
        self._left[name] = max(0, total - done)

    def count(self, finished: int, failed: int, total: int) -> None:
        """Say how many of the runs have ended."""
        self._headline = f"{finished} of {total} finished"
        self._headline += f", {failed} failed" if failed else ""

    def started(self, name: str, kind: str) -> None:
        """Show a job from now on."""
        self._running[name] = {"kind": kind, "env_steps": None, "text": "", "outcome": ""}
        if self._started is None:
            self._started = self._clock()
        if not self._console.is_terminal:
            self.say(f"{name}: {kind} begins")

    def update(self, name: str, message: dict[str, Any]) -> None:
        """Show what a job told."""
        row = self._running[name]
        if "trouble" in message:
            self.say(Trouble(f"{name}: {message['trouble']}"))
            return
        if "say" in message:
            row["text"] = message["say"]
            return
        figures = message.get("figures")
        if figures is None:
            return
        steps = int(figures["env_steps"])
        if row["env_steps"] is not None:  # what the first report holds was done before or shared
            self._gained += steps - row["env_steps"]
        else:
            row["first"] = (self._clock(), steps)
        self._left[name] = max(0, self._total[name] - steps)
        row["env_steps"] = steps
        rate, k_max = figures["success_rate"], figures["k_max"]
        row["text"] = "success " + ("-" if rate is None else f"{rate:.2f}")
        row["text"] += "" if k_max is None else f", k_max {k_max}"
        row["outcome"] = row["text"]

    def ended(self, name: str, finished: bool = False) -> None:
        """Show a job no more."""
        row = self._running.pop(name)
        if finished:
            self._left[name] = 0
            if not self._console.is_terminal:
                self.say(f"{name}: {row['kind']} finished{_after(row['outcome'])}")

    def remaining(self) -> float | None:
        """Return about how many seconds the rest will take at the speed so far; None at first."""
        left = sum(self._left.values())
        if not self._gained or self._started is None:
            return 0.0 if not left else None
        return left * (self._clock() - self._started) / self._gained

    def refresh(self) -> None:
        """Draw the table anew, or print lines where it is time to."""
        if self._console.is_terminal:
            with suppress(OSError):
                self._live.refresh()
        elif self._clock() - self._last_lines >= _LINES_EVERY:
            self._last_lines = self._clock()
            self.say(self._title())
            for name, row in self._running.items():
                self.say(f"  {name}: {self._steps(row)}{_after(row['text'])}")

    def _title(self) -> str:
        return f"{self._headline}, {len(self._running)} under way, {_duration(self.remaining())}"

    def _table(self) -> Table:
        table = Table(title=self._title(), title_justify="left")
        for column in ("run", "job", "env steps", "how it goes"):
            table.add_column(column)
        for name, row in self._running.items():
            words = (name, row["kind"], self._steps(row), row["text"])
            table.add_row(*map(Text, words))  # what looks like rich's markup is none
        return table

    def _steps(self, row: dict[str, Any]) -> str:
        if row["env_steps"] is None:
            return "-"
        since, first = row["first"]
        wall = self._clock() - since
        speed = f" ({(row['env_steps'] - first) / wall:,.0f}/s)" if wall > 0.0 else ""
        return f"{row['env_steps']:,}{speed}"


def _after(text: str) -> str:
    return f", {text}" if text else ""


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "time left unknown yet"
    minutes = round(seconds / 60.0)
    return f"about {minutes // 60} h {minutes % 60:02d} min left"
