"""Where a comparison's jobs run: in processes of this machine."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from ..common.copies import NoCopies
from .worker import INTERRUPTED, Job

Message = dict[str, Any]


class Executor(Protocol):
    """Runs jobs, at most `slots` at once, and tells how they go.

    A message is {"figures": ...}, {"say": ...} or {"trouble": ...} of a job under way, the last of
    what went wrong, and as a job's last one {"finished": True}, {"stopped": True} or
    {"failed": "one line"}.
    """

    slots: int

    def start(self, job: Job) -> None:
        """Begin a job."""

    def messages(self, timeout: float) -> list[tuple[str, Message]]:
        """Return what the jobs told, by the jobs' names, waiting up to `timeout` seconds."""

    def stop(self) -> None:
        """Ask all jobs to write a checkpoint and end; asked again, they end at once."""


class LocalExecutor(NoCopies):
    """Runs each job in a process of its own, which has its share of the cores from the start.

    Args:
        slots: jobs at once, >= 1.
        logs: folder for what the jobs print; is created.
    """

    no_copies = "a LocalExecutor holds running processes and cannot be copied: make another"

    def __init__(self, slots: int, logs: Path):
        self.slots = slots
        self._logs = logs
        self._children: dict[str, subprocess.Popen[str]] = {}
        self._inbox: queue.Queue[tuple[str, Message]] = queue.Queue()
        self._stopping = False

    def start(self, job: Job) -> None:
        """Begin a job."""
        log = self._log(job.name)
        log.parent.mkdir(parents=True, exist_ok=True)
        # Read by the libraries as they are imported, so the process must begin with it.
        threads = {name: str(job.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        with open(log, "a", encoding="utf-8") as file:
            child = subprocess.Popen(
                [sys.executable, "-m", "sb3_follow_object.comparison.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                env={**os.environ, **threads},
                start_new_session=True,  # Ctrl-C reaches this process alone, which passes it on
            )
        assert child.stdin is not None
        with suppress(OSError):  # it died at once; its log says why
            child.stdin.write(job.to_json() + "\n")
            child.stdin.flush()  # and stays open: the child ends when this process does
        self._children[job.name] = child
        threading.Thread(target=self._listen, args=(job.name, child), daemon=True).start()

    def messages(self, timeout: float) -> list[tuple[str, Message]]:
        """Return what the jobs told, waiting up to `timeout` seconds for the first message."""
        told = []
        try:
            told.append(self._inbox.get(timeout=timeout))
            while True:
                told.append(self._inbox.get_nowait())
        except queue.Empty:
            return told

    def stop(self) -> None:
        """Ask all jobs to write a checkpoint and end; asked again, they end at once."""
        for child in list(self._children.values()):
            child.send_signal(signal.SIGKILL if self._stopping else signal.SIGTERM)
        self._stopping = True

    def _listen(self, name: str, child: subprocess.Popen[str]) -> None:
        """Pass a child's lines on until it ends, then say how it ended."""
        assert child.stdout is not None
        failure: str | None = None
        for line in child.stdout:
            message = self._parse(line)
            failure = message.get("failed", failure)
            if "failed" not in message:
                self._inbox.put((name, message))
        status = child.wait()
        assert child.stdin is not None
        with suppress(OSError):
            child.stdin.close()
        self._children.pop(name, None)
        if status == 0:
            last: Message = {"finished": True}
        elif status == INTERRUPTED or (self._stopping and failure is None):
            last = {"stopped": True}
        else:
            last = {"failed": failure or self._post_mortem(name, status)}
        self._inbox.put((name, last))

    @staticmethod
    def _parse(line: str) -> Message:
        try:
            message = json.loads(line)
        except ValueError:
            return {}  # a line that was cut off when the process was killed
        return message if isinstance(message, dict) else {}

    def _post_mortem(self, name: str, status: int) -> str:
        """Return one line about a process that could not say why it ended."""
        how = f"killed by signal {-status}" if status < 0 else f"ended with status {status}"
        try:
            lines = self._log(name).read_text("utf-8", "replace").splitlines()
        except OSError:
            lines = []
        lines = [line.strip() for line in lines if line.strip()]
        return f"{how}; the log's last line: {lines[-1]}" if lines else how

    def _log(self, name: str) -> Path:
        return self._logs / f"{name.replace('/', '-')}.log"
