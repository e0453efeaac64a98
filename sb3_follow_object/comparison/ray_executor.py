"""Where a comparison's jobs run: on the nodes of a Ray cluster, which need not share a disk."""

from __future__ import annotations

import json
import os
import signal
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..common.copies import NoCopies
from ..common.extras import need
from ..common.files import atomic_write, lock
from ..common.reports import named_reason
from ..runs.object_stage_files import OBJECT_STAGE
from ..runs.run_folder import RESULT
from .executors import Message
from .worker import Job, run_job

LOCAL = "local"

_POST_EVERY = 1.0  # seconds between two reports of figures: a rollout may take less


def connect(address: str, threads: int = 1) -> int:
    """Connect to a Ray cluster and return how many cores it has.

    Args:
        address: of the cluster, e.g. 10.0.0.1:6379 or auto; LOCAL starts one on this machine.
        threads: cores that each job will ask for, on one node.

    Raises:
        MissingExtra: Ray is not installed.
        ValueError: nothing answers there, or no node has so many cores.
    """
    ray = need("ray", "ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nobody asked for reports
    if not ray.is_initialized():
        try:
            ray.init(address=address, logging_level="ERROR", log_to_driver=False)
        except (OSError, RuntimeError, ValueError) as error:
            raise ValueError(f"no Ray cluster answers at {address!r}: {error}") from error
    cores = int(ray.cluster_resources().get("CPU", 0))
    nodes = [node.get("Resources", {}).get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    largest = int(max(nodes, default=0))
    if largest < threads:
        raise ValueError(
            f"no node of the Ray cluster at {address!r} has {threads} cores for a run, "
            f"the largest has {largest}; give fewer --threads"
        )
    return cores


class RayExecutor(NoCopies):
    """Runs each job as a Ray task; a run's files travel with it, both ways.

    Args:
        slots: jobs at once, >= 1; Ray starts one where and when its cores are free.
    """

    no_copies = "a RayExecutor holds running tasks and cannot be copied: make another"

    def __init__(self, slots: int):
        self.slots = slots
        self._ray = need("ray", "ray")
        strategies = need("ray.util.scheduling_strategies", "ray")
        # Beside this process, so that it lives as long as somebody reads it.
        here = strategies.NodeAffinitySchedulingStrategy(
            self._ray.get_runtime_context().get_node_id(), soft=True
        )
        actor = self._ray.remote(num_cpus=0)(_Mailbox)
        self._mailbox = actor.options(scheduling_strategy=here).remote()
        self._jobs: dict[Any, Job] = {}  # by Ray's reference to their outcome
        self._locks: dict[str, ExitStack] = {}  # of the folders whose runs are away
        self._stopping = False

    def start(self, job: Job) -> None:
        """Begin a job.

        Raises:
            ValueError: another process works in its folder.
        """
        with ExitStack() as held:
            held.enter_context(lock(Path(job.folder), wait=False))
            # A failure is judged here, where it is written down; Ray must not repeat it by itself.
            task = self._ray.remote(num_cpus=job.threads, max_retries=0)(_work)
            reference = task.remote(job.to_json(), _read_files(Path(job.folder)), self._mailbox)
            self._jobs[reference] = job
            self._locks[job.name] = held.pop_all()

    def messages(self, timeout: float) -> list[tuple[str, Message]]:
        """Return what the jobs told, waiting up to `timeout` seconds for one to end."""
        ended, _ = self._ray.wait(list(self._jobs), timeout=timeout)
        told: list[tuple[str, Message]] = self._ray.get(self._mailbox.drain.remote())
        for reference in ended:
            job = self._jobs.pop(reference)
            with self._locks.pop(job.name):
                try:
                    outcome, files, gone = self._ray.get(reference)
                    _write_files(Path(job.folder), files, gone)
                # Its process or its node is gone, or there is no room for its files here.
                except (self._ray.exceptions.RayError, OSError) as error:
                    outcome = {"failed": named_reason(error)}
            told.append((job.name, outcome))
        return told

    def stop(self) -> None:
        """Ask all jobs to write a checkpoint and end; asked again, they end at once."""
        if self._stopping:
            for reference in self._jobs:
                self._ray.cancel(reference, force=True)
        self._stopping = True
        self._ray.get(self._mailbox.stop.remote())


class _Mailbox:
    """An actor that keeps what the jobs tell until it is read, and tells them to stop."""

    def __init__(self) -> None:
        self._told: list[tuple[str, Message]] = []
        self._stopping = False

    def post(self, name: str, message: Message) -> bool:
        """Keep a job's message; return whether the job should stop."""
        self._told.append((name, message))
        return self._stopping

    def drain(self) -> list[tuple[str, Message]]:
        """Return the messages and forget them."""
        told, self._told = self._told, []
        return told

    def stop(self) -> None:
        """Tell every job that posts from now on to stop."""
        self._stopping = True


def _work(
    job_json: str, files: dict[str, bytes], mailbox: Any
) -> tuple[Message, dict[str, bytes], set[str]]:
    """Do a job on a node, in a folder of its own.

    Returns:
        How it ended, the folder's files, and the names of those that came with the job and are
        there no more.
    """
    ray = need("ray", "ray")
    job = Job(**json.loads(job_json))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    last_post, stopping = -_POST_EVERY, False

    def send(message: Message) -> None:
        nonlocal last_post, stopping
        if "figures" in message and time.monotonic() - last_post < _POST_EVERY:
            return
        last_post = time.monotonic()
        stop = ray.get(mailbox.post.remote(job.name, message))
        if stop and not stopping:  # a second signal would stop it without a checkpoint
            stopping = True
            signal.raise_signal(signal.SIGINT)

    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / Path(job.folder).name
        folder.mkdir()
        _write_files(folder, files)
        outcome: Message = {"finished": True}
        try:
            run_job(replace(job, folder=str(folder)), send)
        except KeyboardInterrupt:
            outcome = {"stopped": True}
        except Exception as error:
            outcome = {"failed": named_reason(error)}
        left = _read_files(folder)
        return outcome, left, set(files) - set(left)


def _read_files(folder: Path) -> dict[str, bytes]:
    """Return the files of a run's folder by their paths in it, but for hidden ones."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }


def _write_files(folder: Path, files: dict[str, bytes], gone: Iterable[str] = ()) -> None:
    """Write files into a run's folder and remove those that are gone."""
    # These two say that everything else is there.
    for name in sorted(files, key=lambda name: name in (OBJECT_STAGE, RESULT)):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, files[name])
    for name in gone:
        (folder / name).unlink(missing_ok=True)
